"""Tests of the benchmark: statistics by hand and against rliable, shipped behaviors, and cells."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

import mcaprl
from benchmarks.suite import __main__ as suite
from benchmarks.suite import learners, page, statistics, tasks
from mcaprl.sims import interquartile_mean
from tests.support.rivals import run_rivals

SCORES = np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 7.0], [4.0, 8.0]])
"""Scores of four runs of two tasks."""


def test_iqm_is_the_mean_of_the_middle_half_of_all_runs() -> None:
    # Of eight scores, two are dropped at each end: (3 + 4 + 5 + 6) / 4.
    assert interquartile_mean(SCORES) == 4.5


def test_bootstrap_samples_draw_the_runs_of_each_task_apart() -> None:
    samples = statistics.stratified_samples(SCORES, np.random.default_rng(0))
    assert samples.shape == (statistics.RESAMPLES, 4, 2)
    for task in range(2):
        assert set(np.unique(samples[..., task])) == set(SCORES[:, task])
    # With common rows, the second column would always be the first one plus 4.
    assert (samples[..., 1] - samples[..., 0] != 4).any()
    low, high = statistics.interval(SCORES)
    assert 2.5 < low < 4.5 < high < 6.5
    assert statistics.interval(np.full((4, 2), 0.5)) == (0.5, 0.5)


def test_profile_is_the_share_of_runs_above_a_threshold() -> None:
    found = statistics.profile(SCORES, np.array([0.0, 2.0, 5.5, 8.0]))
    assert found.tolist() == [1.0, 6 / 8, 3 / 8, 0.0]


def test_improvement_is_the_mean_over_tasks_and_a_tie_is_half_a_win() -> None:
    first = np.array([[1.0, 0.0], [2.0, 0.0]])
    second = np.array([[1.0, 5.0], [0.0, 6.0], [3.0, 7.0]])
    # Task 1: 1 against 1, 0, 3 is .5 + 1 + 0, and 2 is 1 + 1 + 0, of 6 pairs. Task 2: never.
    assert statistics.improvement(first, second) == pytest.approx(3.5 / 6 / 2)
    low, high = statistics.improvement_interval(first, second)
    assert 0 <= low < 3.5 / 12 < high <= 0.5


def test_the_statistics_are_those_of_rliable() -> None:
    metrics = pytest.importorskip("rliable.metrics")
    random = np.random.default_rng(0)
    first, second = random.normal(size=(5, 3)), random.normal(0.4, size=(4, 3)).round(1)
    second[0, 0] = first[1, 0]
    assert interquartile_mean(first) == pytest.approx(metrics.aggregate_iqm(first))
    theirs = metrics.probability_of_improvement(first, second)
    assert statistics.improvement(first, second) == pytest.approx(theirs)


def test_behaviors_are_small_and_load() -> None:
    sizes = {path: path.stat().st_size for path in tasks.BEHAVIORS.rglob("*") if path.is_file()}
    assert max(sizes.values()) <= 200_000
    assert sum(sizes.values()) <= 3_000_000
    stages = sorted(path.parent for path in sizes if path.name == "policy.json")
    assert {path.name for path in stages} == {"early", "medium", "expert"}
    for folder in stages:
        task = tasks.TASKS[folder.parent.name]
        policy = mcaprl.load_policy(folder)
        assert (policy.env_id, policy.algo) == (task.sim, task.online["algo"])
        types = {
            str(value.dtype)
            for key, value in load_file(folder / "policy.safetensors").items()
            if not key.startswith("observation.")
        }
        assert types == {"float16"}


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make logs and trainings of CartPole small, and write behaviors and results elsewhere."""
    task = tasks.Task("CartPole-v1", "tests", steps=200, pilot=lambda env: tasks.Scripted(lean))
    for module in (suite, tasks, page):
        monkeypatch.setattr(module, "TASKS", {"CartPole": task})
    monkeypatch.setattr(tasks, "BEHAVIORS", tmp_path / "behaviors")
    (tmp_path / "behaviors").mkdir()
    monkeypatch.setattr(page, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(learners, "SHARED", learners.SHARED | {"updates": 5, "hidden": (4,)})
    return tmp_path


def lean(observation: Any) -> np.int64:
    """Return the push toward which the pole leans."""
    return np.int64(observation[2] + observation[3] > 0)


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> None:
    given = ["suite", "--kind", "replay", "--seeds", "2", "--folder", str(folder), "--no-page"]
    monkeypatch.setattr(sys, "argv", [*given, *words])
    suite.main()


@pytest.mark.filterwarnings("ignore:.* updates of the target network")
def test_an_interrupted_suite_continues_with_the_next_cell(
    small: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(monkeypatch, small, "--algo", "bc")
    assert "CartPole, replay, bc" in (printed := capsys.readouterr().out)
    assert "tier tests: 1 cells in" in printed
    run(monkeypatch, small, "--algo", "bc", "cql")
    assert "bc" not in (printed := capsys.readouterr().out)
    assert "CartPole, replay, cql" in printed
    cells = page.read_cells(page.RESULTS)
    cell = cells["CartPole", "replay", "cql"]
    assert np.shape(cell["returns"]) == (2, tasks.EPISODES)
    first, second = tasks.scale("CartPole")
    assert second > 300 > 50 > first
    scores = (np.mean(cell["returns"], axis=1) - first) / (second - first)
    assert cell["scores"] == pytest.approx(scores, abs=1e-3)
    run(monkeypatch, small, "--policies", str(small / "runs" / "CartPole" / "replay-bc"))
    assert "policies replay-bc: " in capsys.readouterr().out
    assert page.read_cells(page.RESULTS).keys() == cells.keys()


def test_settings_are_shared_and_the_rest_is_the_default() -> None:
    discrete, box = tasks.TASKS["CartPole"], tasks.TASKS["Pendulum"]
    q = learners.SHARED | {"gamma": 0.99, **learners.TARGET}
    assert learners.settings_of(discrete, "bc") == learners.SHARED
    assert learners.settings_of(discrete, "cql") == learners.settings_of(discrete, "auto") == q
    # Its target networks have another default interval, and d3rlpy has no discrete IQL.
    assert learners.settings_of(discrete, "iql") == learners.SHARED | {"gamma": 0.99}
    assert learners.settings_of(box, "iql") == learners.SHARED | {"gamma": 0.97}
    assert learners.settings_of(box, "auto") == learners.SHARED | {"gamma": 0.97}
    assert learners.settings_of(box, "my-algorithm") == learners.SHARED
    assert "d3rlpy-rebrac" in learners.learners_of(box, with_rivals=True)
    own = {"double-dqn", "cql", "bc", "bcq", "iql"}
    assert set(learners.learners_of(discrete, with_rivals=False)) == own


def test_a_log_with_other_returns_is_refused(small: Path) -> None:
    tasks.check_returns("CartPole", "replay", [1.0, 2.0, 4.0])
    tasks.check_returns("CartPole", "replay", [4.0, 1.0, 2.0])
    with pytest.raises(ValueError, match=r"has 3 episodes with a mean return of 2.67, and Cart"):
        tasks.check_returns("CartPole", "replay", [1.0, 3.0, 4.0])
    tasks.check_returns("CartPole", "random", [1.0, 3.0, 4.0])
    data = tasks.make_log("CartPole", "noisy-expert", small / "logs")
    again = tasks.make_log("CartPole", "noisy-expert", small / "again")
    assert (data.rewards == again.rewards).all()
    assert (data.observations == again.observations).all()


def cell(kind: str, learner: str, *scores: float, box: bool = False) -> dict[str, Any]:
    return {
        "task": "Pendulum" if box else "CartPole",
        "kind": kind,
        "learner": learner,
        "box": box,
        "tier": "tests",
        "behavior": 0.5,
        "scores": list(scores),
        "cpu_s": 6.0,
    }


def test_page_has_the_tables_of_the_cells(tmp_path: Path) -> None:
    cells = [
        cell("replay", "bc", 0.1, 0.2, 0.3, 0.4),
        cell("replay", "d3rlpy-bc", 0.0, 0.1, 0.2, 0.35),
        cell("random", "bc", 0.5, 0.5, 0.5, 0.5),
        cell("replay", "iql", 1.0, 1.0, 1.0, 1.0, box=True),
    ]
    for number, each in enumerate(cells):
        (tmp_path / f"{number}.json").write_text(json.dumps(each))
    found = page.read_cells(tmp_path)
    # Only the replay log has cells of both: .25 and .15 are the means of the middle two.
    # Wins of 16 pairs: .1 beats 0 and ties with .1, .2 beats two and ties, .3 beats three, .4 all.
    assert "| tests, discrete | bc | 1 | 0.25 | 0.15 | +0.10 (" in (text := page.rivals(found))
    assert f"| {(1.5 + 2.5 + 3 + 4) / 16:.2f} (" in text
    assert "| tests, discrete | bc | 2 | 0.42 | " in (text := page.summaries(found))
    assert "| tests, Box | iql | 1 | 1.00 | 1.00 to 1.00 | 1.5 |" in text
    (tmp_path / "images").mkdir()
    sections = ("cells", "statistics", "rivals")
    text = "\n".join(f"<!-- benchmark-{each} -->\n<!-- /benchmark-{each} -->" for each in sections)
    (tmp_path / "benchmark.md").write_text(text)
    page.write(found, tmp_path)
    text = (tmp_path / "benchmark.md").read_text()
    assert "| replay (0.50) | 0.25 (0.10 to 0.40) | 0.15 (0.00 to 0.35) |" in text
    assert "| random (0.50) | 0.50 (0.50 to 0.50) | - |" in text
    assert "Not measured yet: Acrobot (study)" in text
    assert (tmp_path / "images" / "benchmark.png").stat().st_size > 1_000


def test_results_in_the_repository_have_four_seeds_of_known_tasks() -> None:
    cells = page.read_cells()
    assert cells
    for (task, kind, learner), each in cells.items():
        assert np.shape(each["returns"]) == (len(each["scores"]), tasks.EPISODES)
        assert len(each["scores"]) >= 4
        assert each["tier"] == tasks.TASKS[task].tier
        assert kind in tasks.TASKS[task].kinds
        assert page.cell_path(task, kind, learner).is_file()


def test_tasks_of_other_packages_are_determined_by_the_seed_and_solved_by_their_pilots() -> None:
    shapes = {"Breakout": [10, 10, 4], "PointMaze": [2], "Reach": [39], "DrawerOpen": [39]}
    found = json.loads(run_rivals("-m", "tests.suite_tasks", *shapes))
    # d3rlpy learns from images, too.
    assert len(actions := found.pop("clone")) == 50
    assert set(actions) <= {0, 1, 2}
    assert {name: each["shape"] for name, each in found.items()} == shapes
    for each in found.values():
        assert (each["fits"], each["repeats"], each["differs"]) == (True, True, True)
        # The scale is the mean of more episodes, and those of Breakout have very different lengths.
        assert each["score"] == pytest.approx(1, abs=1 if each["shape"] == [10, 10, 4] else 0.05)
