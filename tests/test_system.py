"""The commands on a system without what only some systems have: `mcaprl.system` has a fallback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import mcaprl
from mcaprl import system

# A process that looks like one on Windows, as far as this is possible: modules are hidden before
# anything of this package is imported, and functions after the standard library has used them.
HIDDEN = """
import importlib.abc, os, signal, socket, sys, types

class Hide(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "resource", "mcaprl.recorder.columns._native"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in ("fcntl", "resource"):
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hide())
for module, names in {
    os: ("pread", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "geteuid", "fork"),
    socket: ("SO_BINDTODEVICE",),
}.items():
    for name in names:
        vars(module).pop(name, None)

def link(*_arguments, **_options):
    raise OSError("this file system has no links")

os.link = link

from mcaprl import system

# The standard library's processes need masks of signals.
system.signal = types.SimpleNamespace(raise_signal=signal.raise_signal)
system.STOPS, system.END = (signal.SIGINT, signal.SIGTERM), signal.SIGINT
"""
COMMANDS = (
    ["record", "lane", "--episodes", "3", "--max-steps", "30", "--seed", "1", "--out", "log.mcap"],
    ["record", "lane", "--episodes", "1", "--seed", "9", "--append", "--out", "log.mcap"],
    ["record", "racer", "--episodes", "2", "--max-steps", "20", "--envs", "2", "--out", "two"],
    ["info", "log.mcap"],
    ["check", "log.mcap"],
    ["filter", "length > 1", "log.mcap", "kept.mcap"],
    ["convert", "log.mcap", "log.hdf5", "--to", "hdf5"],
    ["convert", "log.hdf5", "back.mcap"],
    ["recover", "log.mcap", "recovered.mcap"],
    ["train-offline", "log.mcap", "--algo", "bc", "--updates", "5", "--out", "run"],
    ["evaluate", "run", "--sim", "lane", "--episodes", "1"],
)


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the commands in one process, and return the folder with what they wrote."""
    folder = tmp_path_factory.mktemp("elsewhere")
    code = f"""{HIDDEN}
if __name__ == "__main__":
    assert system.fcntl is None and not system.HAS_FOLDER_DESCRIPTORS
    assert system.memory_maps() is None and system.udp_sockets() is None
    import json
    from mcaprl.cli import run
    print(json.dumps([run(list(each)) for each in json.loads({json.dumps(json.dumps(COMMANDS))})]))
"""
    (folder / "program.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "program.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    codes = json.loads(done.stdout.splitlines()[-1])
    assert codes == [0] * len(COMMANDS), done.stdout + done.stderr
    return folder


def test_the_commands_work_without_what_posix_has(there: Path) -> None:
    assert len(mcaprl.open(there / "log.mcap").episodes) == 4
    assert len(mcaprl.open(there / "two").episodes) == 2
    written = (there / "recovered.mcap", there / "back.mcap", there / "kept.mcap")
    assert [len(mcaprl.open(one).episodes) for one in written] == [4, 4, 4]


def test_the_logs_are_those_of_this_system(there: Path, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="limit of 30 steps"):
        mcaprl.record("lane", tmp_path / "log.mcap", episodes=3, max_steps=30, seed=1)
    here, elsewhere = mcaprl.open(tmp_path / "log.mcap"), mcaprl.open(there / "log.mcap")
    assert (here.actions == elsewhere.actions[: len(here)]).all()
    assert (here.rewards == elsewhere.rewards[: len(here)]).all()


def test_a_log_is_kept_by_a_copy_where_files_cannot_be_linked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = pytest.importorskip("mcaprl.online.recording")
    monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError("no links")))
    (tmp_path / "log").write_bytes(b"all")
    recording._keep(tmp_path / "log", tmp_path / "log.uncut")
    (tmp_path / "log").write_bytes(b"cut")
    assert (tmp_path / "log.uncut").read_bytes() == b"all"


@pytest.mark.parametrize("display", ["", ":0"])
def test_images_are_rendered_without_a_display(
    monkeypatch: pytest.MonkeyPatch, display: str
) -> None:
    for name in ("WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("DISPLAY", display)
    mcaprl.make_sim("CartPole-v1", render_mode="rgb_array").close()
    assert os.environ.get("SDL_VIDEODRIVER") == (None if display else "dummy")


def test_bytes_are_read_at_a_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"0123456789")
    descriptor = os.open(tmp_path / "file", os.O_RDONLY)
    os.lseek(descriptor, 7, os.SEEK_SET)
    for _ in range(2):
        assert system.read_at(descriptor, 3, 2) == b"234"
        assert os.lseek(descriptor, 0, os.SEEK_CUR) == 7
        monkeypatch.delattr(os, "pread", raising=False)
    os.close(descriptor)
