"""Tests that evaluation on a Ray cluster has the same results as local evaluation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import ClusterError, UsageError
from tests.ray.seeded import SEEDED

pytestmark = pytest.mark.usefixtures("ray_cluster")


@pytest.fixture(scope="module")
def lane_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a run with two seeds for a few updates."""
    pytest.importorskip("torch")
    pytest.importorskip("numba")
    folder = tmp_path_factory.mktemp("lane")
    mcaprl.record("lane", folder / "log.mcap", episodes=2, epsilon=0.5)
    data = mcaprl.open(folder / "log.mcap")
    mcaprl.train(data, folder / "run", algo="bc", updates=20, batch_size=32, hidden=(8,), seeds=2)
    return folder / "run"


def test_numbers_are_those_of_one_process(lane_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    options: dict[str, Any] = {"episodes": 12, "seed": 7}
    local = mcaprl.evaluate(lane_run, "lane", **options)
    report = tmp_path / "report"
    found = mcaprl.evaluate(lane_run, "lane", ray=True, workers=2, report=report, **options)
    assert found.to_json() == local.to_json()
    assert len(local.to_json()["policies"][0]["returns"]) == 24
    # The positions are drawn in the report.
    for mine, theirs in zip(found.policies[0].results, local.policies[0].results, strict=True):
        for one, other in zip(mine, theirs, strict=True):
            assert one.positions.shape == (one.length + 1, 2)
            assert one.positions.tobytes() == other.positions.tobytes()
    assert (report / "index.html").exists()


def test_the_command_prints_the_same_with_one_worker(
    lane_run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lane_run.parent)
    printed = []
    for options in ([], ["--ray", "--workers", "1"]):
        assert run(["evaluate", "run", "--sim", "lane", "--episodes", "3", "--json", *options]) == 0
        printed.append(json.loads(capsys.readouterr().out))
    assert printed[0] == printed[1]


def test_options_that_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`record=` needs one process"):
        mcaprl.evaluate("random", SEEDED, episodes=1, ray=True, record=tmp_path / "a.mcap")
    with pytest.raises(UsageError, match="`workers=` requires `ray=True`"):
        mcaprl.evaluate("random", SEEDED, episodes=1, workers=2)


def test_a_sim_that_kills_each_worker_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mcaprl.ray.tasks.MOST_DEATHS", 1)
    with pytest.raises(ClusterError, match="died repeatedly while they evaluated random"):
        mcaprl.evaluate("random", SEEDED, episodes=1, ray=True, sim_options={"dies": True})


def test_episodes_are_truncated_like_those_of_one_process() -> None:
    options: dict[str, Any] = {"episodes": 3, "max_steps": 50}
    with pytest.warns(UserWarning, match="3 of 3 episodes in CliffWalking-v1"):
        local = mcaprl.evaluate("random", "CliffWalking-v1", **options)
    with pytest.warns(UserWarning, match="3 of 3 episodes in CliffWalking-v1"):
        found = mcaprl.evaluate("random", "CliffWalking-v1", ray=True, workers=1, **options)
    assert found.to_json() == local.to_json()
    assert found.policies[0].ends == {"step_limit": 3}
