"""What every sim of ours keeps to, whatever it simulates."""

from __future__ import annotations

import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.pilots import PILOTS

VARIANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("lane", {}),
    ("lane", {"observation": "depth"}),
    ("powerline", {}),
    ("powerline", {"observation": "depth", "camera": "front"}),
    ("powerline", {"plant": "point"}),
    ("powerline", {"wind_m_s": 4.0, "gust_m_s": 1.0}),
    ("powerline", {"rules": "classic"}),
    ("powerline", {"rules": "classic", "observation": "depth"}),
)
FAST = tuple((name, kwargs) for name, kwargs in VARIANTS if kwargs.get("observation") != "depth")
NAMES = ("reset", "step", "telemetry", "scene", "static_scene", "frames", "static_frames")

Trace = list[tuple[bytes, float, bool, bool, dict[str, Any]]]


def bare(name: str, kwargs: dict[str, Any]) -> Any:
    """The sim itself, without wrappers."""
    return make_sim(name, **kwargs).unwrapped


def as_bytes(observation: Any) -> bytes:
    if isinstance(observation, dict):
        return b"".join(observation[key].tobytes() for key in sorted(observation))
    return bytes(observation.tobytes())


def trace(env: gym.Env[Any, Any], seed: int, actions: list[int]) -> Trace:
    """All that an episode gives, observations as bytes."""
    observation, info = env.reset(seed=seed)
    steps: Trace = [(as_bytes(observation), 0.0, False, False, info)]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        steps.append((as_bytes(observation), float(reward), terminated, truncated, info))
        if terminated:
            break
    return steps


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_gymnasium_and_sb3_find_no_fault(name: str, kwargs: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(bare(name, kwargs))
        check_env_of_sb3(bare(name, kwargs))


@pytest.mark.parametrize(("name", "kwargs"), FAST)
@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 5), max_size=30))
def test_seed_and_actions_decide_every_bit(
    name: str, kwargs: dict[str, Any], seed: int, actions: list[int]
) -> None:
    assert trace(bare(name, kwargs), seed, actions) == trace(bare(name, kwargs), seed, actions)


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_pictures_repeat_too(name: str, kwargs: dict[str, Any]) -> None:
    actions = [1, 2, 0, 3, 5]
    first, second = (trace(bare(name, kwargs), 3, actions) for _ in range(2))
    assert first == second


@pytest.mark.parametrize(("name", "kwargs"), FAST)
def test_seeds_differ_and_episodes_of_one_seed_too(name: str, kwargs: dict[str, Any]) -> None:
    sim = bare(name, kwargs)
    starts = [sim.reset(seed=0)[0], sim.reset(seed=1)[0], sim.reset()[0]]
    assert len({as_bytes(start) for start in starts}) == 3


@pytest.mark.parametrize(("name", "kwargs"), FAST)
@settings(max_examples=15)
@given(st.integers(0, 1000), st.lists(st.integers(0, 5), min_size=1, max_size=60))
def test_observations_are_in_the_space_to_the_very_end(
    name: str, kwargs: dict[str, Any], seed: int, actions: list[int]
) -> None:
    sim = bare(name, kwargs)
    observation, _ = sim.reset(seed=seed)
    assert sim.observation_space.contains(observation)
    for action in actions:
        observation, _, terminated, _, _ = sim.step(action)
        assert sim.observation_space.contains(observation)
        if terminated:
            break


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_an_observation_is_the_callers_own(name: str, kwargs: dict[str, Any]) -> None:
    sim = bare(name, kwargs)
    first, _ = sim.reset(seed=0)
    kept = as_bytes(first)
    sim.step(1)
    assert as_bytes(first) == kept


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_an_action_that_does_not_exist_is_refused(name: str, kwargs: dict[str, Any]) -> None:
    sim = bare(name, kwargs)
    sim.reset(seed=0)
    count = int(sim.action_space.n)
    for action in (-1, count):
        with pytest.raises(UsageError, match=f"0 to {count - 1} do"):
            sim.step(action)


@pytest.mark.parametrize("name", SIMS)
def test_unknown_arguments_are_refused(name: str) -> None:
    for argument in ("rules", "observation", "start"):
        with pytest.raises(UnknownNameError, match="odd"):
            bare(name, {argument: "odd"})


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_the_time_limit_truncates_without_a_reason_of_its_own(
    name: str, kwargs: dict[str, Any]
) -> None:
    env = make_sim(name, max_episode_steps=2, **kwargs)
    env.reset(seed=0)
    env.step(1)
    _, _, terminated, truncated, info = env.step(1)
    assert (terminated, truncated) == (False, True)
    assert "reason" not in info


@pytest.mark.parametrize("name", SIMS)
def test_each_sim_has_a_time_limit_and_a_pilot(name: str) -> None:
    spec = make_sim(name).spec
    assert spec is not None
    assert spec.max_episode_steps is not None
    assert spec.id in PILOTS


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_names_fit_what_they_name(name: str, kwargs: dict[str, Any]) -> None:
    sim = bare(name, kwargs)
    assert len(sim.action_meanings) == sim.action_space.n
    if isinstance(sim.observation_space, spaces.Box) and "observation" not in kwargs:
        assert (len(sim.observation_names),) == sim.observation_space.shape
    else:
        assert sim.observation_names == ()
    assert sim.step_duration_s > 0.0
    for method in NAMES:
        assert callable(getattr(sim, method))


@pytest.mark.parametrize(("name", "kwargs"), FAST)
def test_telemetry_keeps_its_names_and_is_finite(name: str, kwargs: dict[str, Any]) -> None:
    sim = bare(name, kwargs)
    sim.reset(seed=0)
    before = sim.telemetry()
    sim.step(1)
    after = sim.telemetry()
    assert before.keys() == after.keys()
    assert all(np.isfinite(value) for value in after.values())
    assert {"x_m", "y_m", "speed_m_s", "lateral_offset_m", "progress_m"} <= after.keys()


def test_importing_the_sims_loads_no_engine() -> None:
    code = (
        "import sys, mcaprl.sims, mcaprl.sims.pilots, mcaprl.sims.scene\n"
        "heavy = {'numba', 'torch', 'pygame', 'matplotlib', 'stable_baselines3'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
