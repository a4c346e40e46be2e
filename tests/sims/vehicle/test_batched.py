"""Tests that batched sims equal single sims and Gymnasium's batches, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims import SIMS, make_sim, make_sims
from mcaprl.sims.evaluation.evaluate import make_pilot
from tests.sims.test_sims import BATCHED, CASES
from tests.support.sims import action_of

Envs = VectorEnv[Any, Any, Any]
COUNT = 3
CASES_BATCHED = [(name, kwargs) for name, kwargs in CASES if name in BATCHED]
every_batch = pytest.mark.parametrize(
    ("name", "kwargs"),
    CASES_BATCHED,
    ids=[f"{name}-{'-'.join(kwargs)}" for name, kwargs in CASES_BATCHED],
)
MODES = [mode.value for mode in AutoresetMode]
seeds = st.integers(0, 2**31)
choices = st.lists(
    st.lists(st.integers(0, 2**16), min_size=COUNT, max_size=COUNT), min_size=1, max_size=15
)


def check_same(ours: Any, theirs: Any, where: str) -> None:
    """Check that types, shapes and bits are equal, also in dicts and in arrays of objects."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), where
        for key in theirs:
            check_same(ours[key], theirs[key], f"{where}[{key}]")
    elif isinstance(theirs, np.ndarray):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), where
        if theirs.dtype == object:
            for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
                check_same(one, other, f"{where}[{i}]")
        else:
            assert ours.tobytes() == theirs.tobytes(), where
    elif isinstance(theirs, tuple):
        for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            check_same(one, other, f"{where}.{i}")
    else:
        assert ours == theirs, where


def actions_of(envs: Envs, chosen: list[int]) -> NDArray[Any]:
    return np.array([action_of(envs.single_action_space, number) for number in chosen])


def one_by_one(name: str, count: int, mode: str, steps: int, kwargs: dict[str, Any]) -> Envs:
    """Return a batch by Gymnasium of this package's single environments."""

    def make() -> gym.Env[Any, Any]:
        return make_sim(name, max_episode_steps=steps, **kwargs)

    makers: list[Callable[[], gym.Env[Any, Any]]] = [make] * count
    return SyncVectorEnv(makers, autoreset_mode=mode)


@every_batch
@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=6)
@given(seeds, choices)
def test_a_batch_does_what_single_sims_do(
    name: str, kwargs: dict[str, Any], mode: str, seed: int, chosen: list[list[int]]
) -> None:
    """Time limits of 6 steps and failures end many episodes; later episodes are compared, too."""
    ours = make_sims(name, COUNT, autoreset_mode=mode, max_episode_steps=6, **kwargs)
    theirs = one_by_one(name, COUNT, mode, 6, kwargs)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    check_same(ours.reset(seed=seed), theirs.reset(seed=seed), "reset")
    for step, numbers in enumerate(chosen):
        actions = actions_of(ours, numbers)
        mine, yours = ours.step(actions), theirs.step(actions)
        check_same(mine, yours, f"step {step}")
        ended = mine[2] | mine[3]
        if mode == "Disabled" and ended.any():
            mask = {"reset_mask": ended}
            check_same(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)), "mask")


@every_batch
def test_an_episode_of_a_batch_is_that_of_its_seed(name: str, kwargs: dict[str, Any]) -> None:
    """Vehicle i equals the single sim of seed + i, no matter what the other vehicles do."""
    batch = make_sims(name, COUNT, **kwargs)
    batch.action_space.seed(0)
    seen, _ = batch.reset(seed=40)
    singles = [make_sim(name, **kwargs) for _ in range(COUNT)]
    going_on = dict(enumerate(singles))
    for i, single in going_on.items():
        check_same(part(seen, i), single.reset(seed=40 + i)[0], f"reset {i}")
    for step in range(30):
        actions = batch.action_space.sample()
        seen, rewards, terminated, truncated, infos = batch.step(actions)
        for i, single in list(going_on.items()):
            theirs = single.step(actions[i])
            check_same(part(seen, i), theirs[0], f"step {step} of {i}")
            assert (rewards[i], terminated[i], truncated[i]) == theirs[1:4]
            reported = {
                key: infos[key][i] for key in infos if key[0] != "_" and infos[f"_{key}"][i]
            }
            assert reported == theirs[4]
            if terminated[i] or truncated[i]:
                del going_on[i]


def part(observations: Any, i: int) -> Any:
    """Return the observation of one vehicle."""
    if isinstance(observations, dict):
        return {key: values[i] for key, values in observations.items()}
    return observations[i]


@pytest.mark.parametrize("name", BATCHED)
def test_gymnasium_makes_batches(name: str) -> None:
    env = gym.make_vec(SIMS[name], num_envs=4, vectorization_mode="vector_entry_point")
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.num_envs == 4
    assert env.spec is not None
    assert env.spec.max_episode_steps == gym.spec(SIMS[name]).max_episode_steps
    assert isinstance(env, type(make_sims(name, 4)))
    assert isinstance(env, type(gym.make_vec(SIMS[name], 4)))
    continuous = gym.make_vec(SIMS[name].replace("-v0", "Continuous-v0"), num_envs=4)
    assert isinstance(continuous, type(env))
    assert (
        continuous.single_action_space
        == make_sims(name, 4, actions="continuous").single_action_space
    )
    again = gym.make_vec(env.spec)
    check_same(again.reset(seed=3), env.reset(seed=3), "made again from its spec")
    env.close()


def test_results_are_copies() -> None:
    env = make_sims("lane", 2)
    given = [*env.reset(seed=0), *env.step(np.array([1, 1]))]
    kept = repr(given)
    env.step(np.array([3, 2]))
    assert repr(given) == kept


def test_a_reset_in_the_step_that_ends_an_episode_clears_the_commands() -> None:
    # The second car leaves the lane; the first drives on.
    options: dict[str, Any] = {
        "observation": "depth-commands",
        "start": "line",
        "autoreset_mode": "SameStep",
    }
    env = make_sims("lane", 2, **options)
    env.reset(seed=0)
    for step in range(1, 33):
        seen, _, terminated, _, infos = env.step(np.array([1, 2]))
        first, second = seen["commands"].reshape(2, 32, 2)
        np.testing.assert_array_equal(first[:step], [[1.0, 0.0]] * step)
        if terminated[1]:
            break
    assert terminated.tolist() == [False, True]
    assert not second.any()
    last = infos["final_obs"][1]["commands"].reshape(32, 2)
    np.testing.assert_array_equal(last, [[1.0, -1.0]] * step + [[0.0, 0.0]] * (32 - step))


def test_one_pose_for_all_or_one_for_each() -> None:
    env = make_sims("lane", 2)
    _, infos = env.reset(options={"pose": (50.0, 1.5, 0.0, 7.0)})
    assert infos["lateral_offset_m"].tolist() == [0.5, 0.5]
    poses = [(50.0, 1.5, 0.0), (60.0, 0.5, 0.1)]
    _, infos = env.reset(options={"pose": poses})
    assert infos["lateral_offset_m"].tolist() == [0.5, -0.5]
    assert infos["heading_error_rad"].tolist() == pytest.approx([0.0, 0.1])


def test_a_mask_resets_only_what_it_names_and_is_left_as_it_was() -> None:
    env: Any = make_sims("racer", 3, autoreset_mode="Disabled")
    env.reset(seed=0)
    env.step(np.array([1, 1, 1]))
    options = {"reset_mask": np.array([False, True, False])}
    _, infos = env.reset(seed=[7, 8, 9], options=options)
    assert set(options) == {"reset_mask"}
    assert infos["_progress_m"].tolist() == [False, True, False]
    single = make_sim("racer")
    single.reset(seed=8)
    check_same(env.step(np.array([2, 2, 2]))[0][1], single.step(2)[0], "the one of seed 8")


@pytest.mark.parametrize("name", ["lane", "racer", "powerline"])
def test_vehicles_that_the_first_mask_omits_start_in_the_first_step(name: str) -> None:
    env: Any = make_sims(name, 3)
    env.reset(seed=4, options={"reset_mask": np.array([True, False, True])})
    seen, *_ = env.step(np.zeros(3, dtype=np.int64))
    assert seen[1].any(), "an observation of zeros"
    seen, _, terminated, *_ = env.step(np.zeros(3, dtype=np.int64))
    assert np.isfinite(seen).all()
    assert not terminated[1]


def test_each_drone_has_gusts_of_its_own() -> None:
    env: Any = make_sims("powerline", 4, gust_m_s=2.0, start="line")
    env.reset(seed=[5, 5, 6, 6])
    for _ in range(5):
        seen, *_ = env.step(np.full(4, 6))
    assert seen[0].tolist() == seen[1].tolist()
    assert seen[1].tolist() != seen[2].tolist()


def test_the_racers_time_limit_precedes_the_registered_one() -> None:
    """The racer's time limit is 1,000 steps; the limit registered with Gymnasium is 10,000 steps.

    Car 0 repeats the actions of the pilot, which drives in a single sim.
    """
    single = make_sim("racer", start="line")
    pilot = make_pilot(single)
    observation, _ = single.reset(seed=3)
    batch = make_sims("racer", 2, start="line")
    batch.reset(seed=3)
    for step in range(1, 1_001):
        action = int(pilot.act(observation[np.newaxis])[0])
        observation, *_ = single.step(action)
        _, _, terminated, truncated, infos = batch.step(np.array([action, 0]))
        assert (terminated[0], truncated[0]) == (False, step == 1_000)
    assert infos["reason"][0] == "time_limit"


def test_other_environments_are_batched_by_gymnasium() -> None:
    env = make_sims("CartPole-v1", 2, autoreset_mode="SameStep")
    assert isinstance(env.unwrapped, SyncVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    for _ in range(100):
        *_, infos = env.step(np.array([0, 0]))
        if "final_obs" in infos:
            return
    pytest.fail("no pole fell")


@pytest.mark.parametrize(
    ("name", "kwargs", "words"),
    [
        ("lane", {"num_envs": 0}, "num_envs must be an integer of at least 1, not 0"),
        ("lane", {"num_envs": 2.5}, "num_envs must be an integer of at least 1, not 2.5"),
        ("lane", {"max_episode_steps": 0}, "max_episode_steps must be an integer of at least 1"),
        ("lane", {"autoreset_mode": "never"}, "unknown autoreset_mode 'never': .*SameStep"),
        ("CartPole-v1", {"autoreset_mode": "never"}, "unknown autoreset_mode 'never': .*SameStep"),
        ("lane", {"rules": "mine"}, "unknown rules 'mine': known: classic, classic-code, default"),
        ("lane", {"observation": "smell"}, "known: dashboard, depth, depth-commands, rays, state"),
        ("lane", {"color": "red"}, "sim 'lane' has no argument color"),
        ("racer", {"render_mode": "human"}, "batched sims do not render"),
        ("powerline", {"wind_m_s": 99.0}, "wind_m_s must be 0 to 8, not 99.0"),
        ("boat", {}, "unknown sim 'boat'"),
    ],
)
def test_a_bad_request_is_refused(name: str, kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_sims(name, **{"num_envs": 2, **kwargs})


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ([1, 2, 3], "an array of 2 integers, not int64 of shape \\(3,\\)"),
        ([1.0, 2.0], "an array of 2 integers, not float64 of shape \\(2,\\)"),
        (1, "an array of 2 integers"),
        ([0, 6], "action 6 does not exist: actions are 0 to 5"),
        ([-1, 0], "action -1 does not exist: actions are 0 to 5"),
    ],
)
def test_bad_discrete_actions_are_refused_and_change_nothing(actions: Any, words: str) -> None:
    env, other = make_sims("lane", 2), make_sims("lane", 2)
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(UsageError, match=words):
        env.step(actions if isinstance(actions, int) else np.array(actions))
    check_same(env.step(np.array([1, 2])), other.step(np.array([1, 2])), "after the refusal")


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        ([[0, 0, 0]] * 2, r"2 x 2 numbers .pedal, steering., not int64 of shape \(2, 3\)"),
        ([0.0, 0.0], r"2 x 2 numbers .pedal, steering., not float64 of shape \(2,\)"),
        ([["1", "0"]] * 2, "2 x 2 numbers .pedal, steering., not <U1"),
        ([[0, 0], [0.5, np.nan]], "action of environment 1: steering is NaN; it must be -1 to 1"),
        ([[0, 0], [-1.25, 0]], "action of environment 1: pedal is -1.25; it must be -1 to 1"),
        ([[0, 1.00001], [2, 2]], "action of environment 0: steering is 1.00001"),
    ],
)
def test_bad_continuous_actions_are_refused_and_change_nothing(actions: Any, words: str) -> None:
    env, other = (make_sims("lane", 2, actions="continuous") for _ in range(2))
    env.reset(seed=0)
    other.reset(seed=0)
    with pytest.raises(UsageError, match=words):
        env.step(np.array(actions))
    fine = np.array([[1, 0.25], [-0.5, 0]])
    check_same(env.step(fine), other.step(fine), "after the refusal")


@pytest.mark.parametrize("name", BATCHED)
def test_continuous_actions_are_float32_and_parts_just_beyond_1_count_as_1(name: str) -> None:
    """Double precision is rounded as in a log."""
    results = []
    for offset in (0.0, 1e-7, 5e-7):
        single = make_sim(name, actions="continuous")
        batch = make_sims(name, 2, actions="continuous")
        action = np.array([1.0 + offset, -0.7, -0.7])[: spaces.flatdim(single.action_space)]
        single.reset(seed=3)
        batch.reset(seed=3)
        for exact in (action, action.astype(np.float32)):
            one, many = single.step(exact), batch.step(np.stack([exact] * 2))
            check_same(many[0][0], one[0], "single and batch")
            results.append(one[0].tobytes())
    assert results[:2] == results[2:4] == results[4:]


# The increments of the drone, not its velocities, have the discrete actions as points.
SAME = {"lane": "continuous", "racer": "continuous", "powerline": "increments"}


@pytest.mark.parametrize(
    ("name", "observation"),
    [*((name, None) for name in BATCHED), ("lane", "rays"), ("lane", "depth-commands")],
)
def test_discrete_actions_are_points_of_the_continuous_ones(
    name: str, observation: str | None
) -> None:
    """Only the brake of the lane's car, which keeps the last steering, has no constant point."""
    kwargs: dict[str, Any] = {} if observation is None else {"observation": observation}
    kinds = ("discrete", SAME[name])
    batches: Any = [make_sims(name, 40, actions=kind, **kwargs) for kind in kinds]
    singles: Any = [make_sim(name, actions=kind, **kwargs) for kind in kinds]
    commands = batches[0].unwrapped.fleet.controls.commands
    for env in (*batches, *singles):
        env.reset(seed=11)
    random, last, has_ended = np.random.default_rng(1), np.zeros(40), False
    for step in range(60):
        actions = random.integers(len(commands), size=40)
        points = commands[actions]
        if name == "lane":
            # An episode starts with steering 0.
            last[batches[0].unwrapped._started == step] = 0.0
            points[:, 1] = last = np.where(actions == 0, last, points[:, 1])
        results = [batches[0].step(actions), batches[1].step(points.astype(np.float32))]
        check_same(results[1], results[0], f"step {step}")
        if not has_ended:
            alone = singles[0].step(actions[0])
            check_same(singles[1].step(points[0].astype(np.float32)), alone, f"step {step}")
            has_ended = alone[2] or alone[3]


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"seed": [1, 2, 3]}, "3 seeds for 2 environments"),
        ({"options": {"reset_mask": np.array([True])}}, "reset_mask must be an array of 2 bools"),
        ({"options": {"reset_mask": np.zeros(2, bool)}}, "at least one of them true"),
        ({"options": {"reset_mask": np.ones(2)}}, "reset_mask must be an array of 2 bools"),
        ({"options": {"pose": [(50.0, 1.0, 0.0)] * 3}}, "3 poses for 2 environments"),
        ({"options": {"pose": (50.0, 9.0, 0.0)}}, "8.0 m from the path"),
        ({"options": {"place": 3}}, "only the option 'pose'"),
    ],
)
def test_a_bad_reset_is_refused(request_: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make_sims("lane", 2).reset(**request_)


def test_a_step_needs_a_reset() -> None:
    with pytest.raises(gym.error.ResetNeeded):
        make_sims("lane", 2).step(np.array([1, 1]))
    env = make_sims("lane", 2, autoreset_mode="Disabled", max_episode_steps=1)
    env.reset(seed=0)
    env.step(np.array([1, 1]))
    with pytest.raises(UsageError, match=r"episodes \[0, 1\] have ended and autoreset is disabled"):
        env.step(np.array([1, 1]))


def test_the_cases_cover_all_that_can_be_batched() -> None:
    assert set(BATCHED) == {"lane", "powerline", "racer"}
    assert {kwargs.get("observation") for name, kwargs in CASES if name == "lane"} == {
        None,
        "dashboard",
        "depth",
        "depth-commands",
        "rays",
    }
