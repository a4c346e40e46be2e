"""Commands neither follow, empty nor remove what other programs put at the paths of their files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from mcaprl.cli import run

pytest.importorskip("stable_baselines3", reason="needs the extra online")
if not hasattr(os, "geteuid"):
    pytest.skip("needs links and users", allow_module_level=True)

SMALL = ["--hidden", "8", "--checkpoint-interval", "5"]
BC = ["--algo", "bc", "--updates", "5", *SMALL]
ONLINE = ["train-online", "CartPole-v1", "--algo", "dqn", "--steps", "60", *SMALL]
RANDOM = ["CartPole-v1", "--policy", "random", "--episodes", "1"]
# Each command, and the file or folder that it writes first through a work folder.
COMMANDS = {
    "record": (["record", *RANDOM, "--out", "x.mcap"], "x.mcap"),
    "append": (
        ["record", *RANDOM, "--append", "--out", "log.mcap"],
        "log.mcap",
    ),
    "convert": (["convert", "log.mcap", "x.npz"], "x.npz"),
    "convert to a folder": (["convert", "log.mcap", "x", "--to", "parquet"], "x"),
    "merge": (["merge", "log.mcap", "log2.mcap", "x.mcap", "--shift"], "x.mcap"),
    "filter": (["filter", "length > 0", "log.mcap", "x.mcap"], "x.mcap"),
    "slice": (["slice", "log.mcap", "x.mcap", "--steps", "0:5"], "x.mcap"),
    "relabel": (["relabel", "log.mcap", "x.mcap", "--reward", "2 * reward"], "x.mcap"),
    "label": (["label", "log.mcap", "--episode", "0", "--success"], "log.mcap.labels.json"),
    "split": (["split", "log.mcap", "x", "--episodes", "1"], "x"),
    "recover": (["recover", "log.mcap", "x.mcap"], "x.mcap"),
    "annotate": (["annotate", "log.mcap", "--policy", "bc", "--out", "x.mcap"], "x.mcap"),
    "layout": (["layout", "log.mcap", "--out", "x.json"], "x.json"),
    "save": (["replay", "log.mcap", "--save", "x.html"], "x.html"),
    "report": (["info", "log.mcap", "--report", "x"], "x/index.html"),
    "export": (["export", "bc", "--out", "x.onnx"], "x.onnx"),
    "train-offline": (
        ["train-offline", "log.mcap", *BC, "--out", "run", "--resume"],
        "run/config.json",
    ),
    "checkpoint": (
        ["train-offline", "log.mcap", *BC, "--out", "run", "--resume"],
        "run/seed-0/checkpoint.safetensors",
    ),
    "metrics": (
        ["train-offline", "log.mcap", *BC, "--out", "run", "--resume"],
        "run/seed-0/metrics.csv",
    ),
    "train-online": ([*ONLINE, "--out", "dqn", "--resume"], "dqn/config.json"),
    "curve": ([*ONLINE, "--out", "dqn", "--resume"], "dqn/seed-0/curve.csv"),
    "best": ([*ONLINE, "--out", "dqn", "--resume"], "dqn/seed-0/best_model.zip"),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two logs and a policy."""
    folder = tmp_path_factory.mktemp("inputs")
    for name in ("log", "log2"):
        record = ["record", "CartPole-v1", "--policy", "random", "--episodes", "3"]
        assert run([*record, "--out", str(folder / f"{name}.mcap")]) == 0
    train = ["train-offline", str(folder / "log.mcap"), *BC, "--out", str(folder / "bc")]
    assert run(train) == 0
    assert run([*ONLINE, "--out", str(folder / "dqn")]) == 0
    shutil.copytree(folder / "bc", folder / "run")
    for name in ("run", "dqn"):
        # Each run starts again.
        for path in (folder / name / "seed-0").iterdir():
            path.unlink()
    return folder


@pytest.fixture
def folder(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, a copy of the inputs; beside it is the folder `precious`."""
    precious = tmp_path / "precious"
    (precious / "sub").mkdir(parents=True)
    (precious / "thesis.tex").write_text("text")
    (precious / "sub" / "y").write_text("y")
    monkeypatch.chdir(shutil.copytree(inputs, tmp_path / "folder"))
    return Path.cwd()


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else ""
        for path in folder.rglob("*")
    }


def link_to_folder(place: Path, precious: Path) -> None:
    place.symlink_to(precious)


def link_to_file(place: Path, precious: Path) -> None:
    place.symlink_to(precious / "thesis.tex")


def dangling_link(place: Path, precious: Path) -> None:
    place.symlink_to(precious / "missing")


def fifo(place: Path, precious: Path) -> None:
    os.mkfifo(place)


def file(place: Path, precious: Path) -> None:
    place.write_text("precious")


def folder_of_others(place: Path, precious: Path) -> None:
    shutil.copytree(precious, place)


def folder_of_another_user(place: Path, precious: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a folder to another user")
    place.mkdir()
    (place / ".mcaprl-work-folder").touch()
    os.chown(place, 12345, 12345)


KINDS = [
    link_to_folder,
    link_to_file,
    dangling_link,
    fifo,
    file,
    folder_of_others,
    folder_of_another_user,
]
Plant = Callable[[Path, Path], None]


def work_folder_of(target: str) -> Path:
    path = Path(target)
    return path.with_name(f".{path.name}.part")


def assert_is_refused(
    command: list[str], place: Path, precious: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, state = contents(precious), place.lstat()
    held = contents(place) if place.is_dir() else None
    capsys.readouterr()
    assert run([*command, "--quiet"]) != 0
    lines = [
        line for line in capsys.readouterr().err.splitlines() if line and "warning:" not in line
    ]
    assert len(lines) == 1, lines
    assert place.name in lines[0], lines
    assert "Traceback" not in lines[0]
    after = place.lstat()
    assert (after.st_mode, after.st_ino, after.st_uid) == (
        state.st_mode,
        state.st_ino,
        state.st_uid,
    )
    assert contents(precious) == before
    assert held is None or contents(place) == held


@pytest.mark.parametrize("name", COMMANDS)
def test_a_link_at_the_work_folder_is_refused(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, target = COMMANDS[name]
    place, precious = work_folder_of(target), folder.parent / "precious"
    place.parent.mkdir(exist_ok=True)
    link_to_folder(place, precious)
    assert_is_refused(command, place, precious, capsys)


@pytest.mark.parametrize("plant", KINDS)
@pytest.mark.parametrize("name", ["record", "slice", "split", "layout"])
def test_nothing_at_the_work_folder_is_touched(
    name: str, plant: Plant, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, target = COMMANDS[name]
    place, precious = work_folder_of(target), folder.parent / "precious"
    plant(place, precious)
    assert_is_refused(command, place, precious, capsys)


def test_a_link_to_another_file_system(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = Path("/dev/shm")
    if not os.access(other, os.W_OK) or other.stat().st_dev == folder.stat().st_dev:
        pytest.skip("there is no second file system")
    precious = other / f"mcaprl-test-{os.getpid()}"
    shutil.copytree(folder.parent / "precious", precious)
    try:
        place = work_folder_of("x.mcap")
        link_to_folder(place, precious)
        assert_is_refused(COMMANDS["slice"][0], place, precious, capsys)
    finally:
        shutil.rmtree(precious)


@pytest.mark.parametrize("plant", [link_to_folder, link_to_file, dangling_link, fifo, file])
@pytest.mark.parametrize("name", ["seed-0", "seed-1"])
def test_a_planted_seed_folder_is_refused(
    name: str, plant: Plant, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, precious = Path("run") / name, folder.parent / "precious"
    if place.exists():
        shutil.rmtree(place)
    plant(place, precious)
    command = ["train-offline", "log.mcap", *BC, "--out", "run", "--seeds", "2", "--resume"]
    assert_is_refused(command, place, precious, capsys)


def test_leftovers_of_earlier_versions_are_used(folder: Path) -> None:
    """Earlier versions made no mark; their work folders contain nothing but the target."""
    place = work_folder_of("x.mcap")
    place.mkdir()
    (place / "x.mcap").write_text("half")
    assert run(COMMANDS["slice"][0]) == 0
    assert not place.exists()
