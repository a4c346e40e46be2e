"""Tests of the evaluation of Box policies from a log: by hand, and against slow references."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import mcaprl
from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.offline.estimate.box import QUANTILE, BehaviorCheck, BoxEvaluator, Support
from mcaprl.offline.estimate.evidence import fqe_config
from mcaprl.offline.estimate.fqe import BoxFQE, BoxFQEConfig
from mcaprl.offline.estimate.importance import EpisodeTable, usable_steps
from mcaprl.offline.estimate.off_policy import Estimate, PolicyEstimates, ranking
from tests.support.offline_tasks import A_LQ, B_LQ, BOX_LQ, COST_LQ, GAMMA

NO_MODEL = BoxFQEConfig(updates=1, batch_size=2, target_interval=1, hidden=(2,), gamma=GAMMA)
FAST = BoxFQEConfig(
    updates=900, batch_size=64, hidden=(32, 32), learning_rate=3e-3, target_interval=12, gamma=GAMMA
)


class Linear(BasePolicy):
    """The action -gain x; with a deviation, the mean of a normal distribution."""

    name = "linear"

    def __init__(self, gain: float, std: float | None = None, frame_stack: int = 1) -> None:
        self._gain, self._std, self.frame_stack = gain, std, frame_stack

    def act(self, observations: Any) -> NDArray[np.float32]:
        newest = observations if self.frame_stack == 1 else observations[:, -1]
        actions: NDArray[np.float32] = np.clip(-self._gain * newest, -4, 4).astype(np.float32)
        return actions

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.float64]:
        if self._std is None:
            raise PolicyError("a deterministic policy has no density of actions")
        z = (actions - self.act(observations))[:, 0].astype(np.float64) / self._std
        return -0.5 * z**2 - math.log(self._std * math.sqrt(2 * math.pi))


def episodes(
    count: int = 60, length: int = 25, gain: float = 1.0, std: float = 0.5, seed: int = 0
) -> mcaprl.Dataset:
    """Record the regulator from random states; the last step of an episode is truncated."""
    random = np.random.default_rng(seed)
    policy, rows = Linear(gain, std), []
    for _ in range(count):
        x = random.uniform(-1, 1, (1, 1)).astype(np.float32)
        for step in range(length):
            u = (policy.act(x) + std * random.standard_normal((1, 1))).astype(np.float32)
            following = (A_LQ * x + B_LQ * u).astype(np.float32)
            reward = -float(x[0, 0] ** 2 + COST_LQ * u[0, 0] ** 2)
            density = float(policy.log_prob(x, u)[0])
            rows.append((x[0], u[0], reward, step == length - 1, following[0], density))
            x = following
    x_, u_, rewards, ends, x_next, densities = zip(*rows, strict=True)
    return mcaprl.Dataset.from_arrays(
        observations=np.stack(x_),
        actions=np.stack(u_),
        rewards=np.array(rewards),
        terminated=np.zeros(len(rows), bool),
        truncated=np.array(ends),
        next_observations=np.stack(x_next),
        behavior_log_probs=np.array(densities),
        observation_space=spaces.Box(-4, 4, (1,), np.float32),
        action_space=BOX_LQ,
    )


def three_steps(densities: list[list[float]]) -> mcaprl.Dataset:
    """Return two episodes of three steps, with rewards 1, 2, 3 and 4, 5, 6; actions are 0 or 1."""
    ends = np.array([False, False, True] * 2)
    return mcaprl.Dataset.from_arrays(
        observations=np.arange(6, dtype=np.float32)[:, None],
        actions=np.array([[0], [1], [0], [1], [1], [0]], np.float32),
        rewards=np.arange(1.0, 7.0),
        terminated=ends,
        truncated=np.zeros(6, bool),
        next_observations=np.arange(1, 7, dtype=np.float32)[:, None],
        behavior_log_probs=np.log(np.array(densities).ravel()),
        observation_space=spaces.Box(-9, 9, (1,), np.float32),
        action_space=BOX_LQ,
    )


def by_name(found: PolicyEstimates) -> dict[str, Estimate]:
    return {estimate.estimator: estimate for estimate in found.estimates}


def test_importance_sampling_of_normal_densities_by_hand() -> None:
    torch.set_num_threads(1)
    # The policy is the normal distribution with mean 0 and deviation 1. Its density is .39894 at 0
    # and .24197 at 1. The behavior's density is half or twice that, so each ratio is 2 or 1/2.
    at_0, at_1 = 0.398942280, 0.241970725
    data = three_steps([[at_0 / 2, at_1 * 2, at_0 / 2], [at_1 / 2, at_1 / 2, at_0 * 2]])
    found = by_name(BoxEvaluator(data, NO_MODEL).evaluate(Linear(0.0, 1.0), "normal"))
    # rho is 2, 1, 2 and 2, 4, 2; gamma is .9.
    assert GAMMA == 0.9
    first = 2 * 1 + 0.9 * 1 * 2 + 0.81 * 2 * 3
    second = 2 * 4 + 0.9 * 4 * 5 + 0.81 * 2 * 6
    assert found["PDIS"].value == pytest.approx((first + second) / 2, rel=1e-5)
    weighted = (1 + 4) / 2 + 0.9 * (1 * 2 + 4 * 5) / 5 + 0.81 * (3 + 6) / 2
    assert found["WPDIS"].value == pytest.approx(weighted, rel=1e-5)
    for name in ("PDIS", "WPDIS"):
        assert found[name].usable_steps == 0
        assert "usable up to step 0 of 3" in found[name].verdict
        assert found[name].verdict.startswith("refused: ")
    assert list(found) == ["FQE", "PDIS", "WPDIS"]


def test_the_usable_steps_by_hand() -> None:
    # Four episodes: the sizes (sum rho)^2 / sum rho^2 are 4, then 2 as two weights are 0, then 1.
    ratios = np.array([[1.0, 1, 1, 1], [1, 1, 0, 1], [1, 0, 1, 1], [1, 0, 1, 1]])
    table = EpisodeTable(*(np.zeros((4, 4)),), ratios, np.zeros((4, 4)), np.zeros((4, 4)), 0.9)
    lengths = np.array([3, 3, 3, 2])
    assert [usable_steps(table, lengths, least) for least in (1, 2, 3, 4.5)] == [3, 2, 1, 0]


def test_on_policy_weights_are_one_and_all_steps_are_usable() -> None:
    data = episodes(30, 5)
    evaluator = BoxEvaluator(data, NO_MODEL)
    found = by_name(evaluator.evaluate(Linear(1.0, 0.5), "behavior"))
    for name in ("PDIS", "WPDIS"):
        assert found[name].value == pytest.approx(evaluator.behavior_return, rel=1e-5)
        assert found[name].verdict == "ok"
        assert found[name].usable_steps == 5


def test_a_deterministic_policy_and_unknown_densities_are_refused_in_one_line() -> None:
    data = episodes(4, 5)
    found = by_name(BoxEvaluator(data, NO_MODEL).evaluate(Linear(1.0), "mode"))
    refusal = "refused: a deterministic policy has no density of actions"
    assert [found[name].verdict for name in ("PDIS", "WPDIS")] == [refusal, refusal]
    assert found["PDIS"].value is None
    unknown = data.behavior_log_probs.copy()
    unknown[3] = np.nan
    lacking = data.with_behavior_log_probs(unknown)
    found = by_name(BoxEvaluator(lacking, NO_MODEL).evaluate(Linear(1.0, 0.5), "normal"))
    assert found["WPDIS"].verdict == (
        "refused: behavior_log_prob of 1 of 20 steps is unknown; `estimate_behavior=True`"
        " estimates it"
    )
    far = data.with_behavior_log_probs(np.full(20, -300.0))
    found = by_name(BoxEvaluator(far, NO_MODEL).evaluate(Linear(1.0, 0.5), "normal"))
    assert "importance weight is" in found["PDIS"].verdict


def true_value(data: mcaprl.Dataset, gain: float) -> float:
    """Return the mean value -P x^2 of the policy -gain x in the first states."""
    p = (1 + COST_LQ * gain**2) / (1 - GAMMA * (A_LQ - B_LQ * gain) ** 2)
    first = np.array([episode.observations[0, 0] for episode in data.episodes])
    return float(-p * np.square(first).mean())


def test_fqe_ranks_policies_and_its_check_of_the_behavior_passes() -> None:
    torch.set_num_threads(1)
    data = episodes(80, 25)
    evaluator = BoxEvaluator(data, FAST)
    assert evaluator.updates_of_model == 2 * FAST.updates
    calls: list[int] = []
    found = [
        by_name(evaluator.evaluate(Linear(gain), f"{gain}", on_update=lambda: calls.append(1)))
        for gain in (1.5, 0.0)
    ]
    assert len(calls) == 3 * evaluator.updates_of_model
    check = evaluator.check_behavior()
    assert check.passes, str(check)
    assert check.interval[0] < check.returned < check.interval[1]
    for gain, each in zip((1.5, 0.0), found, strict=True):
        assert each["FQE"].value == pytest.approx(true_value(data, gain), abs=0.25)
        assert each["FQE"].spread is not None
        assert each["FQE"].spread > 0
        assert each["FQE"].verdict.startswith("no interval")
        assert not each["FQE"].trusted
    order = ranking([each["FQE"] for each in found])
    assert order == {"estimator": "FQE", "policies": ["1.5", "0.0"], "trusted": False, "close": []}


def test_a_wrong_critic_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    data = episodes(80, 25)
    evaluator = BoxEvaluator(data, NO_MODEL)
    own = BoxFQE.values_of
    monkeypatch.setattr(BoxFQE, "values_of", lambda self, *given: own(self, *given) - 5.0)
    found = by_name(evaluator.evaluate(Linear(1.0, 0.5), "normal"))
    check = evaluator.check_behavior()
    assert not check.passes
    low, high = check.interval
    assert found["FQE"].verdict == (
        f"refused: {check.predicted:.2f} for the behavior, which returned {low:.2f} to {high:.2f}"
    )
    assert str(check).endswith("do not trust its values")
    assert check.to_json()["passes"] is False


def test_a_truncated_episode_is_continued_by_the_value_of_its_last_action(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = episodes(6, 3)
    monkeypatch.setattr(
        BoxFQE, "values_of", lambda self, actions, rows: torch.full((4, len(rows)), -7.0)
    )
    check = BoxEvaluator(data, NO_MODEL).check_behavior()
    rewards = data.rewards.reshape(6, 3)
    expected = (rewards[:, 0] + GAMMA * rewards[:, 1] - GAMMA**2 * 7).mean()
    assert check.returned == pytest.approx(expected)
    assert (check.predicted, check.spread) == (-7, 0)


def test_the_check_by_hand() -> None:
    inside = BehaviorCheck(predicted=2.0, spread=0.1, returned=1.0, interval=(0.0, 2.0))
    assert inside.passes
    assert str(inside) == (
        "FQE predicts 2.000 +- 0.100 for the behavior, whose held-out episodes returned 1.000"
        " (0.000 to 2.000)"
    )
    assert not BehaviorCheck(2.01, 0.1, 1.0, (0.0, 2.0)).passes
    assert not BehaviorCheck(math.nan, 0.1, 1.0, (0.0, 2.0)).passes


def test_single_steps_that_are_truncated_are_refused() -> None:
    with pytest.raises(UsageError, match="two successive actions"):
        BoxEvaluator(episodes(6, 1), NO_MODEL).check_behavior()


def test_epsilon_needs_discrete_actions() -> None:
    with pytest.raises(UsageError, match="`epsilon=` needs discrete actions"):
        BoxEvaluator(episodes(2, 3), NO_MODEL).evaluate(Linear(1.0), "linear", epsilon=0.1)


def test_stacks_of_one_frame_each_evaluate_as_single_frames() -> None:
    data = episodes(6, 5)
    one, two = (
        BoxEvaluator(data, NO_MODEL).evaluate(Linear(1.0, 0.5, count), "linear") for count in (1, 2)
    )
    assert one == two


def slow_support(
    states: NDArray[np.float64],
    logged: NDArray[np.float64],
    actions: NDArray[np.float64],
    episode: NDArray[np.int64],
) -> float:
    """Compute the support by loops over all pairs of rows."""

    def distance(row: int, action: NDArray[np.float64]) -> float:
        best = math.inf
        for other in range(len(states)):
            if episode[other] != episode[row]:
                total = 0.0
                for mine, theirs, all_of in (
                    (states[row], states[other], states),
                    (action, logged[other], logged),
                ):
                    scale = [float(column.std()) or 1.0 for column in all_of.T]
                    each = [((x - y) / s) ** 2 for x, y, s in zip(mine, theirs, scale, strict=True)]
                    total += sum(each) / len(each)
                best = min(best, math.sqrt(total))
        return best

    own = [distance(row, logged[row]) for row in range(len(states))]
    limit = np.quantile(own, QUANTILE)
    return float(
        np.mean([distance(row, actions[row]) <= limit * (1 + 1e-12) for row in range(len(states))])
    )


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(4, 24), parts=st.integers(1, 3))
def test_support_equals_the_slow_reference(seed: int, rows: int, parts: int) -> None:
    random = np.random.default_rng(seed)
    states, logged = random.normal(size=(rows, 4)), random.normal(size=(rows, parts))
    states[:, 3] = 2.0
    actions = logged + random.normal(size=(rows, parts))
    episode = np.sort(random.integers(0, 3, rows))
    episode[0], episode[-1] = 0, 3
    found = Support(states, logged, episode).of(actions)
    assert found == pytest.approx(slow_support(states, logged, actions, episode))


def test_support_of_the_logged_actions_and_of_far_ones() -> None:
    random = np.random.default_rng(0)
    states = random.uniform(-1, 1, (3_000, 2))
    logged = states[:, :1] + 0.1 * random.normal(size=(3_000, 1))
    support = Support(states, logged, np.arange(3_000) // 10)
    assert support.of(logged) == pytest.approx(QUANTILE, abs=0.001)
    assert support.of(states[:, :1]) > QUANTILE
    assert support.of(-logged) < 0.4
    assert support.of(logged + 10) == 0


def test_policies_whose_values_differ_by_less_than_the_noise_are_close() -> None:
    def one(name: str, value: float, spread: float) -> Estimate:
        return Estimate(name, "FQE", value, None, None, "no interval: x", spread)

    order = ranking([one("a", 1.0, 0.3), one("b", 2.0, 0.4), one("c", 0.9, 0.3)])
    # Two standard deviations of the difference are 2 * .5 = 1.
    assert (order["policies"], order["close"]) == (["b", "a", "c"], [])
    order = ranking([one("a", 1.1, 0.3), one("b", 2.0, 0.4), one("c", 0.9, 0.3)])
    assert order["close"] == ["a"]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    episodes(12, 6).save(tmp_path / "log.mcap")
    return tmp_path / "log.mcap"


def test_the_command_prints_the_four_parts_in_order(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from mcaprl.cli import run

    arguments = ["evaluate", "random", "--data", str(log), "--updates", "20", "--gamma", "0.9"]
    assert run([*arguments, "--all"]) == 0
    shown = capsys.readouterr().out
    parts = ["mean return discounted", "FQE predicts", "importance sampling", "actions as near to"]
    places = [shown.index(part) for part in parts]
    assert places == sorted(places)
    assert run([*arguments, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["estimator"] for one in found["estimates"]] == ["FQE", "PDIS", "WPDIS"]
    assert 0 <= found["support"]["random"] <= 1
    assert found["coverage"] == {}
    assert found["behavior_check"]["text"].startswith("FQE predicts")
    again = mcaprl.estimate("random", log, updates=20, gamma=0.9)
    assert found.pop("action_errors")["policies"][0]["policy"] == "random"
    assert json.loads(json.dumps(again.to_json())) == found
    assert again.behavior_check is not None


def test_the_random_policy_is_evaluated_by_its_seed(log: Path) -> None:
    first, second = (mcaprl.estimate("random", mcaprl.open(log), updates=3, seed=4) for _ in "ab")
    assert first.estimates == second.estimates
    assert isinstance(RandomPolicy(BOX_LQ).log_prob(None, np.zeros((2, 1)))[0], float)
    assert fqe_config(0.97, 3_000, is_box=True).target_interval == 15
