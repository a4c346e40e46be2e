"""A FIFO, device, socket or folder in the place of a file is one error, and is not waited for."""

from __future__ import annotations

import json
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from mcaprl.cli import run

if not hasattr(os, "mkfifo"):
    pytest.skip("needs FIFOs", allow_module_level=True)


@pytest.fixture(autouse=True)
def no_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Raise an error in a test that waits."""

    def stop(*_: object) -> None:
        raise AssertionError("the command waits")

    monkeypatch.chdir(tmp_path)
    earlier = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, earlier)


def place(kind: str, path: Path) -> Path:
    """Put a special file at a path; return the path to open."""
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "link to a fifo":
            os.mkfifo(path.with_name("fifo"))
            path.symlink_to("fifo")
        case "socket":
            with socket.socket(socket.AF_UNIX) as opened:
                opened.bind(path.name)
        case "device":
            return Path("/dev/zero")
        case "folder":
            path.mkdir()
    return path


def assert_one_line(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert run([*command, "--quiet"]) != 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("mcaprl: ")
    return lines[0]


COMMANDS = {
    "info": ["info", "{}"],
    "convert": ["convert", "{}", "out.mcap"],
    "suggest": ["convert", "{}", "--suggest"],
    "recover": ["recover", "{}", "out.mcap"],
    "merge": ["merge", "{}", "{}", "out.mcap"],
    "slice": ["slice", "{}", "out.mcap", "--steps", "0:1"],
    "label": ["label", "{}", "--episode", "0", "--success"],
    "relabel": ["relabel", "{}", "out.mcap", "--reward", "reward"],
    "train-offline": ["train-offline", "{}", "--out", "run"],
    "evaluate": ["evaluate", "random", "--data", "{}"],
    "layout": ["layout", "{}", "--out", "layout.json"],
    "policy": ["evaluate", "{}", "--sim", "lane"],
    "export": ["export", "{}", "--out", "policy.onnx"],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", ["x", "x.mcap"])
def test_a_fifo_is_one_error(
    name: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = place("fifo", tmp_path / name)
    arguments = [one.format(found) for one in COMMANDS[command]]
    assert "x" in assert_one_line(arguments, capsys)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_fifo_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = place("fifo", tmp_path / "x")
    assert run(["check", str(found)]) == 1
    assert f"cannot read {found}: it is not a regular file" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["x", "x.mcap", "x.npz", "x.hdf5", "x.h5", "x.bag", "x.db3"])
@pytest.mark.parametrize("kind", ["fifo", "link to a fifo", "socket", "device", "folder"])
@pytest.mark.parametrize("command", ["info", "convert"])
def test_special_files_are_one_error(
    command: str, kind: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = place(kind, tmp_path / name)
    assert_one_line([one.format(found) for one in COMMANDS[command]], capsys)


MAPPING = "observation: {x: {topic: /x, field: y}}\nrate_hz: 10\n"


@pytest.mark.parametrize("name", ["x", "x.mcap", "x.bag", "x.db3", "x.mcap.zstd"])
@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_special_bags_are_one_error(
    kind: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = place(kind, tmp_path / name)
    (tmp_path / "map.yaml").write_text(MAPPING)
    assert_one_line(["info", str(found), "--mapping", "map.yaml"], capsys)


@pytest.mark.parametrize(
    "path",
    [
        "meta/info.json",
        "data/metadata.json",
        "data/main_data.hdf5",
        "transitions.parquet",
        "metadata.yaml",
        "x_0.db3",
        "episodes.parquet",
    ],
)
def test_a_fifo_in_a_folder_is_one_error(
    path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "folder"
    (folder / path).parent.mkdir(parents=True)
    if path == "data/main_data.hdf5":
        (folder / "data/metadata.json").write_text(json.dumps({"total_episodes": 1}))
    if path == "transitions.parquet":
        (folder / "episodes.parquet").write_bytes(b"PAR1")
    os.mkfifo(folder / path)
    (tmp_path / "map.yaml").write_text(MAPPING)
    assert_one_line(["info", "folder"], capsys)
    assert_one_line(["info", "folder", "--mapping", "map.yaml"], capsys)
    assert_one_line(["convert", "folder", "out.mcap"], capsys)


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors", "best_model.zip"])
def test_a_fifo_in_a_run_is_one_error(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run" / "seed-0"
    folder.mkdir(parents=True)
    (folder / "policy.json").write_text('{"format_version": 1}')
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    assert_one_line(["evaluate", "run", "--sim", "lane"], capsys)


def test_a_mapping_that_is_a_fifo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place("fifo", tmp_path / "map.yaml")
    (tmp_path / "x.mcap").touch()
    line = assert_one_line(["info", "x.mcap", "--mapping", "map.yaml"], capsys)
    assert line == "mcaprl: map.yaml: it is not a regular file"
