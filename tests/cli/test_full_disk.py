"""Commands on a full disk print one line, and keep all finished output."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import shutil
import sys
import warnings
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

import mcaprl
from mcaprl.cli import main, run

resource = pytest.importorskip("resource", reason="needs limits on the size of files")

LOG, POLICY, LANE = "cartpole.mcap", "bc", "lane.mcap"
SMALL = ["--hidden", "8", "--checkpoint-interval", "50"]
OFTEN = ["--log-interval", "1", "--updates", "30"]
CARTPOLE = ["record", "CartPole-v1", "--steps", "9999", "--policy", "random"]
ONLINE = ["train-online", "CartPole-v1", "--algo", "dqn", "--steps", "300", "--out", "run", *SMALL]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a log and a policy."""
    folder = tmp_path_factory.mktemp("inputs")
    log = str(folder / LOG)
    record = ["record", "CartPole-v1", "--policy", "random", "--episodes", "100", "--out", log]
    assert run(record) == 0
    mcaprl.record("lane", folder / LANE, episodes=20, epsilon=0.5)
    policy = str(folder / POLICY)
    train = ["train-offline", log, "--algo", "bc", "--updates", "5", "--out", policy, *SMALL]
    assert run(train) == 0
    return folder


def limited(limit: int, command: Sequence[str], folder: Path, errors: Connection) -> None:
    """Run a command in `folder`, and send its messages to `errors`.

    The limit on the size of files simulates a full disk. Python ignores SIGXFSZ, so a write raises.
    """
    # The limit also holds for the caches of compiled code, which would be cut off.
    sys.dont_write_bytecode = True
    os.chdir(folder)
    with contextlib.redirect_stderr(io.StringIO()) as text:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            main(command)
        finally:
            errors.send(text.getvalue())


@pytest.mark.parametrize(
    ("limit", "command", "path"),
    [
        (20_000, CARTPOLE, "x.mcap"),
        (100_000, ["record", "lane", "--steps", "9999", "--policy", "random"], "x.mcap"),
        (20_000, [*CARTPOLE, "--envs", "2"], "x/shard-0"),
        (20_000, ["annotate", LOG, "--policy", POLICY], "x.mcap"),
        (2_000, ["recover", LOG], "x.mcap"),
        (10, ["layout", LOG], "x.json"),
        (20_000, ["split", LOG, "x", "--episodes", "60"], "x"),
        (20_000, ["convert", LOG, "x.npz"], "x.npz"),
        (20_000, ["convert", LOG, "x.hdf5"], "x.hdf5"),
        (20_000, ["convert", LOG, "x.h5", "--to", "d3rlpy", "--lossy"], "x.h5"),
        (20_000, ["convert", LOG, "x-v0", "--to", "minari", "--lossy"], "x-v0"),
        (2_000, ["convert", LOG, "x", "--to", "parquet"], "x"),
        *(
            (limit, ["convert", LANE, name, "--to", form, "--lossy"], name)
            for limit in (2_000, 20_000, 40_000)
            for name, form in (("x-v0", "minari"), ("x.hdf5", "hdf5"), ("x.h5", "d3rlpy"))
        ),
        (70_000, ["convert", LANE, "x-v0", "--to", "minari", "--lossy"], "x-v0"),
        (2_000, ["convert", LANE, "x", "--to", "lerobot", "--lossy"], "x"),
        (2_000, ["convert", LANE, "x.npz", "--lossy"], "x.npz"),
        (2_000, ["info", LOG, "--report"], "x"),
        (2_000, ["train-offline", LOG, *SMALL], "x/seed-0/"),
        (1_000, ["train-offline", LOG, *SMALL, *OFTEN], "x/seed-0/metrics.csv"),
        (2_000, ONLINE, "run/seed-0/"),
        (5_000, [*ONLINE, "--record", "x.mcap"], "x.mcap"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_a_full_disk_is_one_line(
    limit: int,
    command: list[str],
    path: str,
    inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(shutil.copytree(inputs, tmp_path / "folder"))
    out = path.split("/")[0]
    if command[0] in ("recover", "info"):
        command = [*command, out]
    elif command[0] not in ("convert", "split") and "run" not in command:
        command = [*command, "--out", out]
    # A fork of a process that has imported everything starts sooner than a new process.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "mcaprl.online.train"])
    receiver, sender = context.Pipe(duplex=False)
    # On a busy machine, lines of progress would be printed too.
    arguments = (limit, [*command, "--quiet"], Path.cwd(), sender)
    process = context.Process(target=limited, args=arguments)
    process.start()
    text = receiver.recv()
    process.join()
    notes = ("mcaprl: warning:", "compiling ")
    lines = [line for line in text.splitlines() if line and not line.startswith(notes)]
    assert process.exitcode == 1, text
    assert len(lines) == 1, text
    assert lines[0].startswith("mcaprl: cannot write "), lines
    assert path in lines[0]
    # The reason is that of the system, not a sentence of a library.
    assert lines[0].endswith(("File too large", "everything written before is in the file")), lines
    assert ".part" not in lines[0], "the path of the user, not that of a temporary file"
    assert not list(Path().glob(".*.part")), "temporary files are removed"
    if command[0] == "record":
        found = sorted(Path().glob("x*/*.mcap")) or [Path("x.mcap")]
        # One shard reaches its limit first. The other is interrupted, perhaps before the end of its
        # first episode.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*(cut off|no finished episode)")
            assert len(mcaprl.open(found).episodes) > 0
