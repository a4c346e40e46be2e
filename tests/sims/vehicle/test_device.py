"""Tests of the sims whose vehicles stay on one device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import SIMS, DeviceSims, make_device_sims
from mcaprl.sims.lane.block import step_cars as step_lane_cars
from mcaprl.sims.lane.rules import ACTION_COMMANDS as LANE_COMMANDS
from mcaprl.sims.lane.rules import Car as LaneCar
from mcaprl.sims.racer.block import step_cars as step_racer_cars
from mcaprl.sims.racer.course import Car as RacerCar
from mcaprl.sims.racer.course import make_track
from mcaprl.sims.racer.rules import ACTION_COMMANDS as RACER_COMMANDS
from mcaprl.sims.vehicle.device import draw

CARS = 64
COMMANDS = {"lane": LANE_COMMANDS, "racer": RACER_COMMANDS}
OBSERVED_ERROR = 1
"""Index of the heading error among the lane sim's observed numbers; the racer observes none."""
WAYS: list[tuple[str, dict[str, Any]]] = [
    ("lane", {}),
    ("lane", {"start": "line"}),
    ("racer", {}),
    ("racer", {"start": "line", "drift": True, "track_seed": 3}),
]


def sims_of(name: str, device: str = "cpu", count: int = CARS, **options: Any) -> DeviceSims:
    """Return started sims."""
    sims = make_device_sims(name, count, device=device, seed=5, **options)
    sims.reset()
    return sims


def actions_of(sims: DeviceSims, seed: int) -> Any:
    """Return random actions of all vehicles."""
    random = np.random.default_rng(seed)
    return random.integers(sims.single_action_space.n, size=sims.num_envs)


def test_draws_are_those_of_splitmix64() -> None:
    # A reference implementation in C printed the first two numbers for the state 0. Here, the
    # state is a hash of seed, vehicle and episode, and the hash of 0 is 0.
    shares = np.empty(2)
    draw(np.uint64(0), 0, 0, shares)
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4]
    np.testing.assert_array_equal(shares, [(number >> 11) * 2.0**-53 for number in expected])


def test_draws_are_uniform_and_differ_between_seeds_vehicles_and_episodes() -> None:
    rows = [(seed, i, episode) for seed in range(10) for i in range(20) for episode in range(10)]
    numbers = np.empty((len(rows), 4))
    for row, (seed, i, episode) in zip(numbers, rows, strict=True):
        draw(np.uint64(seed), i, episode, row)
    assert len(np.unique(numbers)) == numbers.size
    assert numbers.min() >= 0
    assert numbers.max() < 1
    # The standard deviation of a uniform number is 0.289, and that of a mean of 8,000 is 0.0032.
    assert abs(numbers.mean() - 0.5) < 0.013
    assert abs(np.corrcoef(numbers[:-1, 0], numbers[1:, 0])[0, 1]) < 0.09


@pytest.mark.parametrize(("name", "options"), WAYS)
def test_a_step_is_that_of_the_batched_sim(name: str, options: dict[str, Any]) -> None:
    sims = sims_of(name, **options)
    batch = sims.batch
    for step in range(60):
        cars = np.ascontiguousarray(batch.states)
        rewards, ends = np.zeros(CARS), np.zeros(CARS, np.int64)
        observations = np.zeros_like(batch.observations)
        batch.actions[:] = actions_of(sims, step)
        commands = np.array(COMMANDS[name])[batch.actions]
        arrays = (cars, commands, rewards, ends, observations)
        if name == "lane":
            step_lane_cars(*arrays)
        else:
            track = make_track(options.get("track_seed"))
            step_racer_cars(track, *arrays, False, options.get("drift", False))
        sims.step()
        np.testing.assert_array_equal(batch.final_observations, observations)
        np.testing.assert_array_equal(batch.rewards, rewards.astype(np.float32))
        ended = batch.terminated | batch.truncated
        np.testing.assert_array_equal(ended, ends != 0)
        np.testing.assert_array_equal(batch.states[~ended], cars[~ended])
        np.testing.assert_array_equal(batch.observations[~ended], observations[~ended])
        np.testing.assert_array_equal(batch.steps == 0, ended)
    assert batch.episodes.sum() > CARS


def test_an_episode_is_truncated_and_the_next_begins_in_the_same_step() -> None:
    sims = sims_of("racer", max_episode_steps=2, start="line")
    batch = sims.batch
    first = batch.observations.copy()
    for step in (1, 2):
        sims.step()
        np.testing.assert_array_equal(batch.truncated, step == 2)
        assert not batch.terminated.any()
    # Action 0 leaves the cars where they start, and each episode has another start.
    np.testing.assert_array_equal(batch.final_observations, first)
    assert (batch.observations != first).any(1).all()
    assert (batch.episodes == 2).all()
    assert (batch.steps == 0).all()


def test_the_same_seed_starts_the_same_episodes() -> None:
    sims, again = sims_of("lane"), sims_of("lane")
    first = sims.batch.observations.copy()
    np.testing.assert_array_equal(again.batch.observations, first)
    for step in range(50):
        for one in (sims, again):
            one.batch.actions[:] = actions_of(sims, step)
            one.step()
        np.testing.assert_array_equal(again.batch.observations, sims.batch.observations)
    again.reset()
    np.testing.assert_array_equal(again.batch.observations, first)
    other = make_device_sims("lane", CARS, device="cpu", seed=6)
    other.reset()
    assert (other.batch.observations != first).any(1).all()


def test_the_spaces_are_those_of_the_single_environment() -> None:
    sims = sims_of("lane")
    assert sims.max_episode_steps == 400
    assert sims.single_action_space.n == 6
    assert sims.batch.observations.shape == (CARS, 12)
    for observation in sims.batch.observations:
        assert sims.single_observation_space.contains(observation)


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="sim 'powerline' cannot stay on a device; lane and racer"):
        make_device_sims("powerline", 4, device="cpu")
    with pytest.raises(UnknownNameError, match="device"):
        make_device_sims("lane", 4, device="tpu")
    with pytest.raises(UnknownNameError, match="start"):
        make_device_sims("lane", 4, device="cpu", start="nowhere")
    with pytest.raises(UsageError, match="has no argument rules"):
        make_device_sims("lane", 4, device="cpu", rules="classic")
    with pytest.raises(UsageError, match="discrete actions only: sim 'lane' has actions 'contin"):
        make_device_sims("lane", 4, device="cpu", actions="continuous")
    with pytest.raises(UsageError, match="device sims have discrete actions only"):
        make_device_sims("mcaprl/RacerContinuous-v0", 4, device="cpu")
    with pytest.raises(UsageError, match="num_envs"):
        make_device_sims(SIMS["lane"], 0, device="cpu")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
@pytest.mark.parametrize(("name", "options"), WAYS)
def test_episodes_on_a_gpu_are_those_of_the_cpu(name: str, options: dict[str, Any]) -> None:
    there, here = (sims_of(name, device, 4096, **options) for device in ("cuda", "cpu"))
    error = (LaneCar if name == "lane" else RacerCar)._fields.index("heading_error_rad")
    for step in range(400):
        actions = actions_of(here, step)
        here.batch.actions[:] = actions
        there.batch.actions.copy_to_device(actions)
        for sims in (there, here):
            sims.step()
        if step % 20 and step > 5:
            continue
        found = type(here.batch)(*(values.copy_to_host() for values in there.batch))
        states, expected = (np.delete(one.states, error, 1) for one in (found, here.batch))
        # docs/howto/gpu.md states these bounds.
        np.testing.assert_allclose(states, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.rewards, here.batch.rewards, rtol=0, atol=1e-6)
        for array in ("terminated", "truncated", "steps", "episodes"):
            np.testing.assert_array_equal(getattr(found, array), getattr(here.batch, array))
        # Outside a corner of the path, its two legs are equally near, and rounding decides which
        # leg is the direction of the path.
        for array in ("observations", "final_observations"):
            differ = np.abs(getattr(found, array) - getattr(here.batch, array)) > 1e-6
            assert differ.any(1).mean() < 0.02
            assert not np.delete(differ, OBSERVED_ERROR, 1).any()
    assert here.batch.episodes.sum() > 4096
