"""Tests of the commands' output about their reports, logs and finished runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from gymnasium import spaces

import mcaprl
from mcaprl import cli
from mcaprl.errors import PolicyError, SpaceError
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support.offline_tasks import corridor

SMALL = ["--updates", "3", "--batch-size", "4", "--hidden", "4", "--gamma", "0.5"]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    dataset: Dataset = corridor()
    dataset.save(tmp_path / "corridor.mcap")
    return tmp_path / "corridor.mcap"


def test_the_package_can_be_run_as_a_module() -> None:
    command = [sys.executable, "-m", "mcaprl", "--version"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert printed.stdout == f"mcaprl {mcaprl.__version__}\n"


def test_info_names_its_page(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra report")
    folder = data.parent / "report"
    assert cli.run(["info", str(data), "--report", str(folder)]) == 0
    page = folder / "index.html"
    assert page.is_file()
    assert f"report: {page}" in capsys.readouterr().out


def test_resuming_a_finished_run_says_so(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = data.parent / "run"
    assert cli.run(["train-offline", str(data), "--out", str(run), *SMALL]) == 0
    capsys.readouterr()
    assert cli.run(["train-offline", str(data), "--out", str(run), "--resume"]) == 0
    assert f"{run / 'seed-0'}: finished before, with 3 updates" in capsys.readouterr().out


def test_a_resumed_run_trains_the_seeds_that_it_had(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = data.parent / "run"
    command = ["train-offline", str(data), "--out", str(run)]
    assert cli.run([*command, *SMALL, "--seeds", "2", "--seed", "3"]) == 0
    (run / "seed-4" / "checkpoint.safetensors").unlink()
    capsys.readouterr()
    assert cli.run([*command, "--resume"]) == 0
    printed = capsys.readouterr().out
    assert f"{run / 'seed-3'}: finished before, with 3 updates" in printed
    assert f"{run / 'seed-4'}: 3 updates" in printed
    assert cli.run([*command, "--resume", "--seeds", "1"]) == 2
    assert f"{run} is a run of 2 seeds, the first of which is 3" in capsys.readouterr().err


def test_resuming_with_another_algorithm_is_refused(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = data.parent / "run"
    assert cli.run(["train-offline", str(data), "--out", str(run), *SMALL]) == 0
    assert cli.run(["train-offline", str(data), "--out", str(run), "--resume", "--algo", "bc"]) == 2
    assert f"{run} is a run of cql: resume it without algo" in capsys.readouterr().err


def test_a_comparison_excludes_all_that_shows_the_log(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for other in (["--video", "x.mp4"], ["--save", "x.html"], ["--browser"]):
        assert cli.run(["replay", str(data), "--verify", *other]) == 2
        assert "run replay once for each" in capsys.readouterr().err


def test_one_observation_has_one_action_but_values_of_batches_only(data: Path) -> None:
    run = data.parent / "run"
    assert cli.run(["train-offline", str(data), "--out", str(run), *SMALL]) == 0
    policy = mcaprl.load_policy(run)
    one = mcaprl.open(data).observations[0]
    with pytest.raises(PolicyError, match=r"got \(5,\); add an axis .* observation\[None\]"):
        policy.q_values(one)
    assert policy.act(one) == policy.act(one[None])[0]


def test_the_parts_of_one_dict_are_named_in_the_hint() -> None:
    space = spaces.Dict({"place": spaces.Box(-1, 1, (2,)), "speed": spaces.Box(0, 1, (1,))})
    one = space.sample()
    encoder = ObservationEncoder(space, 2)
    with pytest.raises(SpaceError, match=r"of place, got \(2,\); add .*\[None\] for name, part in"):
        encoder.encode(one)
    assert len(encoder.encode({name: part[None] for name, part in one.items()})) == 1
