"""Tests of sweeps with Ray Tune, and of their files."""

from __future__ import annotations

import csv
import json
import os
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import ClusterError, OutputExistsError, TrainingError, UsageError
from mcaprl.offline.algorithms.config import BCConfig
from mcaprl.offline.training.train import train
from mcaprl.ray import sweep, tasks
from mcaprl.ray.sweep import Score, SweepPlan, Trial, TrialResult, read_plan, table_of, write_sweep
from mcaprl.ray.tasks import check_machine
from mcaprl.recorder.format.metadata import installed_versions
from tests.ray.processes import open_files
from tests.ray.seeded import SEEDED

PLAN = """
algos:
  cql: {alpha: [0.5, 1]}
  bc:
settings:
  updates: 20
  learning_rate: [3e-4, 1e-3]
  hidden: [8, 8]
  gamma: 0.9
seeds: 2
score: {every: 10}
"""


def test_a_file_has_each_combination_of_its_values(tmp_path: Path) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(PLAN)
    plan = read_plan(path)
    names = ["cql-000", "cql-001", "cql-002", "cql-003", "bc-004", "bc-005"]
    assert [one.name for one in plan.trials] == names
    varied = [tuple(one.varied.values()) for one in plan.trials]
    pairs = [(3e-4, 0.5), (3e-4, 1.0), (1e-3, 0.5), (1e-3, 1.0)]
    assert varied == [*pairs, (3e-4,), (1e-3,)]
    assert {one.config.hidden for one in plan.trials} == {(8, 8)}
    # Only cql has the setting gamma. Checkpoints are written when policies are scored.
    assert plan.trials[0].config.to_json()["gamma"] == 0.9
    assert {one.config.checkpoint_interval for one in plan.trials} == {10}
    assert (plan.seeds, plan.seed, plan.stop, plan.score.every) == (2, 0, 3, 10)


def test_json_and_mappings_are_read_like_yaml(tmp_path: Path) -> None:
    tree = {"algos": ["bc"], "settings": {"hidden": [[8], [16, 16]]}}
    path = tmp_path / "sweep.json"
    path.write_text(json.dumps(tree))
    assert read_plan(path) == read_plan(tree)
    assert [one.varied["hidden"] for one in read_plan(tree).trials] == [(8,), (16, 16)]


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ("algos: [bc\n", "sweep.yaml:2: not YAML"),
        ("- bc\n", "a sweep must be a mapping"),
        ("algos: []\n", "algos must be a list of algorithms"),
        ("algos: [ppq]\n", "unknown algorithm"),
        ("algorithms: [bc]\n", "a sweep has no key 'algorithms'; it has algos, settings"),
        ("algos: {bc: {alpha: 1}}\n", "bc has no setting `alpha=`"),
        ("algos: [bc]\nsettings: {alpha: 1}\n", "bc has no setting `alpha=`"),
        ("algos: [bc]\nsettings: {updates: many}\n", 'updates must be a whole number, got "many"'),
        ("algos: [bc]\nsettings: {updates: true}\n", "updates must be a whole number, got true"),
        ("algos: [bc]\nsettings: {updates: []}\n", "updates has no values"),
        ("algos: [bc]\nsettings: {hidden: 8}\n", "hidden must be a list of whole numbers, got 8"),
        ("algos: [bc]\nsettings: {updates: [5, 0]}\n", "updates must be at least 1, got 0"),
        ("algos: [bc]\nsettings: {checkpoint_interval: 5}\n", "is the `every` of score"),
        ("algos: [bc]\nseeds: 0\n", "seeds must be at least 1"),
        ("algos: [bc]\nstop: 1\n", "stop 0 or 2 to 99"),
        ("algos: [bc]\nscore: {fraction: 1.0}\n", "fraction must be between 0 and 1"),
        ("algos: [bc]\nscore: {each: 1}\n", "score has no key 'each'; it has every, fraction"),
    ],
)
def test_a_mistake_in_a_file_is_one_line(tmp_path: Path, tree: str, message: str) -> None:
    path = tmp_path / "sweep.yaml"
    path.write_text(tree)
    with pytest.raises(UsageError) as raised:
        read_plan(path)
    assert message in str(raised.value)
    assert str(raised.value).startswith(f"{path}")
    assert "\n" not in str(raised.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.yaml: cannot be read"):
        read_plan(tmp_path / "none.yaml")


def results(tmp_path: Path) -> list[TrialResult]:
    """Return a trial that finished, one that was stopped, and one that failed."""
    outcomes: list[tuple[tuple[Score, ...], str]] = [
        ((Score(10, [1.0, 2.0], "WDR", True), Score(20, [2.0, 4.0], "WDR", True)), ""),
        ((Score(10, [0.0, 1.0], "WDR", False),), ""),
        ((), "loss is nan"),
    ]
    return [
        TrialResult(
            Trial(f"bc-{k:03d}", "bc", BCConfig(updates=20), {"hidden": (8, k)}),
            tmp_path / f"bc-{k:03d}",
            scores,
            error,
        )
        for k, (scores, error) in enumerate(outcomes)
    ]


def test_table_image_and_page_have_all_trials(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    found = results(tmp_path)
    table = write_sweep(found, SweepPlan(tuple(one.trial for one in found), seeds=2), tmp_path)
    assert table == table_of(found)
    assert list(csv.reader((tmp_path / "sweep.csv").read_text().splitlines())) == [
        ["trial", "hidden", "score", "lowest", "highest", "estimator", "updates", "status"],
        ["bc-000", "8,0", "3.000", "2.000", "4.000", "WDR", "20", "finished"],
        ["bc-001", "8,1", "0.500", "0.000", "1.000", "WDR, not trusted", "10", "stopped early"],
        ["bc-002", "8,2", "", "", "", "", "0", "failed: loss is nan"],
    ]
    page = (tmp_path / "index.html").read_text()
    assert "bc-001" in page
    assert "<svg" in page
    assert (tmp_path / "sweep.png").read_bytes().startswith(b"\x89PNG")


UPDATES, EVERY = 24, 4


def kill_once(out: Path, killed: list[int]) -> None:
    """Kill the worker of the first trial after its first score."""
    scores = out / "bc-000.scores.json"
    while not scores.exists():
        time.sleep(0.01)
    # The process that trains into a folder has locked it.
    (process,) = {process for process, link in open_files() if link == str(out / "bc-000")}
    os.kill(process, signal.SIGKILL)
    killed.append(len(json.loads(scores.read_text())["scores"]))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record 20 episodes."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    mcaprl.record(SEEDED, path, policy="random", episodes=20, sim_options={"pause_s": 0.0})
    return path


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
@pytest.mark.usefixtures("ray_cluster")
@pytest.mark.long
def test_a_sweep_ranks_policies_by_the_episodes_that_they_have_not_learned_from(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Kill the worker of one trial; the other trial fails."""
    out = tmp_path / "out"
    plan = tmp_path / "sweep.yaml"
    tree: dict[str, Any] = {
        "algos": ["bc"],
        "settings": {"updates": UPDATES, "hidden": [8], "learning_rate": [1e-3, 1e30]},
        "seeds": 2,
        "score": {"every": EVERY, "updates": 5, "fraction": 0.5},
    }
    plan.write_text(json.dumps(tree))
    command = ["train-offline", str(log), "--out", str(out), "--sweep", str(plan)]
    killed: list[int] = []
    killer = threading.Thread(target=kill_once, args=(out, killed), daemon=True)
    killer.start()
    assert run([*command, "--ray", "--workers", "2"]) == 0
    killer.join()
    assert 1 <= killed[0] < UPDATES / EVERY
    printed = capsys.readouterr().out
    assert printed.index("bc-000") < printed.index("bc-001")
    rows = list(csv.DictReader((out / "sweep.csv").read_text().splitlines()))
    assert [row["trial"] for row in rows] == ["bc-000", "bc-001"]
    assert rows[0]["status"] == "finished"
    assert rows[1]["status"].startswith("failed: update 2 of")
    scores = json.loads((out / "bc-000.scores.json").read_text())["scores"]
    assert [one["updates"] for one in scores] == list(range(EVERY, UPDATES + 1, EVERY))
    assert all(len(one["values"]) == 2 and one["estimator"] == "WDR" for one in scores)
    assert float(rows[0]["score"]) == pytest.approx(sum(scores[-1]["values"]) / 2, abs=1e-3)
    # The killed trial has the weights of an undisturbed training.
    data = mcaprl.open(log)
    learned, _ = sweep._divided(len(data.episodes), 0.5)
    train(data._take(learned), read_plan(tree).trials[0].config, tmp_path / "local", seeds=2)
    for seed in ("seed-0", "seed-1"):
        mine, theirs = (
            path / seed / "policy.safetensors" for path in (out / "bc-000", tmp_path / "local")
        )
        assert mine.read_bytes() == theirs.read_bytes()
    assert mcaprl.load_policy(out / "bc-000" / "seed-1").act([[0.0, 0.0, 0.0]]).shape == (1,)
    trained = json.loads((out / "bc-000" / "config.json").read_text())
    assert 0 < trained["transitions"] < len(data)
    with pytest.raises(OutputExistsError, match="or resume its sweep"):
        mcaprl.sweep(log, out, tree)
    with pytest.raises(TrainingError, match="has other seeds; resume with the same sweep file"):
        mcaprl.sweep(log, out, {**tree, "seeds": 1}, resume=True)
    assert run([*command]) == 2
    assert run([*command, "--ray", "--updates", "3"]) == 2
    assert "--updates and --sweep: write the setting into" in capsys.readouterr().err


def test_a_trial_killed_between_checkpoint_and_score_has_all_scores(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray import tune

    reported: list[int] = []
    monkeypatch.setattr(tune, "report", lambda found: reported.append(found["updates"]))
    tree = {"algos": ["bc"], "settings": {"updates": 8, "hidden": [8]}, "seeds": 2}
    plan = read_plan({**tree, "score": {"every": 4, "updates": 5, "fraction": 0.5}})
    (trial,) = plan.trials
    sweep._train({log: 1.0}, plan, trial, tmp_path)
    whole = sweep._result(trial, tmp_path).scores
    assert [one.updates for one in whole] == reported == [4, 8]
    sweep._save(tmp_path / trial.name, whole[:1], "")
    sweep._train({log: 1.0}, plan, trial, tmp_path)
    assert sweep._result(trial, tmp_path).scores == whole
    assert reported == [4, 8, 4, 8]


@pytest.mark.usefixtures("ray_cluster")
def test_other_versions_and_unseen_paths_are_found_before_the_trials_start(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start() -> None:
        mcaprl.sweep(log, tmp_path / "out", {"algos": ["bc"]})

    monkeypatch.setattr(sweep, "_run", None)
    with monkeypatch.context() as patch:
        patch.setattr(tasks, "check_machine", check_elsewhere)
        with pytest.raises(
            ClusterError, match=r"127\.0\.0\.1 cannot see /elsewhere/.*: choose a path"
        ):
            start()
    versions = {**installed_versions(), "numpy": "1.2.3"}
    monkeypatch.setattr(tasks, "installed_versions", lambda: versions)
    with pytest.raises(ClusterError, match=r"the worker at 127\.0\.0\.1 has numpy .* 1\.2\.3: in"):
        start()
    assert list(tmp_path.iterdir()) == []


def check_elsewhere(versions: dict[str, str], paths: Sequence[Path]) -> None:
    """Check the machine of a worker as if it had another file system."""
    check_machine(versions, [Path("/elsewhere", *path.parts[1:]) for path in paths])
