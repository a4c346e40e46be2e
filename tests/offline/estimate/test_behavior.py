"""Tests of estimated behavior probabilities: accuracy, cross-fitting, calibration and marks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import SpaceError, UsageError
from mcaprl.offline.estimate.behavior import estimate_behavior, reliability
from mcaprl.offline.estimate.fqe import FQEConfig
from mcaprl.offline.estimate.off_policy import BY_ESTIMATES, OffPolicyEvaluator

EPSILON = 0.3
STATES, ACTIONS = 4, 3


def tabular(episodes: int = 60, length: int = 25, seed: int = 0) -> mcaprl.Dataset:
    """Return a log of an epsilon-greedy policy, whose greedy action is the state modulo 3."""
    random = np.random.default_rng(seed)
    count = episodes * length
    states = random.integers(STATES, size=count + 1)
    greedy = states[:-1] % ACTIONS
    explores = random.random(count) < EPSILON
    actions = np.where(explores, random.integers(ACTIONS, size=count), greedy)
    probs = np.where(actions == greedy, 1 - EPSILON, 0.0) + EPSILON / ACTIONS
    frames = np.eye(STATES, dtype=np.float32)[states]
    ends = np.arange(1, count + 1) % length == 0
    return mcaprl.Dataset.from_arrays(
        observations=frames[:-1],
        next_observations=frames[1:],
        actions=actions,
        rewards=(actions == greedy).astype(float),
        terminated=ends,
        truncated=np.zeros(count, bool),
        behavior_probs=probs,
        action_space=spaces.Discrete(ACTIONS),
    )


def test_estimates_approach_the_probabilities_of_the_policy() -> None:
    data = tabular()
    found = estimate_behavior(data, updates=300)
    true, estimated = data.behavior_probs, found.dataset.behavior_probs
    # The greedy action has the probability 0.8, and the two others 0.1. With 1,200 steps for
    # 4 states, the classifier estimates them to about 0.03.
    assert np.abs(true - estimated).max() < 0.08
    assert np.abs(true - estimated).mean() < 0.02
    assert found.calibration_error < 0.02
    assert len(found.folds) == 5
    assert sum(fold.episodes for fold in found.folds) == len(data.episodes)
    for fold in found.folds:
        assert fold.uniform == pytest.approx(-np.log(3))
        assert fold.log_likelihood > fold.marginal + 0.2
    assert "calibration error 0.0" in str(found)
    json.dumps(found.to_json())


def test_an_episode_is_predicted_by_networks_that_did_not_see_it() -> None:
    data = tabular(episodes=12)
    first = estimate_behavior(data, updates=40).dataset.behavior_probs
    changed = data.actions.copy()
    changed[:25] = (changed[:25] + 1) % ACTIONS
    arrays = {name: getattr(data, name) for name in ("rewards", "terminated", "truncated")}
    other = mcaprl.Dataset.from_arrays(
        observations=data.observations,
        next_observations=data.next_observations,
        actions=changed,
        action_space=data.action_space,
        **arrays,
    )
    second = estimate_behavior(other, updates=40)
    # The three logs have different actions in the first rows. The probabilities of these three
    # actions sum to 1.
    third_actions = (changed[:25] + 1) % ACTIONS
    changed = data.actions.copy()
    changed[:25] = third_actions
    last = estimate_behavior(
        mcaprl.Dataset.from_arrays(
            observations=data.observations,
            next_observations=data.next_observations,
            actions=changed,
            action_space=data.action_space,
            **arrays,
        ),
        updates=40,
    )
    total = first[:25] + second.dataset.behavior_probs[:25] + last.dataset.behavior_probs[:25]
    assert total == pytest.approx(np.ones(25), abs=1e-5)


def test_reliability_by_hand() -> None:
    predicted = np.array([[0.9, 0.1], [0.9, 0.1], [0.6, 0.4], [0.6, 0.4]])
    low, middle, high, top = reliability(predicted, np.array([0, 1, 0, 1]))
    assert [one.predicted for one in (low, middle)] == pytest.approx([0.1, 0.4])
    assert [one.predictions for one in (low, middle, high, top)] == [2, 2, 2, 2]
    assert (low.observed, middle.observed) == (0.5, 0.5)
    assert (high.low, high.high, high.observed) == (0.5, 0.8, 0.5)
    assert (top.low, top.high, top.observed) == (0.8, 1.0, 0.5)


def test_the_mark_is_kept_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "estimated.mcap"
    data = tabular(episodes=8)
    estimated = mcaprl.estimate_behavior(data, folds=2, updates=20).dataset
    assert (data.has_estimated_probs, estimated.has_estimated_probs) == (False, True)
    estimated.save(path)
    again = mcaprl.open(path)
    assert again.has_estimated_probs
    assert again.behavior_probs.tolist() == estimated.behavior_probs.tolist()
    # A mixture of logged and estimated probabilities counts as estimated.
    assert mcaprl.Dataset.concatenate([data, estimated]).has_estimated_probs
    assert run(["info", str(path)]) == 0
    assert "behavior_prob  │ estimated, implies" in capsys.readouterr().out
    config = FQEConfig(updates=5)
    found = OffPolicyEvaluator(again, config).evaluate(None, "random")
    assert all(one.verdict.endswith(BY_ESTIMATES) for one in found.estimates)
    plain = OffPolicyEvaluator(data, config).evaluate(None, "random")
    assert not any(BY_ESTIMATES in one.verdict for one in plain.estimates)


def test_the_command_estimates_what_a_log_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "unknown.mcap"
    tabular(episodes=30).with_behavior_probs(np.full(750, np.nan)).save(path)
    command = ["evaluate", "random", "--data", str(path), "--updates", "5", "--json"]
    assert run(command) == 0
    refused = json.loads(capsys.readouterr().out)
    assert refused["behavior_estimate"] is None
    verdicts = [one["verdict"] for one in refused["estimates"]]
    assert any("unknown; `estimate_behavior=True` estimates it" in verdict for verdict in verdicts)
    assert run([*command, "--estimate-behavior"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["behavior_estimate"]["folds"]) == 5
    assert all("behavior_prob is estimated" in one["verdict"] for one in found["estimates"])


def test_values_by_estimated_probabilities_are_close_to_those_by_logged_ones() -> None:
    # The uniform policy takes the greedy action in a third of 25 steps; its return is 25 / 3.
    data = tabular()
    estimated = estimate_behavior(data, updates=300).dataset
    values = {}
    for name, each in {"logged": data, "estimated": estimated}.items():
        found = mcaprl.estimate("random", each, gamma=1.0, updates=5)
        values[name] = {one.estimator: one.value for one in found.estimates}
    logged, other = (values[name]["PDIS"] for name in ("logged", "estimated"))
    assert logged is not None
    assert other == pytest.approx(logged, rel=0.5)


def test_wrong_requests_are_refused() -> None:
    with pytest.raises(UsageError, match="needs 5 episodes or more; there are 4"):
        estimate_behavior(tabular(episodes=4))
    with pytest.raises(UsageError, match="folds"):
        estimate_behavior(tabular(episodes=4), folds=1)
    with pytest.raises(SpaceError, match="probs has shape"):
        tabular(episodes=4).with_behavior_probs(np.ones(3))
    continuous = mcaprl.Dataset.from_arrays(
        observations=np.zeros((6, 1), np.float32),
        next_observations=np.zeros((6, 1), np.float32),
        actions=np.zeros((6, 2), np.float32),
        rewards=np.zeros(6),
        terminated=np.ones(6, bool),
        truncated=np.zeros(6, bool),
    )
    with pytest.raises(SpaceError, match="an action that never changes cannot be learned"):
        estimate_behavior(continuous)
