"""Tests of `auto` on logs with the actions of a Box: portfolio, rule, resume and report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

import mcaprl
from mcaprl.base_policy import BasePolicy
from mcaprl.errors import SpaceError, UnknownNameError
from mcaprl.offline.algorithms.config import BoxBCConfig, BoxIQLConfig, ReBRACConfig
from mcaprl.offline.estimate.box import BehaviorCheck
from mcaprl.offline.estimate.evidence import (
    CLOSE,
    BoxEvidenceCollector,
    fqe_config,
    likely_commands,
)
from mcaprl.offline.policy import read_policy
from mcaprl.offline.selection.choice import (
    AGREEMENT,
    ESTIMATE,
    PRIOR,
    Rating,
    decide,
    read_choice,
)
from mcaprl.offline.selection.config import AutoConfig
from mcaprl.offline.selection.race import BOX_PORTFOLIO, PORTFOLIO, portfolio, select
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from tests.offline.selection.test_race import Interrupted, updates, weights
from tests.support.offline_tasks import BOX_LQ, COST_LQ, regulator, riccati

TINY: dict[str, Any] = {
    "updates": 40,
    "batch_size": 16,
    "hidden": (16,),
    "learning_rate": 0.02,
    "log_interval": 5,
    "gamma": 0.5,
    "survivors": 3,
    "model_updates": 60,
}
CONFIG = AutoConfig(**TINY)


class Normal(BasePolicy):
    """Policy with a normal distribution around -gain x."""

    def __init__(self, gain: float, deviation: float) -> None:
        self.gain, self.deviation = gain, deviation

    def act(self, observations: Any) -> NDArray[np.float32]:
        found: NDArray[np.float32] = np.clip(-self.gain * observations, -4, 4)
        return found

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = -np.square(
            (actions - self.act(observations)) / self.deviation
        ).sum(1)
        return found / 2


@pytest.fixture(scope="module")
def data() -> Dataset:
    return regulator(120)


@pytest.fixture(scope="module")
def finished(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("auto") / "run"
    select(data, CONFIG, run, seeds=2)
    return run


def test_the_candidates_depend_on_the_action_space() -> None:
    assert portfolio(BOX_LQ) is BOX_PORTFOLIO
    assert portfolio(spaces.Discrete(3)) is portfolio(spaces.MultiBinary(2)) is PORTFOLIO
    assert {one.algo for one in BOX_PORTFOLIO} == {"bc", "td3-bc", "rebrac", "iql"}


def test_a_candidate_has_its_own_defaults_unless_auto_is_given_others() -> None:
    found = {one.name: one.config(AutoConfig(gamma=0.5)) for one in BOX_PORTFOLIO}
    assert found["iql"] == BoxIQLConfig(gamma=0.5, checkpoint_interval=500)
    assert found["rebrac"] == ReBRACConfig(gamma=0.5, checkpoint_interval=500)
    assert found["bc-top-0.1"] == BoxBCConfig(top=0.1, checkpoint_interval=500)
    given = BOX_PORTFOLIO[0].config(AutoConfig(target_interval=7))
    assert given == BoxIQLConfig(target_interval=7, checkpoint_interval=500)


def rating(low: float, high: float) -> Rating:
    return Rating((low + high) / 2, (low, high), 0.5, (low + high) / 2, 0.5)


@pytest.mark.parametrize(
    ("estimate", "best", "chosen", "rule"),
    [
        # The interval of bc is above that of iql, and the models are right for the behavior.
        (2.1, (5.0, 6.0), "bc", ESTIMATE),
        # The same, but the models overestimate the behavior by more than its interval.
        (2.6, (5.0, 6.0), "iql", PRIOR),
        # The intervals of bc and iql overlap.
        (2.1, (3.9, 6.0), "iql", PRIOR),
    ],
)
def test_the_rule_by_hand(
    estimate: float, best: tuple[float, float], chosen: str, rule: str
) -> None:
    ratings = {"bc": rating(*best), "iql": rating(2.0, 4.0)}
    check = BehaviorCheck(estimate, 0.1, 2.0, (1.5, 2.5))
    assert decide(ratings, ["iql", "bc"], check) == (chosen, rule)
    assert decide(ratings, ["iql", "bc"], None) == ("iql", PRIOR)


def test_without_a_doubt_the_estimates_confirm_the_usual_choice() -> None:
    ratings = {"iql": rating(2.0, 4.0), "bc": rating(1.9, 4.0)}
    check = BehaviorCheck(2.0, 0.1, 2.0, (1.5, 2.5))
    assert decide(ratings, ["iql", "bc"], check) == ("iql", ESTIMATE)


def test_an_action_is_likely_above_a_tenth_of_the_largest_density() -> None:
    # exp(-z^2 / 2) = 0.1 for z = 2.146.
    seen, clone = np.zeros((4, 1), np.float32), Normal(0, 0.5)
    actions = 0.5 * np.array([[0.0], [2.14], [-2.14], [2.15]])
    assert likely_commands(clone, seen, actions).tolist() == [True, True, True, False]


def test_the_values_of_one_step_are_the_rewards(data: Dataset) -> None:
    many = regulator(2_000)
    model = replace(fqe_config(0.0, 600, is_box=True), learning_rate=3e-3)
    collector = BoxEvidenceCollector(many, Normal(0, 4), model)
    optimal, wild = collector.collect([Normal(riccati()[1], 1), Normal(3, 1)])
    x = many.observations.ravel()
    for evidence, gain in ((optimal, riccati()[1]), (wild, 3)):
        expected = -(x**2) - COST_LQ * (gain * x) ** 2
        assert evidence.first_value == pytest.approx(expected.mean(), abs=0.03)
        assert evidence.first_values.shape == (2_000,)
    assert optimal.behavior[0].mean() == pytest.approx(many.rewards.mean(), abs=0.03)
    assert optimal.behavior.shape == (2, 2_000)
    assert optimal.support == 1
    close = np.abs(Normal(3, 1).act(many.observations) - many.actions) / 4 <= CLOSE
    assert wild.agreement == pytest.approx(close.mean())
    assert (wild.own_value, wild.bellman_error) == (None, None)


def test_rare_actions_have_the_low_value(data: Dataset) -> None:
    model = fqe_config(0.5, 5, is_box=True)
    collector = BoxEvidenceCollector(data, Normal(0, 0.01), model)
    (found,) = collector.collect([Normal(3, 1)])
    rare = np.abs(3 * data.observations.ravel()) > 0.01 * np.sqrt(2 * np.log(10))
    assert found.support == pytest.approx(1 - rare.mean())
    np.testing.assert_allclose(found.first_values[rare], collector.low_value)
    plain = BoxEvidenceCollector(data, Normal(0, 0.01), model, pessimistic=False)
    assert not (plain.collect([Normal(3, 1)])[0].first_values == collector.low_value).any()


def test_the_usual_choice_and_the_best_make_all_updates(finished: Path) -> None:
    done = updates(finished)
    assert set(done) == {one.name for one in BOX_PORTFOLIO}
    assert sorted(done.values()) == [10, 10, 40, 40, 40]
    assert done["iql"] == 40
    choice = read_choice(finished)
    assert choice.complete
    assert choice.tried[choice.chosen].outcome == "chosen"
    assert next(iter(choice.tried)) == choice.chosen
    for seed in ("seed-0", "seed-1"):
        found, wanted = (
            (folder / seed / "policy.safetensors").read_bytes()
            for folder in (finished, finished / "candidates" / choice.chosen)
        )
        assert found == wanted
    policy = mcaprl.load_policy(finished)
    assert policy.act(np.zeros((3, 1), np.float32)).shape == (3, 1)


def test_the_choice_says_which_rule_decided(finished: Path) -> None:
    choice = read_choice(finished)
    assert choice.rule in (ESTIMATE, PRIOR)
    check = choice.tried[choice.chosen].check
    assert check is not None
    assert check.interval[0] < check.returned < check.interval[1]
    assert str(check) in choice.reason + choice.confidence
    assert all(one.weighted is None for one in choice.tried.values())


def test_the_return_of_a_truncated_episode_continues_with_the_value() -> None:
    """Two episodes of two steps with the rewards 1 and 2: one ends, the other one is cut."""
    data = Dataset.from_arrays(
        observations=np.arange(4, dtype=np.float32)[:, None],
        actions=np.array([[0.5], [-0.5], [0.25], [-0.25]], np.float32),
        rewards=np.array([1.0, 2.0, 1.0, 2.0]),
        terminated=np.array([False, True, False, False]),
        truncated=np.array([False, False, False, True]),
        next_observations=np.arange(1, 5, dtype=np.float32)[:, None],
        action_space=BOX_LQ,
    )
    collector = BoxEvidenceCollector(data, Normal(0, 4), fqe_config(0.5, 3, is_box=True))
    (found,) = collector.collect([Normal(0, 4)])
    _, returned = found.behavior
    assert returned[0] == 1 + 0.5 * 2
    assert returned[1] != returned[0]
    # The value of the last action is within those of rewards from 1 to 2 for ever.
    assert 1 <= returned[1] <= 1 + 0.5 * 4


def test_the_log_of_random_actions_has_the_traits_of_one(finished: Path) -> None:
    traits = read_choice(finished).traits
    assert traits.entropy > 0.5
    assert traits.coverage > 0.5
    assert not traits.probabilities


def test_the_log_of_a_precise_policy_is_imitated(tmp_path: Path) -> None:
    precise = regulator(400, noise=0.01)
    config = replace(CONFIG, updates=400, batch_size=64, finalists="iql,bc", survivors=2)
    choice, _ = select(precise, config, tmp_path / "run")
    assert choice.traits.entropy < 0.05
    assert choice.rule == AGREEMENT
    ratings = [choice.tried[name].rating for name in ("bc", "iql")]
    assert all(one is not None and one.score == one.agreement for one in ratings)


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
        assert read_policy(run / "seed-1").act(np.zeros((2, 1), np.float32)).shape == (2, 1)
    select(data, CONFIG, run, seeds=2, resume=True)
    assert weights(run) == weights(finished)
    assert read_choice(run) == read_choice(finished)


def test_candidates_of_other_spaces_are_unknown(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown candidate 'cql'") as caught:
        mcaprl.train(data, tmp_path / "run", algo="auto", finalists="iql,cql")
    assert "td3-bc" in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_the_page_has_the_reason(data: Dataset, tmp_path: Path) -> None:
    run, report = tmp_path / "run", tmp_path / "report"
    mcaprl.train(data, run, algo="auto", report=report, **TINY)
    page, choice = (report / "index.html").read_text(), read_choice(run)
    for text in (choice.reason, choice.confidence, *choice.tried):
        assert text in page


def test_actions_outside_the_box_are_clipped_on_request(tmp_path: Path) -> None:
    log = regulator(120)
    actions = np.where(np.arange(120)[:, None] % 10, log.actions, 5.0).astype(np.float32)
    columns = {name: getattr(log, name) for name in ("observations", "rewards", "terminated")}
    outside = Dataset.from_arrays(
        **columns,
        actions=actions,
        truncated=log.truncated,
        next_observations=log.next_observations,
        action_space=BOX_LQ,
    )
    with pytest.raises(SpaceError, match="outside"):
        select(outside, CONFIG, tmp_path / "refused")
    choice, _ = select(outside, replace(CONFIG, clip_actions=True), tmp_path / "run")
    assert 0.5 < choice.traits.entropy <= 1


def test_a_box_of_integers_is_refused_before_the_run_exists(tmp_path: Path) -> None:
    log = regulator(20)
    whole = Dataset.from_arrays(
        observations=log.observations,
        actions=np.round(log.actions).astype(np.int32),
        rewards=log.rewards,
        terminated=log.terminated,
        truncated=log.truncated,
        next_observations=log.next_observations,
        action_space=spaces.Box(-4, 4, (1,), np.int32),
    )
    with pytest.raises(SpaceError, match="has integers"):
        mcaprl.train(whole, tmp_path / "run", algo="auto")
    assert not (tmp_path / "run").exists()
