"""Manifest of a folder of logs: the files of one recording, written when all of them are complete.

`manifest.json` is a JSON object with `manifest_version` ("1") and `files`, a list of objects with
the `name`, `episodes`, `steps` and `size_bytes` of each log in its folder. A manifest is needed to
read a folder from a server that cannot list folders. It also shows whether a file is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from mcaprl.errors import LogError
from mcaprl.files import as_type, fresh_folder, parse_json, read_file, write_json
from mcaprl.storage.remote import RemotePath, as_path, is_url

MANIFEST_NAME = "manifest.json"
UNFINISHED_NAME = ".unfinished"
"""Hidden folder of the logs that are not complete yet."""
_VERSION = "1"


@dataclass(frozen=True)
class LogFile:
    """A log that a manifest lists.

    Attributes:
        name: Name of the file in the folder of the manifest.
        episodes: Number of episodes.
        steps: Number of transitions.
        size_bytes: Size of the file.
    """

    name: str
    episodes: int
    steps: int
    size_bytes: int


@dataclass(frozen=True)
class _Manifest:
    """What is read of a manifest."""

    files: list[LogFile]


def unfinished_folder(folder: Path) -> Path:
    """Create a hidden folder for the unfinished logs of a folder, and return its path."""
    return fresh_folder(folder / UNFINISHED_NAME)


def write_manifest(folder: Path, files: Sequence[LogFile]) -> Path:
    """Write the manifest of a folder, and return its path."""
    path = folder / MANIFEST_NAME
    content = {"manifest_version": _VERSION, "files": [asdict(file) for file in files]}
    write_json(path, content, LogError)
    return path


def is_manifest(name: str | Path) -> bool:
    """Return whether a path or URL has the name of a manifest."""
    return str(name).partition("?")[0].rpartition("/")[2] == MANIFEST_NAME


def listed_logs(name: str | Path) -> list[Path]:
    """Return the logs that a manifest lists, from its path or URL."""
    try:
        files = as_type(_Manifest, parse_json(read_file(as_path(name, whole=True)))).files
        for file in files:
            _check_name(file.name)
    except OSError as error:
        raise LogError(f"cannot read {name}: {error.strerror or error}") from error
    except ValueError as error:
        raise LogError(f"{name} is not a manifest of logs: {error}") from error
    if not files:
        raise LogError(f"{name} lists no files")
    return [_found(name, file) for file in files]


def _check_name(name: str) -> None:
    # The manifest may come from an untrusted source, so it must not name files outside its folder.
    if name != PurePosixPath(name).name or not name.endswith(".mcap") or "\\" in name:
        raise ValueError(f"{name!r} is not the name of a log in its folder")


def _found(manifest: str | Path, file: LogFile) -> Path:
    path: Path
    if is_url(manifest):
        remote = RemotePath.of(f"{str(manifest).partition('?')[0].rpartition('/')[0]}/{file.name}")
        assert remote.remote is not None
        path, size = remote, remote.remote.size
    else:
        path = Path(manifest).with_name(file.name)
        if not path.is_file():
            raise LogError(f"{manifest} lists {file.name}, which is missing")
        size = path.stat().st_size
    if size != file.size_bytes:
        raise LogError(
            f"{path} has {size} bytes, but {manifest} lists {file.size_bytes}: it was changed, or"
            " its copy is not complete; to read it nevertheless, open the folder"
        )
    return path
