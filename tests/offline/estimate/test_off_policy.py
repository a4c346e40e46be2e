"""Tests of off-policy estimates: true values, on-policy estimates and refused verdicts."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy
from mcaprl.errors import UsageError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.estimate.fqe import FQE, FQEConfig, return_bounds
from mcaprl.offline.estimate.importance import ESTIMATORS
from mcaprl.offline.estimate.off_policy import (
    Estimate,
    OffPolicyEvaluator,
    PolicyEstimates,
    ranking,
)
from mcaprl.recorder.dataset.dataset import Dataset
from tests.support import two_state_task as task

FAST = FQEConfig(updates=1_500, batch_size=64, target_interval=25, hidden=(32,), gamma=task.GAMMA)
NO_MODEL = FQEConfig(updates=1, batch_size=2, target_interval=1, hidden=(2,), gamma=task.GAMMA)


class Table(BasePolicy):
    """Policy of the two-state task, given by its probabilities (states, actions)."""

    def __init__(self, probabilities: NDArray[np.float64]) -> None:
        self._probabilities = probabilities

    def action_probabilities(self, observations: Any) -> NDArray[np.float64]:
        rows: NDArray[np.float64] = self._probabilities[observations.argmax(1)]
        return rows


def log(
    episodes: int,
    seed: int = 0,
    acting: NDArray[np.float64] = task.BEHAVIOR,
    *,
    also_truncated: bool = False,
) -> Dataset:
    """Return episodes of the task as a dataset with one-hot observations.

    If `also_truncated`, the last step of each episode has both end flags.
    """
    random = np.random.default_rng(seed)
    columns: list[tuple[int, int, int, float, bool, float]] = []
    for _ in range(episodes):
        state, ended = 0, False
        while not ended:
            action = int(random.random() < acting[state, 1])
            after = int(random.random() < task.TO_ONE[state, action])
            ended = random.random() < task.ENDS
            paid = float(task.PAYS[state, action])
            columns.append((state, action, after, paid, ended, float(acting[state, action])))
            state = after
    states, actions, afters, paid_, ends, probs = map(np.array, zip(*columns, strict=True))
    eye = np.eye(2, dtype=np.float32)
    return Dataset.from_arrays(
        observations=eye[states],
        actions=actions,
        rewards=paid_,
        terminated=ends,
        truncated=ends & also_truncated,
        next_observations=eye[afters],
        behavior_probs=probs,
        observation_space=spaces.Box(0, 1, (2,), np.float32),
        action_space=spaces.Discrete(2),
    )


def by_name(found: PolicyEstimates) -> dict[str, Estimate]:
    return {estimate.estimator: estimate for estimate in found.estimates}


@pytest.mark.parametrize(
    ("rewards", "gamma", "bounds"),
    [
        ([0.0, 1.0], 0.9, (0.0, 10.0)),
        ([-1.0, 0.5], 0.5, (-2.0, 1.0)),
        ([2.0, 3.0], 0.5, (2.0, 6.0)),
        ([-3.0, -2.0], 0.5, (-6.0, -2.0)),
        ([0.0, 1.0], 1.0, (0.0, math.inf)),
        ([0.5, 1.0], 0.0, (0.5, 1.0)),
    ],
)
def test_return_bounds_by_hand(
    rewards: list[float], gamma: float, bounds: tuple[float, float]
) -> None:
    assert return_bounds(torch.tensor(rewards), gamma) == pytest.approx(bounds)


def test_fitted_q_evaluation_learns_the_true_values() -> None:
    data = log(1_000)
    buffer = TransitionBuffer.from_dataset(data, FAST.packing)
    pi_t = torch.from_numpy(task.EVALUATED[data.next_observations.argmax(1)].astype(np.float32))
    learner = FQE(FAST, buffer, [0], pi_t.unsqueeze(0))
    for _ in range(FAST.updates):
        learner.update()
    values = learner.values(next_states=False)[0].numpy()
    learned = [values[data.observations[:, state] == 1][0] for state in (0, 1)]
    np.testing.assert_allclose(learned, task.TRUE_Q, rtol=0.08)


def test_every_estimator_converges_to_the_true_value() -> None:
    evaluator = OffPolicyEvaluator(log(1_500), FAST)
    evaluated = evaluator.evaluate(Table(task.EVALUATED), "better")
    found = by_name(evaluated)
    assert list(found) == ["FQE", *ESTIMATORS]
    for name, estimate in found.items():
        assert estimate.trusted == (name != "FQE")
        assert estimate.value == pytest.approx(task.true_value(), rel=0.12)
    assert evaluated.coverage is not None
    assert 0.4 < evaluated.coverage < 0.65, "the policy's probabilities are .35 to .65"
    widths = {
        name: estimate.interval[1] - estimate.interval[0]
        for name, estimate in found.items()
        if estimate.interval is not None
    }
    assert widths["DR"] < widths["PDIS"] < widths["TIS"]


def test_on_policy_estimates_agree_with_the_logged_returns() -> None:
    evaluator = OffPolicyEvaluator(log(400), FAST)
    found = by_name(evaluator.evaluate(Table(task.BEHAVIOR), "behavior"))
    for name in ("TIS", "WIS", "PDIS", "WPDIS"):
        assert found[name].value == pytest.approx(evaluator.behavior_return)
        assert found[name].interval == pytest.approx(evaluator.behavior_interval)
        assert found[name].effective_sample_size == pytest.approx(400)
    low, high = evaluator.behavior_interval
    for name in ("FQE", "DR", "WDR"):
        value = found[name].value
        assert value is not None
        assert low - (high - low) < value < high + (high - low)


def test_a_log_of_other_actions_has_no_verdict() -> None:
    always_one = np.array([[0.001, 0.999], [0.001, 0.999]])
    evaluator = OffPolicyEvaluator(log(40, acting=always_one), NO_MODEL)
    never_one = Table(np.array([[1.0, 0.0], [1.0, 0.0]]))
    found = by_name(evaluator.evaluate(never_one, "other"))
    for name in ESTIMATORS:
        assert not found[name].trusted
        assert "effective episodes, 10 needed" in found[name].verdict


def test_a_mean_weight_far_from_one_has_no_verdict() -> None:
    """Half of the log never takes one of the policy's actions: the mean weight is about 1/2."""
    always_one = np.array([[1e-6, 1 - 1e-6], [1e-6, 1 - 1e-6]])
    data = Dataset.concatenate([log(60), log(60, seed=1, acting=always_one)])
    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(Table(task.BEHAVIOR), "half"))
    for name in ("TIS", "PDIS", "DR"):
        assert (found[name].effective_sample_size or 0) > 10
        assert found[name].verdict.startswith("refused: mean importance weight 0.")
    for name in ("WIS", "WPDIS"):
        assert found[name].trusted, "these divide by the weights"


def test_unknown_probabilities_leave_only_the_model_estimate() -> None:
    data = log(60)
    data.behavior_probs[:5] = math.nan
    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(None, "random"))
    assert found["FQE"].value is not None
    for name in ESTIMATORS:
        assert found[name].value is None
        assert found[name].verdict == (
            f"refused: behavior_prob of 5 of {len(data)} steps is unknown;"
            " `estimate_behavior=True` estimates it"
        )


def test_the_model_estimate_has_no_interval_and_is_never_trusted() -> None:
    evaluator = OffPolicyEvaluator(log(400), FAST)
    policies = {"better": task.EVALUATED, "behavior": task.BEHAVIOR}
    found = [
        estimate
        for name, table in policies.items()
        for estimate in evaluator.evaluate(Table(table), name).estimates
    ]
    for estimate in found[:: len(ESTIMATORS) + 1]:
        assert estimate.estimator == "FQE"
        assert estimate.value is not None
        assert estimate.interval is None
        assert estimate.verdict.startswith("no interval: the error of the model")
    assert ranking(found)["estimator"] == "WDR"
    refused = [
        estimate if estimate.estimator == "FQE" else replace(estimate, verdict="refused: test")
        for estimate in found
    ]
    assert ranking(refused) == {
        "estimator": "FQE",
        "policies": ["better", "behavior"],
        "trusted": False,
        "close": [],
    }


@pytest.mark.parametrize("prob", [-0.5, 0.0, 2.0, math.inf])
def test_impossible_probabilities_are_refused(prob: float) -> None:
    data = log(60)
    data.behavior_probs[3:5] = prob
    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(None, "random"))
    for name in ESTIMATORS:
        assert (found[name].value, found[name].interval) == (None, None)
        assert found[name].verdict == (
            f"refused: behavior_prob of 2 of {len(data)} steps is not a number in (0, 1]"
        )


@pytest.mark.parametrize("steps", [slice(None), slice(7, 8), slice(None, None, 20)])
def test_tiny_probabilities_have_finite_values_and_no_verdict(steps: slice) -> None:
    data = log(300)
    data.behavior_probs[steps] = 1e-38
    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(None, "random"))
    for name in ESTIMATORS:
        estimate = found[name]
        assert not estimate.trusted
        assert estimate.value is None or math.isfinite(estimate.value)
        assert estimate.interval is None or np.isfinite(np.array(estimate.interval)).all()


def test_weights_that_overflow_are_refused() -> None:
    steps = 400
    data = Dataset.from_arrays(
        observations=np.zeros((2 * steps, 1), np.float32),
        actions=np.arange(2 * steps) % 10,
        rewards=np.ones(2 * steps),
        terminated=np.arange(2 * steps) % steps == steps - 1,
        truncated=np.zeros(2 * steps, np.bool_),
        next_observations=np.zeros((2 * steps, 1), np.float32),
        behavior_probs=np.full(2 * steps, 0.1),
        action_space=spaces.Discrete(10),
    )

    class Follows(BasePolicy):
        """Policy that always takes the logged action."""

        def action_probabilities(self, observations: Any) -> NDArray[np.float64]:
            return np.eye(10)[np.arange(len(observations)) % 10]

    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(Follows(), "follows"))
    for name in ESTIMATORS:
        assert found[name].verdict == "refused: an importance weight is inf, above 1e+100"


def test_the_model_adds_no_value_after_a_terminal_state() -> None:
    config = FQEConfig(updates=200, hidden=(4,), gamma=0.9)
    found = [
        OffPolicyEvaluator(log(100, also_truncated=both), config).evaluate(
            Table(task.EVALUATED), "evaluated"
        )
        for both in (False, True)
    ]
    assert [one.value for one in found[0].estimates] == [one.value for one in found[1].estimates]


def test_random_actions_are_uniform_over_the_allowed_ones() -> None:
    """Of four actions, a state allows two, and the log is uniform over these."""
    steps, random = 200, np.random.default_rng(0)
    mask: NDArray[np.int8] = np.tile(np.array([[1, 1, 0, 0], [0, 0, 1, 1]], np.int8), (100, 1))
    seen: dict[str, NDArray[Any]] = {"action_mask": mask, "x": np.zeros((steps, 1), np.float32)}
    data = Dataset.from_arrays(
        observations=seen,
        actions=2 * (np.arange(steps) % 2) + random.integers(2, size=steps),
        rewards=np.ones(steps),
        terminated=np.arange(steps) % 10 == 9,
        truncated=np.zeros(steps, np.bool_),
        next_observations={key: np.roll(part, -1, axis=0) for key, part in seen.items()},
        behavior_probs=np.full(steps, 0.5),
        observation_space=spaces.Dict(
            {"action_mask": spaces.MultiBinary(4), "x": spaces.Box(-1, 1, (1,))}
        ),
        action_space=spaces.Discrete(4),
    )
    found = by_name(OffPolicyEvaluator(data, NO_MODEL).evaluate(None, "random"))
    value = (1 - NO_MODEL.gamma**10) / (1 - NO_MODEL.gamma)
    for name in ("TIS", "WIS", "PDIS", "WPDIS"):
        assert found[name].value == pytest.approx(value)


def test_a_policy_with_a_frame_stack_sees_the_frames_before() -> None:
    """The policy takes the action of the state before, which a stack of two frames contains."""

    class Repeats(BasePolicy):
        """Policy that takes action k after state k."""

        frame_stack = 2

        def action_probabilities(self, observations: Any) -> NDArray[np.float64]:
            assert observations.shape[1:] == (2, 2)
            return np.asarray(observations[:, 0], np.float64)

    data = log(100)
    states = data.observations.argmax(1)
    starts = np.cumsum(data.episode_lengths) - data.episode_lengths
    before = np.concatenate([[0], states[:-1]])
    before[starts] = states[starts]
    found = OffPolicyEvaluator(data, NO_MODEL).evaluate(Repeats(), "repeats")
    assert found.coverage == pytest.approx((data.actions == before).mean())


def test_too_few_target_syncs_refuse_the_verdict() -> None:
    config = FQEConfig(updates=100, target_interval=25, hidden=(4,), gamma=0.9)
    estimate = OffPolicyEvaluator(log(200), config).evaluate(Table(task.BEHAVIOR), "same")
    assert estimate.estimates[0].verdict.startswith(
        "refused: 4 target syncs are too few for gamma 0.9"
    )


def test_a_single_episode_is_refused() -> None:
    with pytest.raises(UsageError, match="needs 2 episodes or more"):
        OffPolicyEvaluator(log(1), NO_MODEL)


def test_epsilon_mixes_in_random_actions() -> None:
    evaluator = OffPolicyEvaluator(log(300), NO_MODEL)
    greedy = Table(np.array([[0.0, 1.0], [0.0, 1.0]]))
    half = Table(np.array([[0.25, 0.75], [0.25, 0.75]]))
    mixed = by_name(evaluator.evaluate(greedy, "greedy", epsilon=0.5))["PDIS"]
    assert mixed.value == pytest.approx(by_name(evaluator.evaluate(half, "half"))["PDIS"].value)


def test_the_same_seed_has_the_same_estimates() -> None:
    first, second = (
        OffPolicyEvaluator(log(50), NO_MODEL, seed=3).evaluate(None, "random") for _ in range(2)
    )
    assert first == second
