"""Files on other machines, accessed with fsspec: parts of a file are fetched when needed.

Each remote file has a sparse local file of the same size. Fetched blocks are written to it, so
readers can memory-map it like any local file.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, TypeGuard
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from mcaprl import limits
from mcaprl.errors import LogError, OutputExistsError, UsageError, import_extra
from mcaprl.storage.locks import waiting_lock
from mcaprl.storage.work_folders import TemporaryFolder, open_own, replacing, subfolder

CACHE_VARIABLE = "MCAPRL_CACHE"
"""Name of the environment variable for the folder that keeps fetched parts for later commands."""
BLOCK_BYTES = 2**16
# Blocks at most `_LEAST_GAP` apart are fetched together; ranges above `_MOST_BYTES` are divided.
_LEAST_GAP, _MOST_BYTES = 2 * BLOCK_BYTES, 8 * 2**20

Range = tuple[int, int]  # Half-open range (start, stop) of byte positions


def is_url(name: object) -> bool:
    """Return whether a name is a URL, such as `s3://bucket/lane.mcap`.

    >>> is_url("https://host/lane.mcap"), is_url("logs/lane.mcap"), is_url(Path("lane.mcap"))
    (True, False, False)
    """
    return isinstance(name, str) and "://" in name


class RemoteFile:
    """A remote file with its local copy of the parts that were fetched."""

    def __init__(self, url: str) -> None:
        """Request the size of the remote file, and create the local file."""
        self.url = url
        self._connected = os.getpid(), system_of(url)
        facts = self._facts()
        if facts.get("type") == "directory":
            raise LogError(f"cannot read {url}: it is a folder")
        if facts.get("size") is None:
            raise LogError(f"cannot read {url}: its size is unknown; download it first")
        self.size = int(facts["size"])
        if not 0 <= self.size <= limits.MAX_REMOTE_BYTES:
            raise LogError(
                f"cannot read {url}: its server declares {self.size} bytes, but a file has at most"
                f" {limits.MAX_REMOTE_BYTES}"
            )
        self._version = _version_of(facts)
        folder, self._temporary = _folder_of(url, self._version, self.size)
        self._is_kept = self._temporary is None
        if not self._is_kept:
            # Unlike `weakref.finalize`, this also works at the end of a process of
            # `multiprocessing`, and does nothing in a forked process, which shares the folder.
            Finalize(self, shutil.rmtree, (folder, True), exitpriority=0)
        self.local = folder / _last_part(url)
        self._blocks_path = folder / "blocks"
        self._lock = threading.Lock()
        self._has = np.zeros(-(-self.size // BLOCK_BYTES), bool)
        with _Errors(f"cannot write {self.local}"):
            if self._is_kept and self.local.exists():
                self._merge_blocks()
            else:
                with open_own(self._blocks_path, "r+") as file:
                    file.truncate(0)
            # Another process may be filling the same file, so an existing file is not emptied.
            with open_own(self.local, "a") as file:
                file.truncate(self.size)

    @classmethod
    def of(cls, url: str) -> RemoteFile:
        """Return the file of this URL that is in use, if it is unchanged; otherwise, open it."""
        key = os.getpid(), url
        found = _in_use.get(key)
        if found is None or not found._version or not found._is_unchanged():
            found = _in_use[key] = cls(url)
        return found

    def fetch(self, ranges: Iterable[Range]) -> None:
        """Fetch the missing blocks of these byte ranges, with concurrent requests."""
        with self._lock:
            wanted = np.zeros(len(self._has), bool)
            for start, stop in ranges:
                last = -(-min(stop, self.size) // BLOCK_BYTES)
                wanted[max(start, 0) // BLOCK_BYTES : last] = True
            pieces = [one for run in self._runs(wanted & ~self._has) for one in _divided(*run)]
            for group in _grouped(pieces):
                parts = self._request(group)
                with _Errors(f"cannot write {self.local}"):
                    self._write(group, parts)

    def _request(self, pieces: list[Range]) -> list[bytes]:
        """Request byte ranges at the same time."""
        starts, stops = (list(each) for each in zip(*pieces, strict=True))
        system, path = self._system()
        with _Errors(f"cannot read {self.url}"):
            found = system.cat_ranges([path] * len(pieces), starts, stops, on_error="raise")
            # Older versions of fsspec return some errors.
            for part in found:
                if isinstance(part, BaseException):
                    raise part
        parts: list[bytes] = list(found)
        for (start, stop), part in zip(pieces, parts, strict=True):
            if len(part) != stop - start:
                raise LogError(
                    f"cannot read {self.url}: bytes {start} to {stop} were requested, but"
                    f" {len(part)} bytes arrived: the file has changed, or its server ignores"
                    " ranges; download it first"
                )
        return parts

    def _write(self, pieces: Iterable[Range], parts: Iterable[bytes]) -> None:
        """Write fetched parts to the local file, and then mark their blocks."""
        with open_own(self.local, "r+") as file:
            for (start, _), part in zip(pieces, parts, strict=True):
                file.seek(start)
                rest = memoryview(part)
                while rest:
                    rest = rest[file.write(rest) :]
            if self._is_kept:
                # Otherwise, a block could be marked after a crash of the system, but empty.
                os.fsync(file.fileno())
        for start, stop in pieces:
            self._has[start // BLOCK_BYTES : -(-stop // BLOCK_BYTES)] = True
        if self._is_kept:
            self._merge_blocks()

    def _merge_blocks(self) -> None:
        """Exchange the marks of fetched blocks with the processes that share the cache."""
        with open_own(self._blocks_path, "r+") as file, waiting_lock(file):
            bits = np.zeros(-(-len(self._has) // 8), np.uint8)
            kept = np.frombuffer(file.read(len(bits)), np.uint8)
            bits[: len(kept)] = kept
            self._has |= np.unpackbits(bits)[: len(self._has)].astype(bool)
            # The file is not emptied before, so a process that is killed here loses no marks.
            file.seek(0)
            file.write(np.packbits(self._has).tobytes())

    def check_unchanged(self) -> None:
        """Check that the remote file has not changed since it was opened."""
        if not self._is_unchanged():
            raise LogError(f"{self.url} has changed while it was read: open it again")

    def _is_unchanged(self) -> bool:
        system, path = self._system()
        # Some file systems keep listings of folders.
        system.invalidate_cache(path)
        facts = self._facts()
        return (facts.get("size"), _version_of(facts)) == (self.size, self._version)

    def _facts(self) -> dict[str, Any]:
        system, path = self._system()
        with _Errors(f"cannot read {self.url}"):
            facts: dict[str, Any] = system.info(path)
        return facts

    def _system(self) -> tuple[Any, str]:
        """Return the file system, and the path in it."""
        # A forked process opens its own file system: its parent's needs a thread of the parent.
        if self._connected[0] != os.getpid():
            self._connected = os.getpid(), system_of(self.url)
        return self._connected[1]

    def _runs(self, missing: NDArray[np.bool_]) -> Iterator[Range]:
        """Yield the byte ranges of missing blocks; merge ranges with small gaps between them."""
        blocks = np.flatnonzero(missing)
        if not len(blocks):
            return
        breaks = np.flatnonzero(np.diff(blocks) * BLOCK_BYTES > _LEAST_GAP)
        firsts = blocks[np.concatenate([[0], breaks + 1])]
        lasts = blocks[np.concatenate([breaks, [len(blocks) - 1]])]
        for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
            yield first * BLOCK_BYTES, min((last + 1) * BLOCK_BYTES, self.size)


# Files by process and URL. A forked process opens its own files, because its parent removes the
# local files when it no longer uses them.
_in_use: WeakValueDictionary[tuple[int, str], RemoteFile] = WeakValueDictionary()
# Folder of their local files by process and place.
_temporary: WeakValueDictionary[tuple[int, str], TemporaryFolder] = WeakValueDictionary()


class RemotePath(type(Path())):  # type: ignore[misc]
    """Path of the local copy of a remote file; `str` returns the URL."""

    remote: RemoteFile | None = None

    @classmethod
    def of(cls, url: str) -> RemotePath:
        """Open a remote file; raise the same errors as `RemoteFile`."""
        remote = RemoteFile.of(url)
        path = cls(remote.local)
        path.remote = remote
        return path

    def __str__(self) -> str:
        """Return the URL."""
        return super().__str__() if self.remote is None else self.remote.url

    def __fspath__(self) -> str:
        """Return the local path."""
        return str(super().__str__())

    def __reduce__(self) -> Any:
        """Pickle the URL, so that another process opens the file again."""
        return super().__reduce__() if self.remote is None else (RemotePath.of, (self.remote.url,))


def as_path(name: str | Path, *, whole: bool = False) -> Path:
    """Return the path of a local file, or of the local copy of a remote file."""
    path = RemotePath.of(str(name)) if is_url(name) else name
    path = path if isinstance(path, Path) else Path(path)
    if whole and isinstance(path, RemotePath) and path.remote is not None:
        path.remote.fetch([(0, path.remote.size)])
    return path


def find_remote(url: str) -> list[RemotePath]:
    """Return the logs of a URL: a file, a folder of `.mcap` files, or a glob, sorted by name."""
    if url.endswith(".mcap") and not any(sign in url for sign in "*?["):
        return [RemotePath.of(url)]
    system, path = system_of(url)
    with _Errors(f"cannot read {url}"):
        is_pattern = any(sign in path for sign in "*?[")
        if not is_pattern and not system.isdir(path):
            return [RemotePath.of(url)]
        pattern = path if is_pattern else f"{path.rstrip('/')}/*.mcap"
        found = sorted(map(str, system.glob(pattern)))
    if not found:
        raise LogError(f"{url}: no such file, folder or match")
    names = [name if is_url(name) else system.unstrip_protocol(name) for name in found]
    return [RemotePath.of(name) for name in names]


def upload(path: str | Path, url: str) -> None:
    """Copy a file to a URL. Until the copy is complete, its name ends with `.part`."""
    system, target = system_of(url)
    local = import_extra("fsspec.implementations.local", "remote").LocalFileSystem
    unfinished = f"{target}.part"
    with _Errors(f"cannot upload {path} to {url}"):
        if isinstance(system, local):
            with replacing(Path(target)) as copy:
                shutil.copyfile(path, copy)
            return
        if system.exists(unfinished) and system.info(unfinished).get("type") != "file":
            raise OutputExistsError(f"{url}.part is not a file: delete it, or choose another URL")
        try:
            parent = system._parent(target)
            if parent:
                system.makedirs(parent, exist_ok=True)
            system.put_file(os.fspath(path), unfinished)
            system.mv(unfinished, target)
        except NotImplementedError as error:
            raise UsageError(f"{url}: this protocol can only be read") from error
        finally:
            if system.exists(unfinished):
                system.rm_file(unfinished)


def upload_all(paths: Sequence[Path], url: str) -> None:
    """Copy files to a URL: one file if it ends with its suffix, else into that folder."""
    if len(paths) == 1 and url.endswith(paths[0].suffix):
        upload(paths[0], url)
        return
    for path in paths:
        upload(path, f"{url.rstrip('/')}/{path.name}")


def check_upload(url: str, *, overwrite: bool) -> None:
    """Check that a URL can be written to, before anything is recorded."""
    if not is_url(url):
        raise UsageError(f"{url} is not a URL, such as s3://bucket/lane.mcap")
    if url.startswith(("http://", "https://")):
        raise UsageError(f"{url}: this protocol can only be read")
    system, path = system_of(url)
    with _Errors(f"cannot open {url}"):
        exists = not overwrite and system.isfile(path)
    if exists:
        raise OutputExistsError(
            f"{url} exists: choose another URL, or pass `overwrite=True` to record or convert"
        )


def system_of(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it."""
    core = import_extra("fsspec.core", "remote")
    options: dict[str, Any] = {}
    if "http" in url.partition("://")[0]:
        http = import_extra("mcaprl.storage.http_answers", "remote").options()
        is_chain = not url.startswith("http")
        options = {"http": http, "https": http} if is_chain else http
    with _Errors(f"cannot open {url}"):
        system, path = core.url_to_fs(url, **options)
    return system, str(path)


class _Errors:
    """Context manager that converts every error of a file system to a LogError."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: Any, error: BaseException | None, trace: object) -> None:
        if not isinstance(error, Exception) or isinstance(error, LogError | UsageError):
            return
        if isinstance(error, FileNotFoundError):
            if not _is_failed_request(error.__cause__):
                raise LogError(f"{self._text}: no such file") from error
            error = error.__cause__
        if isinstance(error, TimeoutError):
            # Its own text is empty, or names no time.
            seconds = limits.SILENCE_TIMEOUT_S
            raise LogError(f"{self._text}: no answer within {seconds:.0f} s") from error
        what = str(error).strip().splitlines()
        raise LogError(f"{self._text}: {what[0] if what else type(error).__name__}") from error


def _is_failed_request(cause: BaseException | None) -> TypeGuard[Exception]:
    """Return whether a FileNotFoundError with this cause does not mean that the file is missing."""
    # fsspec raises one for every HTTP request that fails, also offline or with a status as 403.
    if isinstance(cause, OSError):
        return not isinstance(cause, FileNotFoundError)
    return getattr(cause, "status", 404) != 404


def _grouped(pieces: list[Range]) -> Iterator[list[Range]]:
    """Divide the ranges of a request into groups that fit in memory."""
    group, size = list[Range](), 0
    for start, stop in pieces:
        is_full = size + stop - start > limits.MAX_FETCHED_BYTES
        if group and (is_full or len(group) == limits.MAX_REQUESTS):
            yield group
            group, size = [], 0
        group.append((start, stop))
        size += stop - start
    if group:
        yield group


def _divided(start: int, stop: int) -> list[Range]:
    return [(one, min(one + _MOST_BYTES, stop)) for one in range(start, stop, _MOST_BYTES)]


def _version_of(facts: dict[str, Any]) -> str:
    """Return the ETag, timestamps and checksums that identify the version of a file, if any."""
    names = (
        *("ETag", "etag", "mtime", "LastModified", "last_modified", "created", "generation"),
        *("Last-Modified", "Content-MD5", "Digest"),  # HTTP
        "blob_id",  # Hugging Face
    )
    return " ".join(str(facts[name]) for name in names if facts.get(name) is not None)


def _folder_of(url: str, version: str, size: int) -> tuple[Path, TemporaryFolder | None]:
    """Return the local folder for a remote file; the second value is None if it is kept."""
    # Without a version, a later process could not notice that the remote file has changed.
    name = hashlib.sha256(f"{url} {version} {size}".encode()).hexdigest()[:24]
    kept = os.environ.get(CACHE_VARIABLE)
    if kept and version:
        folder = Path(kept) / name
        with _Errors(f"cannot write {folder}"):
            return subfolder(folder, own=True), None
    with _Errors("cannot write to the folder for temporary files"):
        # All files of a process share one locked folder, because a lock takes a descriptor.
        key = os.getpid(), tempfile.gettempdir()
        temporary = _temporary.get(key) or TemporaryFolder()
        _temporary[key] = temporary
        return Path(tempfile.mkdtemp(dir=temporary.path)), temporary


def _last_part(url: str) -> str:
    return url.partition("?")[0].rstrip("/").rpartition("/")[2] or "log.mcap"
