"""Tests of the requirements on all sims."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import SIMS, make_sim
from tests.support.sim_shapes import check_shape

Trace = list[tuple[bytes, float, bool, bool, dict[str, Any]]]

CASES: list[tuple[str, dict[str, Any]]] = [
    ("lane", {}),
    ("lane", {"observation": "depth"}),
    ("lane", {"observation": "dashboard"}),
    ("lane", {"observation": "depth-commands"}),
    ("lane", {"observation": "rays"}),
    ("lane", {"rules": "classic", "start": "anywhere"}),
    ("lane", {"rules": "classic-code", "observation": "depth"}),
    ("racer", {}),
    ("racer", {"rules": "classic", "start": "anywhere"}),
    ("racer", {"actions": 5, "drift": True, "track_seed": 3}),
    ("powerline", {}),
    ("powerline", {"observation": "depth", "camera": "front"}),
    ("powerline", {"plant": "point", "wind_m_s": 4.0, "gust_m_s": 1.0}),
    ("powerline", {"rules": "classic"}),
    ("highway-lane", {}),
    ("highway-lane", {"road": "racetrack-v0"}),
]
ON_THE_GROUND = ("lane", "racer", "highway-lane")
BATCHED = [name for name, env_id in SIMS.items() if gym.spec(env_id).vector_entry_point]
LONGEST = 3_000
every_sim = pytest.mark.parametrize(
    ("name", "kwargs"), CASES, ids=[f"{name}-{'-'.join(kwargs)}" for name, kwargs in CASES]
)
seeds = st.integers(0, 2**32 - 1)
choices = st.lists(st.integers(0, 2**16), min_size=1, max_size=30)


def unwrapped(name: str, kwargs: dict[str, Any]) -> Any:
    """Return the sim without wrappers."""
    return make_sim(name, **kwargs).unwrapped


def as_bytes(observation: Any) -> bytes:
    if isinstance(observation, dict):
        return b"".join(observation[key].tobytes() for key in sorted(observation))
    return bytes(observation.tobytes())


def actions_of(env: gym.Env[Any, Any], chosen: list[int]) -> list[int]:
    assert isinstance(env.action_space, spaces.Discrete)
    return [number % int(env.action_space.n) for number in chosen]


def trace(env: gym.Env[Any, Any], seed: int, actions: list[int]) -> Trace:
    """Return all results of an episode, with observations as bytes."""
    observation, info = env.reset(seed=seed)
    steps: Trace = [(as_bytes(observation), 0.0, False, False, info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        steps.append((as_bytes(observation), float(reward), terminated, truncated, info))
        if terminated or truncated:
            break
    return steps


@every_sim
def test_the_checkers_of_gymnasium_and_sb3_pass(name: str, kwargs: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(unwrapped(name, kwargs))
        check_env_of_sb3(unwrapped(name, kwargs))


@every_sim
@settings(max_examples=15)
@given(seeds, choices)
def test_seed_and_actions_determine_every_bit(
    name: str, kwargs: dict[str, Any], seed: int, chosen: list[int]
) -> None:
    first, second = unwrapped(name, kwargs), unwrapped(name, kwargs)
    actions = actions_of(first, chosen)
    assert trace(first, seed, actions) == trace(second, seed, actions)
    assert trace(first, seed, actions) == trace(second, seed, actions), "an episode later"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("name", BATCHED)
def test_a_copy_continues_independently(name: str, copied: Callable[[Any], Any]) -> None:
    first = unwrapped(name, {})
    first.reset(seed=1)
    for action in (1, 2, 1):
        first.step(action)
    second = copied(first)
    ahead = [second.step(action) for action in (1, 1, 1)]
    after = [first.step(action) for action in (1, 1, 1)]
    for one, other in zip(ahead, after, strict=True):
        assert as_bytes(one[0]) == as_bytes(other[0])
        assert one[1:] == other[1:]


@every_sim
def test_seeds_differ_and_episodes_of_one_seed_too(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    starts = [sim.reset(seed=0)[0], sim.reset(seed=1)[0], sim.reset()[0]]
    assert len({as_bytes(start) for start in starts}) == 3


@every_sim
@settings(max_examples=15)
@given(seeds, choices)
def test_observations_are_in_the_space_to_the_very_end(
    name: str, kwargs: dict[str, Any], seed: int, chosen: list[int]
) -> None:
    sim = unwrapped(name, kwargs)
    observation, _ = sim.reset(seed=seed)
    assert sim.observation_space.contains(observation)
    for action in actions_of(sim, chosen):
        observation, _, terminated, truncated, _ = sim.step(action)
        assert sim.observation_space.contains(observation)
        if terminated or truncated:
            break


@every_sim
def test_an_observation_is_a_copy(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    first, _ = sim.reset(seed=0)
    kept = as_bytes(first)
    sim.step(1)
    assert as_bytes(first) == kept


@every_sim
def test_every_end_has_one_cause_and_a_reason(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    sim.action_space.seed(0)
    for seed in range(10):
        sim.reset(seed=seed)
        terminated = truncated = False
        for _ in range(LONGEST):
            _, _, terminated, truncated, info = sim.step(int(sim.action_space.sample()))
            assert ("reason" in info) == (terminated or truncated)
            if terminated or truncated:
                break
        assert terminated != truncated


@every_sim
def test_every_shape_can_be_drawn(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    sim.reset(seed=0)
    names = [shape.name for shape in sim.scene()]
    sim.step(1)
    shapes = [*sim.static_scene(), *sim.scene()]
    frames = {"map", *(frame.name for frame in [*sim.static_frames(), *sim.frames()])}
    for shape in shapes:
        check_shape(shape, frames)
    assert len({shape.name for shape in shapes}) == len(shapes)
    assert [shape.name for shape in sim.scene()] == names


@every_sim
def test_names_and_metadata_fit_the_sim(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    sim.reset(seed=0)
    assert len(sim.action_meanings) == sim.action_space.n
    if sim.observation_names:
        assert (len(sim.observation_names),) == sim.observation_space.shape
    if name == "racer" or kwargs.get("rules", "default") == "default":
        # `metadata` is an attribute of the class, so its frame rate is that of the default rules.
        # The decisions of the classic car and drone are longer.
        assert sim.step_duration_s * sim.metadata["render_fps"] == pytest.approx(1.0)
    assert {"x_m", "y_m", "speed_m_s"} <= set(sim.telemetry())
    before = sim.telemetry()
    sim.step(1)
    assert before.keys() == sim.telemetry().keys()
    assert all(type(value) is float and math.isfinite(value) for value in before.values())


@every_sim
def test_the_time_limit_truncates_without_a_reason(name: str, kwargs: dict[str, Any]) -> None:
    env = make_sim(name, max_episode_steps=2, **kwargs)
    env.reset(seed=1)
    env.step(0)
    _, _, terminated, truncated, info = env.step(0)
    assert (terminated, truncated) == (False, True)
    assert "reason" not in info


@pytest.mark.parametrize("name", SIMS)
def test_each_sim_has_a_time_limit_and_a_pilot(name: str) -> None:
    spec = make_sim(name).spec
    assert spec is not None
    assert spec.max_episode_steps is not None
    description = SIMS.find(spec.id)
    assert description is not None
    assert description.pilot is not None


@every_sim
def test_an_invalid_action_is_refused(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, kwargs)
    sim.reset(seed=0)
    last = int(sim.action_space.n) - 1
    for action in (-1, last + 1):
        with pytest.raises(UsageError, match=f"actions are 0 to {last}"):
            sim.step(action)
    if name in BATCHED:
        with pytest.raises(UsageError, match="is not an integer"):
            sim.step(1.5)


@pytest.mark.parametrize("name", SIMS)
@pytest.mark.parametrize("argument", ["rules", "observation", "start"])
def test_an_unknown_value_is_refused_with_the_known_ones(name: str, argument: str) -> None:
    with pytest.raises(UnknownNameError, match=f"unknown {argument} 'nonsense': .*known: "):
        unwrapped(name, {argument: "nonsense"})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pose": (1.0, 2.0)}, "is not \\(x_m, y_m, yaw_rad\\)"),
        ({"pose": "home"}, "is not \\(x_m, y_m, yaw_rad\\)"),
        ({"pose": (1.0, float("nan"), 0.0)}, "is not \\(x_m, y_m, yaw_rad\\)"),
        ({"pose": (50.0, 1.0, 0.0, -99.0)}, "speed_m_s must be -?[0-9]+ to [0-9]+, not -99.0"),
        ({"place": (50.0, 1.0, 0.0)}, "only the option 'pose', not \\['place'\\]"),
    ],
)
@pytest.mark.parametrize("name", ON_THE_GROUND)
def test_a_bad_pose_is_refused(name: str, options: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        unwrapped(name, {}).reset(options=options)


def test_importing_the_sims_loads_no_engine() -> None:
    code = (
        "import sys, mcaprl.sims, mcaprl.sims.evaluation.pilots, mcaprl.sims.drawing.scene\n"
        "heavy = {'numba', 'torch', 'pygame', 'matplotlib', 'stable_baselines3'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
