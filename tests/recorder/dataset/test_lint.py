"""Each problem of a dataset is reported with its position, and nothing else is reported."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.record.wrapper import RecordMcap


def dataset(**changes: Any) -> Dataset:
    """Create two valid episodes of three steps, with the given changes."""
    rising = np.arange(14, dtype=np.float32).reshape(7, 2) / 14
    columns: dict[str, Any] = {
        "observations": rising[[0, 1, 2, 3, 4, 5]],
        "next_observations": rising[[1, 2, 3, 4, 5, 6]],
        "actions": np.array([0, 1, 2, 2, 1, 0]),
        "rewards": np.array([1.0, 3.0, 3.0, 1.0, 2.0, 3.0]),
        "terminated": np.array([False, False, True, False, False, False]),
        "truncated": np.array([False, False, False, False, False, True]),
        "behavior_probs": np.full(6, 0.5),
        "observation_space": spaces.Box(0, 1, (2,), np.float32),
        "action_space": spaces.Discrete(3),
    }
    columns |= changes
    # `from_arrays` refuses impossible probabilities, which logs of other writers may have.
    probs = columns.pop("behavior_probs")
    return Dataset.from_arrays(**columns).with_behavior_probs(probs)


def changed(column: str, at: Any, value: float) -> dict[str, Any]:
    """Return a column of `dataset` with one changed value."""
    array = np.array(getattr(dataset(), column))
    array[at] = value
    return {column: array}


def test_a_valid_dataset_has_no_findings() -> None:
    assert lint(dataset()) == []


def test_the_reward_of_a_terminal_step_may_be_special() -> None:
    """An episode with both end flags has reached a terminal state."""
    both = dataset(**changed("terminated", 5, True), rewards=np.array([1.0, 3, 3, 1, 2, -10]))
    assert not [one for one in lint(both) if "truncated episode" in str(one)]


@pytest.mark.parametrize(
    ("changes", "severity", "text"),
    [
        (
            changed("observations", (1, 0), math.nan)
            | changed("next_observations", (0, 0), math.nan),
            "problem",
            "1 values of observation are NaN or infinite (episode 0 step 1)",
        ),
        (
            changed("next_observations", (5, 1), math.inf),
            "problem",
            "1 values of observation are NaN or infinite (episode 1 step 3)",
        ),
        (
            changed("rewards", 4, -math.inf),
            "problem",
            "1 rewards are NaN or infinite (episode 1 step 1)",
        ),
        (
            {"rewards": np.array([1.0, 3.0, 3.0, 1.0, -1e300, 1e39])},
            "problem",
            "2 rewards beyond float32, such as -1e+300 (episode 1 step 1, episode 1 step 2)",
        ),
        (
            changed("next_observations", (5, 1), 1.5),
            "problem",
            "values of 1 element of observation are outside its space (observation[1] has values"
            " from 0.07143 to 1.5, but bounds 0 to 1)",
        ),
        ({"rewards": np.zeros(6)}, "problem", "every reward is 0 (all steps)"),
        (
            {"rewards": np.array([0, 0, 1.0, 0, 0, 0])},
            "note",
            "only the last steps of episodes have a reward (1 of 2 episodes)",
        ),
        (
            changed("rewards", 5, -10.0),
            "problem",
            "1 truncated episode end with a reward that no other step has (-10; other steps have"
            " 1 to 3)",
        ),
        (
            {"actions": np.array([0, 1, 0, 0, 1, 0])},
            "note",
            "1 action of 3 were never taken (2)",
        ),
        (
            changed("behavior_probs", 3, math.nan),
            "note",
            "behavior_prob is unknown in 1 of 6 steps (episode 1 step 0)",
        ),
        *(
            (
                changed("behavior_probs", 4, prob),
                "problem",
                "behavior_prob is not a number in (0, 1] in 1 of 6 steps (episode 1 step 1)",
            )
            for prob in (-0.5, 0.0, 2.0, math.inf)
        ),
        (
            {name: np.array(getattr(dataset(), name)) * [0, 1] for name in ("observations",)}
            | {"next_observations": np.array(dataset().next_observations) * [0, 1]},
            "note",
            "1 element of observation never change (observation[0])",
        ),
    ],
)
def test_findings(changes: dict[str, Any], severity: str, text: str) -> None:
    found = [finding for finding in lint(dataset(**changes)) if text in str(finding)]
    assert [finding.severity for finding in found] == [severity], lint(dataset(**changes))
    assert found[0].effect


def test_actions_that_the_mask_forbids_are_found() -> None:
    mask = np.array([[0, 1], [0, 1], [1, 0], [0, 0]], np.int8)
    found = lint(
        Dataset.from_arrays(
            observations={"action_mask": mask[:3], "x": np.arange(3.0)},
            next_observations={"action_mask": mask[1:], "x": np.arange(1, 4.0)},
            actions=[3, 2, 3],
            rewards=[1, 2, 3],
            terminated=[False, False, True],
            truncated=[False] * 3,
            action_space=spaces.Discrete(2, start=2),
        )
    )
    (problem,) = [one for one in found if "forbids" in one.what]
    assert problem.what == "2 actions that the log's own action_mask forbids"
    assert problem.where == "episode 0 step 1, episode 0 step 2"
    assert problem.severity == "problem"


def test_joint_actions_that_the_mask_forbids_are_found() -> None:
    # The actions have the numbers 0, 4 and 5, of 2 x 3; each mask forbids number 4.
    mask = np.array([[1, 1, 1, 1, 0, 1]] * 4, np.int8)
    found = lint(
        Dataset.from_arrays(
            observations={"action_mask": mask[:3], "x": np.arange(3.0)},
            next_observations={"action_mask": mask[1:], "x": np.arange(1, 4.0)},
            actions=[[0, 0], [1, 1], [1, 2]],
            rewards=[1, 2, 3],
            terminated=[False, False, True],
            truncated=[False] * 3,
            action_space=spaces.MultiDiscrete([2, 3]),
        )
    )
    (problem,) = [one for one in found if "forbids" in one.what]
    assert problem.what == "1 action that the log's own action_mask forbids"
    assert problem.where == "episode 0 step 1"


@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        (spaces.Discrete(3, start=1), [4]),
        (spaces.MultiDiscrete([3, 2]), [0, 2]),
        (spaces.MultiBinary(2), [2, 0]),
    ],
    ids=str,
)
def test_discrete_observations_outside_their_space_are_named(space: Any, wrong: list[int]) -> None:
    space.seed(0)
    samples = np.array([space.sample() for _ in range(7)])
    samples[2] = wrong if samples.ndim == 2 else wrong[0]
    seen: dict[str, Any] = {"observations": samples[:6], "next_observations": samples[1:]}
    found = lint(dataset(**seen, observation_space=space))
    assert [str(one) for one in found if "outside its space" in one.what], found
    samples[2] = samples[1]
    found = lint(dataset(**seen, observation_space=space))
    assert not [one for one in found if "outside its space" in one.what]


def test_repeated_episodes_are_named() -> None:
    twice = Dataset.concatenate([dataset(), dataset()])
    [finding] = lint(twice)
    assert str(finding).startswith(
        "2 episodes are duplicates of others (episodes 0, 2; episodes 1, 3)"
    )


def test_problems_are_listed_before_notes() -> None:
    findings = lint(dataset(**changed("rewards", 5, -10.0), actions=np.zeros(6, dtype=np.int64)))
    severities = [finding.severity for finding in findings]
    assert severities == sorted(severities, reverse=True)
    assert set(severities) == {"problem", "note"}


def test_gaps_in_time_are_measured_in_usual_steps() -> None:
    gappy = dataset()
    # Make a gap of 0.5 s between two steps. All other steps take 0.1 s, the default of
    # `from_arrays`.
    gappy.episodes[1].log_time_ns[2:] += 400_000_000
    [finding] = lint(gappy)
    assert str(finding).startswith(
        "1 gap in time; the median step is 0.1 s (the longest is 0.5 s, episode 1 step 1)"
    )


def test_several_policies_are_reported(tmp_path: Path) -> None:
    recorder = RecordMcap(gym.make("CartPole-v1"), tmp_path / "mixed.mcap")
    for policy in ("one", "one", "other", "third", "fourth"):
        recorder.policy = policy
        recorder.reset(seed=0)
        ended = False
        while not ended:
            recorder.behavior_prob = 1.0
            ended = recorder.step(int(policy == "one"))[2]
    recorder.close()
    found = [str(finding) for finding in lint(mcaprl.open(tmp_path / "mixed.mcap"))]
    expected = "4 behavior policies (2 by one; 1 by other; 1 by third; and 1 more)"
    assert any(expected in text for text in found)
