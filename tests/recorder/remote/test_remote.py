"""Logs at URLs: the same data as local logs, few requests, and clear errors."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl import limits
from mcaprl.cli import run
from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.storage.remote import BLOCK_BYTES, CACHE_VARIABLE, RemoteFile, RemotePath, upload
from tests.recorder.remote.range_server import RangeServer, range_server

fsspec = pytest.importorskip("fsspec", reason="needs the extra remote")
pytest.importorskip("aiohttp", reason="needs the extra remote")

EPISODES, STEPS = 50, 40
# Python 3.12 and later warn of a fork of a process with threads, such as the server's.
IN_THREADS = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a log of random images, which cannot be compressed."""
    found = tmp_path_factory.mktemp("served")
    random = np.random.default_rng(0)
    count = EPISODES * STEPS
    images = random.integers(0, 256, (count + EPISODES, 32, 32, 3), np.uint8)
    rows = np.arange(count) + np.repeat(np.arange(EPISODES), STEPS)
    ends = np.arange(1, count + 1) % STEPS == 0
    mcaprl.Dataset.from_arrays(
        observations=images[rows],
        next_observations=images[rows + 1],
        actions=random.integers(3, size=count),
        rewards=random.standard_normal(count),
        terminated=ends,
        truncated=np.zeros(count, bool),
    ).save(found / "images.mcap")
    mcaprl.record("lane", found / "lane.mcap", episodes=2, epsilon=0.3)
    return found


@pytest.fixture
def server(folder: Path) -> Iterator[RangeServer]:
    with range_server(folder) as found:
        yield found


def test_a_remote_log_is_equal_to_the_local_one(server: RangeServer) -> None:
    for name in ("images.mcap", "lane.mcap"):
        remote, local = (mcaprl.open(f"{place}/{name}") for place in (server.url, server.folder))
        assert remote.fingerprint == local.fingerprint
        assert str(remote.sources[0]) == f"{server.url}/{name}"


def test_one_episode_needs_few_requests_and_bytes(server: RangeServer) -> None:
    url, size = f"{server.url}/images.mcap", (server.folder / "images.mcap").stat().st_size
    found = mcaprl.open(url, episodes=25)
    assert found.fingerprint == mcaprl.open(server.folder / "images.mcap", episodes=25).fingerprint
    # There are requests for three parts: the start and the summary of the file; the chunks of
    # `/rl/episode` and `/rl/step`; and the chunks of images.
    assert len(server.sent) <= 7
    assert sum(server.sent) < 0.3 * size
    # A chunk of images contains 50 images or more.
    assert sum(server.sent) < 100 * 32 * 32 * 3 + 12 * BLOCK_BYTES


def test_all_parts_are_fetched_once(server: RangeServer) -> None:
    mcaprl.open(f"{server.url}/images.mcap")
    size = (server.folder / "images.mcap").stat().st_size
    assert sum(server.sent) <= size
    assert len(server.sent) <= 12


def test_fetched_parts_are_kept_on_request(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    url = f"{server.url}/images.mcap"
    first = mcaprl.open(url, episodes=[3, 4]).fingerprint
    server.sent.clear()
    assert mcaprl.open(url, episodes=[3, 4]).fingerprint == first
    assert server.sent == []
    # Parts of an old version of a file are not used for a new version.
    other = server.folder / "other.mcap"
    mcaprl.record("lane", other, episodes=1)
    before = mcaprl.open(f"{server.url}/other.mcap").fingerprint
    mcaprl.record("lane", other, episodes=2, seed=5, overwrite=True)
    assert mcaprl.open(f"{server.url}/other.mcap").fingerprint != before
    other.unlink()


def read_at_once(barrier: Barrier, url: str, results: Queue[str]) -> None:
    """Open a log at the same time as other processes."""
    barrier.wait(60)
    try:
        results.put(mcaprl.open(url).fingerprint)
    except LogError as error:
        results.put(str(error))


def test_several_processes_fill_the_same_cache(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    url, context = f"{server.url}/images.mcap", multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(4), context.Queue()
    arguments = (barrier, url, results)
    processes = [context.Process(target=read_at_once, args=arguments) for _ in range(4)]
    for process in processes:
        process.start()
    found = {results.get(timeout=120) for _ in processes}
    for process in processes:
        process.join(60)
    assert found == {mcaprl.open(server.folder / "images.mcap").fingerprint}
    server.sent.clear()
    assert mcaprl.open(url).fingerprint in found
    assert server.sent == []


def test_a_cached_file_is_not_emptied_while_it_is_filled(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    url, content = f"{server.url}/images.mcap", (server.folder / "images.mcap").read_bytes()
    first, second = RemoteFile(url), RemoteFile(url)
    first.fetch([(0, BLOCK_BYTES)])
    second.fetch([(5 * BLOCK_BYTES, 6 * BLOCK_BYTES)])
    third = RemoteFile(url)
    server.sent.clear()
    third.fetch([(0, BLOCK_BYTES), (5 * BLOCK_BYTES, 6 * BLOCK_BYTES)])
    assert server.sent == []
    assert third.local.read_bytes()[:BLOCK_BYTES] == content[:BLOCK_BYTES]
    # The marks of a file that was removed are not valid for the next one.
    third.local.unlink()
    RemoteFile(url).fetch([(0, BLOCK_BYTES)])
    last = RemoteFile(url)
    last.fetch([(0, last.size)])
    assert last.local.read_bytes() == content


def test_commands_read_urls(server: RangeServer, capsys: pytest.CaptureFixture[str]) -> None:
    url = f"{server.url}/lane.mcap"
    assert run(["info", url]) == 0
    assert url in capsys.readouterr().out
    assert run(["check", url]) == 0
    assert "1 file checked, no problems" in capsys.readouterr().out
    assert run(["evaluate", "random", "--data", url, "--updates", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["data"] == url


def test_memory_and_file_systems(folder: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    for name in ("a.mcap", "b.mcap"):
        memory.put_file(str(folder / "lane.mcap"), f"/logs/{name}")
    expected = mcaprl.open(folder / "lane.mcap")
    assert mcaprl.open("memory://logs/a.mcap").fingerprint == expected.fingerprint
    assert len(mcaprl.open("memory://logs")) == 2 * len(expected)
    assert len(mcaprl.open("memory://logs/*.mcap")) == 2 * len(expected)
    assert len(mcaprl.open(["memory://logs/a.mcap", folder / "lane.mcap"])) == 2 * len(expected)
    twice = ["memory:///logs/a.mcap", "memory://logs/*.mcap", "memory:///logs/a.mcap"]
    assert len(mcaprl.open(twice)) == 2 * len(expected)
    url = f"file://{folder}/lane.mcap"
    assert mcaprl.open(url).fingerprint == expected.fingerprint
    memory.rm("/logs", recursive=True)


def test_a_url_that_is_listed_twice_is_read_once(server: RangeServer) -> None:
    url, expected = f"{server.url}/lane.mcap", mcaprl.open(server.folder / "lane.mcap")
    for sends_dates in (True, False):
        server.sends_dates = sends_dates
        assert len(mcaprl.open([url, url])) == len(expected)


def test_errors_are_one_clear_line(server: RangeServer, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"cannot read http.*/none.mcap: no such file"):
        mcaprl.open(f"{server.url}/none.mcap")
    with pytest.raises(LogError, match=r"memory://nothing: no such file, folder or match|no such"):
        mcaprl.open("memory://nothing")
    with pytest.raises(LogError, match=r"cannot open nonsense://a.mcap: Protocol not known"):
        mcaprl.open("nonsense://a.mcap")
    server.refusal = 403
    with pytest.raises(LogError, match=r"cannot read http.*/none.mcap: 403"):
        mcaprl.open(f"{server.url}/none.mcap")
    with socket.socket() as unused:
        # The port is bound, but nothing listens to it.
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}/a.mcap"
        with pytest.raises(LogError, match=rf"cannot read {url}: Cannot connect to host"):
            mcaprl.open(url)
    (server.folder / "text.mcap").write_text("no log" * 100)
    with pytest.raises(LogError, match=r"http.*/text.mcap is not an MCAP file"):
        mcaprl.open(f"{server.url}/text.mcap")
    (server.folder / "text.mcap").unlink()


def test_a_server_without_ranges_is_refused(server: RangeServer) -> None:
    server.knows_ranges = False
    with pytest.raises(LogError, match="ignores ranges; download it first"):
        mcaprl.open(f"{server.url}/images.mcap", episodes=0)


def test_a_connection_that_breaks_is_an_error(server: RangeServer) -> None:
    server.cuts = True
    with pytest.raises(LogError, match=r"cannot read http.*/images.mcap"):
        mcaprl.open(f"{server.url}/images.mcap")


def test_a_file_that_changes_is_noticed(server: RangeServer) -> None:
    path = server.folder / "grows.mcap"
    mcaprl.record("lane", path, episodes=1)
    remote = RemotePath.of(f"{server.url}/grows.mcap").remote
    assert remote is not None
    remote.check_unchanged()
    mcaprl.record("lane", path, episodes=3, overwrite=True)
    with pytest.raises(LogError, match="has changed while it was read"):
        remote.check_unchanged()
    path.unlink()


@pytest.mark.parametrize("sends_dates", [True, False])
def test_a_change_to_other_bytes_of_the_same_size(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sends_dates: bool
) -> None:
    """The time of the last change identifies a version; without it, no parts are kept."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    server.sends_dates = sends_dates
    path = server.folder / "changes.mcap"
    for value in (b"a", b"b"):
        path.write_bytes(100 * value)
        os.utime(path, (ord(value), ord(value)))
        remote = RemoteFile(f"{server.url}/changes.mcap")
        remote.check_unchanged()
        remote.fetch([(0, 100)])
        assert remote.local.read_bytes() == path.read_bytes()
    if sends_dates:
        os.utime(path, (0, 0))
        with pytest.raises(LogError, match="has changed while it was read"):
            remote.check_unchanged()
    path.unlink()


def test_a_path_is_opened_again_in_another_process(server: RangeServer) -> None:
    path = RemotePath.of(f"{server.url}/lane.mcap")
    assert str(pickle.loads(pickle.dumps(path))) == str(path)


@IN_THREADS
def test_forked_workers_stream_a_url(server: RangeServer) -> None:
    torch = pytest.importorskip("torch")
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs fork")
    import mcaprl.torch as loading

    stream = loading.TransitionStream(f"{server.url}/images.mcap", batch_size=100, seed=1)
    options = {"num_workers": 2, "multiprocessing_context": "fork", "timeout": 60}
    batches = list(torch.utils.data.DataLoader(stream, batch_size=None, **options))
    rewards = torch.cat([batch["reward"] for batch in batches]).numpy()
    episodes = mcaprl.open(server.folder / "images.mcap").episodes
    expected = np.concatenate([episode.rewards for episode in episodes])
    np.testing.assert_array_equal(np.sort(rewards), np.sort(expected).astype(np.float32))


def test_local_copies_are_removed_when_they_are_not_used(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    url, content = f"{server.url}/lane.mcap", (server.folder / "lane.mcap").read_bytes()
    first, second = RemotePath.of(url), RemotePath.of(url)
    assert first.remote is second.remote
    reader = McapReader(first)
    assert reader.view == content
    assert len(list(tmp_path.iterdir())) == 1
    del first, second, reader
    assert list(tmp_path.iterdir()) == []


@IN_THREADS
def test_a_process_removes_only_its_own_copies(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs fork")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    url, files = f"{server.url}/lane.mcap", dict[str, RemotePath]()
    files["parent"] = RemotePath.of(url)
    before = list(tmp_path.iterdir())

    def open_and_exit() -> None:
        files["child"] = RemotePath.of(url)
        del files["parent"]

    process = multiprocessing.get_context("fork").Process(target=open_and_exit, daemon=True)
    process.start()
    process.join(60)
    assert process.exitcode == 0
    assert list(tmp_path.iterdir()) == before


def test_uploads_appear_when_complete(folder: Path, tmp_path: Path) -> None:
    url = f"file://{tmp_path}/there/lane.mcap"
    upload(folder / "lane.mcap", url)
    assert (tmp_path / "there" / "lane.mcap").read_bytes() == (folder / "lane.mcap").read_bytes()
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["lane.mcap"]
    assert mcaprl.layout(url) == mcaprl.layout(folder / "lane.mcap")
    out = tmp_path / "out.mcap"
    mcaprl.record("lane", out, episodes=1, upload=f"file://{tmp_path}/there/new.mcap")
    assert (tmp_path / "there" / "new.mcap").read_bytes() == out.read_bytes()
    with pytest.raises(OutputExistsError, match=r"new.mcap exists: choose another URL"):
        mcaprl.record(
            "lane", tmp_path / "x.mcap", upload=f"file://{tmp_path}/there/new.mcap", episodes=1
        )
    with pytest.raises(UsageError, match="can only be read"):
        mcaprl.record("lane", tmp_path / "x.mcap", episodes=1, upload="https://host/x.mcap")
    assert not (tmp_path / "x.mcap").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot upload"):
        upload(out, f"file://{tmp_path}/file/below.mcap")


def test_online_training_uploads_its_log(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra online")
    url, log = f"file://{tmp_path}/there/online.mcap", tmp_path / "online.mcap"
    train = ["train-online", "CartPole-v1", "--algo", "dqn", "--steps", "200", "--hidden", "8"]
    assert run([*train, "--out", str(tmp_path / "run"), "--upload", url]) == 2
    request = ["--out", str(tmp_path / "run"), "--record", str(log), "--upload", url]
    assert run([*train, *request]) == 0
    assert (tmp_path / "there" / "online.mcap").read_bytes() == log.read_bytes()


Answer = Callable[[socket.socket, bytes], None]


@contextmanager
def raw_server(answer: Answer) -> Iterator[str]:
    """Answer each request with bytes of the test; yield the URL of a log."""
    listener = socket.create_server(("127.0.0.1", 0))
    ended = threading.Event()

    def talk(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            while head := connection.recv(2**16):
                answer(connection, head)

    def listen() -> None:
        with suppress(OSError):
            while not ended.is_set():
                threading.Thread(target=talk, args=listener.accept()[:1], daemon=True).start()

    threading.Thread(target=listen, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/a.mcap"
    finally:
        ended.set()
        listener.close()


def head_of(size: int, *lines: str, status: str = "200 OK") -> bytes:
    every = [f"HTTP/1.1 {status}", f"Content-Length: {size}", "Accept-Ranges: bytes", *lines]
    return "\r\n".join([*every, "", ""]).encode()


def test_a_range_answer_without_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = [0]

    def answer(connection: socket.socket, head: bytes) -> None:
        if head.startswith(b"HEAD"):
            connection.sendall(head_of(10**6))
            return
        connection.sendall(b"HTTP/1.1 206 Partial Content\r\nConnection: close\r\n\r\n")
        while True:
            connection.sendall(bytes(2**16))
            sent[0] += 2**16

    with raw_server(answer) as url, pytest.raises(LogError, match=r"more than the \d+ bytes"):
        mcaprl.open(url)
    # What is on its way when the client closes the connection is in the buffers of the sockets.
    assert sent[0] < 100 * 2**20


@pytest.mark.parametrize("size", [2**43, 10**18, 10**40, -1])
def test_an_absurd_size_is_refused(size: int) -> None:
    def answer(connection: socket.socket, head: bytes) -> None:
        connection.sendall(head_of(size))

    with raw_server(answer) as url, pytest.raises(LogError, match=f"cannot read {url}") as caught:
        mcaprl.open(url)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("status", "lines", "message"),
    [
        ("200 OK", (), r"status 200\) is not the requested range"),
        ("206 Partial", ("Content-Range: bytes 7-100/9",), "is not the requested range"),
        ("206 Partial", ("Content-Encoding: gzip",), "is not the requested range"),
        ("404 Not Found", (), "no such file"),
        ("503 Busy", (), "503"),
        ("416 Range", (), "416"),
    ],
)
def test_an_answer_of_another_kind_is_refused(
    status: str, lines: tuple[str, ...], message: str
) -> None:
    def answer(connection: socket.socket, head: bytes) -> None:
        if head.startswith(b"HEAD"):
            connection.sendall(head_of(10**7))
        elif b"bytes=0-" in head and status.startswith("200"):
            connection.sendall(head_of(BLOCK_BYTES, status="206 Partial") + bytes(BLOCK_BYTES))
        else:
            connection.sendall(head_of(BLOCK_BYTES, *lines, status=status) + bytes(BLOCK_BYTES))

    with raw_server(answer) as url, pytest.raises(LogError, match=message):
        mcaprl.open(url)


def silent(connection: socket.socket, head: bytes) -> None:
    """Answer nothing."""


def silent_after_the_head(connection: socket.socket, head: bytes) -> None:
    connection.sendall(head_of(10**6))


def dripping_head(connection: socket.socket, head: bytes) -> None:
    connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    while True:
        connection.sendall(b"x")
        time.sleep(0.01)


def dripping(connection: socket.socket, head: bytes) -> None:
    if head.startswith(b"HEAD"):
        connection.sendall(head_of(10**6))
        return
    connection.sendall(head_of(BLOCK_BYTES, status="206 Partial Content"))
    while True:
        connection.sendall(b"x")
        time.sleep(0.01)


@pytest.mark.parametrize("answer", [silent, silent_after_the_head, dripping_head, dripping])
def test_a_server_that_is_silent_or_slow_is_left(
    answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("SILENCE_TIMEOUT_S", "SLOW_AFTER_S", "CONNECT_TIMEOUT_S"):
        monkeypatch.setattr(limits, name, 0.2)
    began_s = time.monotonic()
    with raw_server(answer) as url, pytest.raises(LogError, match=r"no answer within|arrived in"):
        mcaprl.open(url)
    assert time.monotonic() - began_s < 5


def test_many_ranges_are_requested_in_groups(
    server: RangeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_REQUESTS", 2)
    monkeypatch.setattr(limits, "MAX_FETCHED_BYTES", BLOCK_BYTES)
    remote = RemoteFile(f"{server.url}/images.mcap")
    remote.fetch([(4 * k * BLOCK_BYTES, 4 * k * BLOCK_BYTES + 1) for k in range(7)])
    content = (server.folder / "images.mcap").read_bytes()
    for k in range(7):
        part = slice(4 * k * BLOCK_BYTES, (4 * k + 1) * BLOCK_BYTES)
        assert remote.local.read_bytes()[part] == content[part]


def test_a_link_in_the_cache_is_refused(
    server: RangeServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    precious, cache = tmp_path / "precious", tmp_path / "cache"
    precious.write_text("text")
    monkeypatch.setenv(CACHE_VARIABLE, str(cache))
    url = f"{server.url}/lane.mcap"
    local = RemoteFile(url).local
    for path in (local, local.with_name("blocks")):
        path.unlink()
        path.symlink_to(precious)
        with pytest.raises(UsageError, match=f"{path} is not a regular file"):
            mcaprl.open(url)
        path.unlink()
    folder = local.parent
    shutil.rmtree(folder)
    folder.symlink_to(tmp_path)
    with pytest.raises(UsageError, match=f"{folder} is a symbolic link"):
        mcaprl.open(url)
    assert precious.read_text() == "text"


def test_a_link_at_the_copy_of_an_upload_is_refused(folder: Path, tmp_path: Path) -> None:
    there, precious = tmp_path / "there", tmp_path / "precious"
    there.mkdir()
    precious.write_text("text")
    for name in ("x.mcap.part", "x.mcap", ".x.mcap.part"):
        (there / name).symlink_to(precious)
        if name == "x.mcap.part":
            upload(folder / "lane.mcap", f"file://{there}/x.mcap")
            (there / "x.mcap").unlink()
        else:
            with pytest.raises(UsageError, match="is a symbolic link"):
                upload(folder / "lane.mcap", f"file://{there}/x.mcap")
        assert (there / name).is_symlink()
        assert precious.read_text() == "text"
        (there / name).unlink()
