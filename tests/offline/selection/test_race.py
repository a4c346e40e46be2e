"""Tests of runs of `auto`: choice, early end, resume, budget, interruption and report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.errors import OutputExistsError, TrainingError, UsageError
from mcaprl.offline.policy import read_policy
from mcaprl.offline.selection.choice import COLUMNS, UNTESTED, read_choice
from mcaprl.offline.selection.config import AutoConfig
from mcaprl.offline.selection.race import PORTFOLIO, eligible, select
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from tests.offline.estimate.test_off_policy import log
from tests.support import two_state_task as task

TINY: dict[str, Any] = {
    "updates": 40,
    "batch_size": 16,
    "hidden": (8,),
    "log_interval": 5,
    "gamma": 0.9,
    "target_interval": 5,
    "survivors": 2,
    "model_updates": 60,
}
CONFIG = AutoConfig(**TINY)


class Interrupted(Exception):
    """Exception that a callback raises, in place of Ctrl-C."""


def updates(run: Path) -> dict[str, int]:
    """Return the number of updates of each candidate."""
    files = run.glob("candidates/*/seed-0/policy.json")
    return {file.parts[-3]: json.loads(file.read_text())["updates"] for file in files}


def weights(run: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(run)): file.read_bytes() for file in run.rglob("policy.safetensors")
    }


@pytest.fixture(scope="module")
def data() -> Dataset:
    return log(40)


@pytest.fixture(scope="module")
def finished(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("auto") / "run"
    select(data, CONFIG, run, seeds=2)
    return run


def test_two_candidates_make_all_updates_and_the_others_a_quarter(finished: Path) -> None:
    done = updates(finished)
    assert set(done) == {candidate.name for candidate in PORTFOLIO}
    assert sorted(done.values()) == [10] * (len(done) - 2) + [40] * 2
    choice = read_choice(finished)
    assert choice.complete
    assert done[choice.chosen] == 40
    outcomes = {name: one.outcome for name, one in choice.tried.items()}
    assert outcomes.pop(choice.chosen) == "chosen"
    assert sorted(outcomes.values()) == ["runner-up"] + ["stopped early"] * (len(done) - 2)
    assert next(iter(choice.tried)) == choice.chosen
    assert choice.chosen in choice.reason
    finalists = [name for name, one in choice.tried.items() if one.outcome != "stopped early"]
    assert sorted(finalists) == ["cql-alpha-0.1", "iql"]


def test_only_candidates_of_the_last_evaluation_have_a_chance(finished: Path) -> None:
    choice = read_choice(finished)
    column = COLUMNS.index("best")
    chances = {row[0]: row[column] for row in choice.rows if row[column] != "-"}
    assert set(chances) == {"iql", "cql-alpha-0.1"}
    assert sum(float(chance.rstrip("%")) for chance in chances.values()) == pytest.approx(
        100, abs=1
    )


def test_a_short_horizon_is_reported_with_the_candidates(data: Dataset, tmp_path: Path) -> None:
    config = replace(CONFIG, gamma=0.999, target_interval=10)
    with pytest.warns(UserWarning, match="of the horizon") as warned:
        select(data, config, tmp_path / "run")
    (message,) = {str(one.message) for one in warned}
    assert message.startswith("iql, cql-alpha-0.1, bcq, cql, cql-scaled, double-dqn: 4 updates of")


def test_with_all_finalists_the_best_candidates_make_all_updates(
    data: Dataset, tmp_path: Path
) -> None:
    choice, _ = select(data, replace(CONFIG, finalists="all"), tmp_path / "run")
    stages = json.loads((tmp_path / "run" / "stages.json").read_text())
    short = {name: one["rating"]["score"] for name, one in stages["short"].items()}
    best = sorted(short, key=lambda name: -short[name])[:2]
    assert sorted(stages["full"]) == sorted(best)
    assert {name for name, count in updates(tmp_path / "run").items() if count == 40} == set(best)
    assert choice.chosen in best


def test_the_run_contains_the_policy_of_the_chosen_candidate(finished: Path) -> None:
    choice = read_choice(finished)
    for seed in ("seed-0", "seed-1"):
        found, wanted = (
            (folder / seed / "policy.safetensors").read_bytes()
            for folder in (finished, finished / "candidates" / choice.chosen)
        )
        assert found == wanted
    policy = mcaprl.load_policy(finished)
    assert policy.act(np.eye(2, dtype=np.float32)).shape == (2,)


def test_the_traits_are_those_of_the_log(data: Dataset, finished: Path) -> None:
    traits = read_choice(finished).traits
    assert (traits.episodes, traits.transitions) == (40, len(data))
    assert traits.mean_return == pytest.approx(data.statistics.mean_return)
    assert traits.terminated == 1
    assert traits.probabilities
    assert traits.coverage == 1
    expected = -np.log2(data.behavior_probs).mean()
    assert traits.entropy == pytest.approx(expected)
    assert not traits.is_deterministic


def test_actions_that_are_rare_in_the_log_exclude_double_dqn(tmp_path: Path) -> None:
    data = log(60, acting=np.array([[1.0, 0.0], [1.0, 0.0]]))
    choice, _ = select(data, replace(CONFIG, learning_rate=0.05), tmp_path / "run")
    assert choice.traits.coverage == 0.5
    assert choice.traits.is_deterministic
    assert "almost deterministic" in choice.reason
    ratings = [one.rating for one in choice.tried.values() if one.rating]
    assert ratings[0].agreement == ratings[0].score == 1
    assert "double-dqn" not in updates(tmp_path / "run")
    assert choice.tried["double-dqn"].outcome.startswith("not tried: only 50% of the actions")


def test_all_candidates_are_eligible_if_a_finalist_is_not_tried() -> None:
    iql, cql, *others = PORTFOLIO
    assert eligible(CONFIG, PORTFOLIO) == {"iql", "cql-alpha-0.1"} == {iql.name, cql.name}
    assert eligible(CONFIG, [cql, *others]) == {cql.name, *(one.name for one in others)}
    assert len(eligible(replace(CONFIG, finalists="all"), PORTFOLIO)) == len(PORTFOLIO)


def test_the_same_run_again_is_bit_equal(data: Dataset, finished: Path, tmp_path: Path) -> None:
    select(data, CONFIG, tmp_path / "run", seeds=2)
    assert weights(tmp_path / "run") == weights(finished)
    assert read_choice(tmp_path / "run") == read_choice(finished)


@pytest.mark.parametrize("after", [3, 17])
def test_an_interrupted_run_is_readable_and_resumes_to_the_same_result(
    data: Dataset, finished: Path, tmp_path: Path, after: int
) -> None:
    run, reports = tmp_path / "run", 0

    def interrupt(now: TrainingProgress) -> None:
        nonlocal reports
        reports += 1
        if reports == 2 * after:
            raise Interrupted

    with pytest.raises(Interrupted):
        select(data, CONFIG, run, seeds=2, progress=interrupt)
    if after > 3:
        assert read_policy(run / "seed-1").act(np.eye(2, dtype=np.float32)).shape == (2,)
    select(data, CONFIG, run, seeds=2, resume=True)
    assert weights(run) == weights(finished)
    assert read_choice(run) == read_choice(finished)


def test_a_finished_run_resumes_without_an_update(data: Dataset, finished: Path) -> None:
    before = weights(finished)
    reported: list[TrainingProgress] = []
    choice, summaries = select(
        data, CONFIG, finished, seeds=2, resume=True, progress=reported.append
    )
    assert not reported
    assert choice == read_choice(finished)
    assert weights(finished) == before
    assert [summary.steps for summary in summaries] == [40, 40]


def test_a_resumed_run_has_its_own_seeds(data: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "run"
    mcaprl.train(data, out, algo="auto", seeds=2, seed=4, **TINY)
    assert [one.seed for one in mcaprl.train(data, out, resume=True)] == [4, 5]
    with pytest.raises(UsageError, match="a run of 2 seeds, the first of which is 4"):
        mcaprl.train(data, out, resume=True, seeds=1)


def test_progress_is_that_of_one_training(data: Dataset, tmp_path: Path) -> None:
    reported: list[TrainingProgress] = []
    select(data, CONFIG, tmp_path / "run", progress=reported.append)
    done = [now.done for now in reported]
    assert done == sorted(done)
    assert done[-1] == reported[-1].total == 10 * len(PORTFOLIO) + 2 * 30
    activities = [now.activity for now in reported if now.activity]
    assert activities == [f"evaluating {len(PORTFOLIO)} candidates", "evaluating 2 candidates"]


def test_a_budget_ends_the_run_with_a_policy(data: Dataset, tmp_path: Path) -> None:
    run = tmp_path / "run"
    config = replace(CONFIG, updates=100_000, log_interval=50, checkpoint_interval=50)
    choice, _ = select(data, replace(config, budget_minutes=0.15), run)
    assert not choice.complete
    assert "larger time budget" in choice.advice[0]
    assert 0 < max(updates(run).values()) < 100_000
    assert set(choice.tried) == {candidate.name for candidate in PORTFOLIO}
    assert choice.chosen in ("iql", "cql-alpha-0.1")
    assert mcaprl.load_policy(run).act(np.eye(2, dtype=np.float32)).shape == (2,)


def test_checkpoints_meet_the_end_of_the_short_training() -> None:
    assert (CONFIG.candidate_interval, CONFIG.short_updates) == (2, 10)
    usual = AutoConfig()
    assert (usual.candidate_interval, usual.short_updates) == (500, 2_000)
    often = AutoConfig(updates=999, checkpoint_interval=7)
    assert (often.candidate_interval, often.short_updates) == (7, 252)
    assert AutoConfig(updates=1).short_updates == 1


def test_a_budget_without_time_for_a_checkpoint_keeps_the_first_candidate(
    data: Dataset, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    choice, (summary,) = select(data, replace(CONFIG, budget_minutes=1e-9), run)
    assert (choice.chosen, choice.rule, choice.complete) == ("iql", UNTESTED, False)
    assert 0 < summary.steps == updates(run)["iql"] < CONFIG.short_updates
    assert choice.tried["bc"].outcome == "no checkpoint within the budget"
    assert mcaprl.load_policy(run).act(np.eye(2, dtype=np.float32)).shape == (2,)
    assert read_choice(run).advice[0] == (
        "Resume with a larger time budget: the budget ended early."
    )


def test_other_settings_or_data_cannot_resume(data: Dataset, finished: Path) -> None:
    with pytest.raises(TrainingError, match="has survivors 2, not 3"):
        select(data, replace(CONFIG, survivors=3), finished, seeds=2, resume=True)
    with pytest.raises(TrainingError, match="trained on other data"):
        select(log(41), CONFIG, finished, seeds=2, resume=True)
    with pytest.raises(OutputExistsError, match="choose another folder"):
        select(data, CONFIG, finished, seeds=2)


def test_growing_logs_are_refused(data: Dataset, tmp_path: Path) -> None:
    data.save(tmp_path / "log.mcap")
    growing = mcaprl.open(tmp_path / "log.mcap", follow=True)
    with pytest.raises(UsageError, match="`follow=True` is not for `algo='auto'`"):
        mcaprl.train(growing, tmp_path / "run", algo="auto")
    assert not (tmp_path / "run").exists()


def test_one_episode_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="needs 2 episodes"):
        select(log(1), CONFIG, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_auto_in_the_api_with_a_report(data: Dataset, tmp_path: Path) -> None:
    run, report = tmp_path / "run", tmp_path / "report"
    (summary,) = mcaprl.train(data, run, algo="auto", report=report, **TINY)
    choice = read_choice(run)
    assert summary.folder == run / "seed-0"
    page = (report / "index.html").read_text()
    for text in (choice.reason, choice.confidence, *choice.tried):
        assert text in page
    assert choice.tried[choice.chosen].weighted is not None
    mcaprl.train(data, run, resume=True)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"algo": "bc", "budget_minutes": 1}, "bc has no setting `budget_minutes=`"),
        ({"algo": "cql", "report": "page"}, "cql has no setting `report=`"),
        ({"algo": "auto", "other_data": True}, "`other_data=` is not for `algo='auto'`"),
        ({"algo": "auto", "ray": True}, "`ray=` is not for `algo='auto'`"),
        ({"algo": "auto", "budget_minutes": 0}, "budget_minutes must be above 0, got 0"),
        ({"algo": "auto", "frame_stack": 2}, "frame_stack must be 1 for auto, got 2"),
        ({"algo": "auto", "survivors": 0}, "survivors must be at least 1"),
        ({"algo": "auto", "finalists": "iql,ppo"}, "unknown candidate 'ppo'"),
        ({"algo": "auto", "alpha": 1.0}, "auto has no setting `alpha=`"),
    ],
)
def test_mistakes_are_one_line(
    data: Dataset, tmp_path: Path, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        mcaprl.train(data, tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


def test_the_page_shows_the_finalists_first_with_a_figure(finished: Path, tmp_path: Path) -> None:
    choice = read_choice(finished)
    text = choice.write_report(tmp_path, "Choice").read_text()
    finalists, _, others = text.partition("<h2>Other candidates</h2>")
    for name, one in choice.tried.items():
        cell = f">{name}</td>"
        assert (cell in finalists) == (one.outcome in ("chosen", "runner-up")) != (cell in others)
    assert "of the 2 finalists" in finalists
    assert "<svg" in finalists.partition("<h2>Finalists</h2>")[2]
    assert "1 for all equally often" in others


def test_a_run_of_another_algorithm_has_no_choice(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"no choice\.json"):
        read_choice(tmp_path)


def test_the_task_has_the_values_that_the_estimates_assume() -> None:
    assert TINY["gamma"] == task.GAMMA
