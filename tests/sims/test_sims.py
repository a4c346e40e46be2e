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
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.errors import PolicyError, UnknownNameError, UsageError
from mcaprl.sims import SIMS, make_sim
from mcaprl.sims.drawing.depth import encode_depth
from mcaprl.sims.evaluation.evaluate import make_pilot
from mcaprl.sims.powerline.course import POINTS_M, point_on_line
from tests.support.sims import action_of, batched, check_shape, rotated, unwrapped

Trace = list[tuple[bytes, float, bool, bool, dict[str, Any]]]

CASES: list[tuple[str, dict[str, Any]]] = [
    ("lane", {}),
    ("lane", {"observation": "depth"}),
    ("lane", {"observation": "dashboard"}),
    ("lane", {"observation": "depth-commands"}),
    ("lane", {"observation": "rays"}),
    ("lane", {"rules": "classic", "start": "anywhere"}),
    ("lane", {"rules": "classic-code", "observation": "depth"}),
    ("lane", {"actions": "continuous"}),
    ("lane", {"actions": "continuous", "observation": "rays"}),
    ("lane", {"actions": "continuous", "observation": "depth-commands"}),
    ("racer", {}),
    ("racer", {"rules": "classic", "start": "anywhere"}),
    ("racer", {"actions": 5, "drift": True, "track_seed": 3}),
    ("racer", {"actions": "continuous"}),
    ("powerline", {}),
    ("powerline", {"observation": "depth", "camera": "front"}),
    ("powerline", {"plant": "point", "wind_m_s": 4.0, "gust_m_s": 1.0}),
    ("powerline", {"rules": "classic"}),
    ("powerline", {"actions": "continuous"}),
    ("powerline", {"actions": "increments", "gust_m_s": 1.0}),
    ("highway-lane", {}),
    ("highway-lane", {"actions": "continuous"}),
    ("highway-lane", {"road": "racetrack-v0"}),
]
ON_THE_GROUND = ("lane", "racer", "highway-lane")
BATCHED = [name for name, env_id in SIMS.items() if gym.spec(env_id).vector_entry_point]
POSES: dict[str, Any] = {
    "lane": (131.0, -60.0, -math.pi / 2),
    "racer": (5.0, 30.0, -math.pi / 2),
    "powerline": tuple(point_on_line(150.0)),
    "highway-lane": (60.0, 0.0, 0.2),
}
ROADS: dict[str, Any] = {"highway-lane": {"road": "racetrack-v0"}}
LONGEST = 3_000
every_sim = pytest.mark.parametrize(
    ("name", "kwargs"), CASES, ids=[f"{name}-{'-'.join(kwargs)}" for name, kwargs in CASES]
)
seeds = st.integers(0, 2**32 - 1)
choices = st.lists(st.integers(0, 2**16), min_size=1, max_size=30)


def as_bytes(observation: Any) -> bytes:
    if isinstance(observation, dict):
        return b"".join(observation[key].tobytes() for key in sorted(observation))
    return bytes(observation.tobytes())


def actions_of(env: gym.Env[Any, Any], chosen: list[int]) -> list[Any]:
    return [action_of(env.action_space, number) for number in chosen]


def trace(env: gym.Env[Any, Any], seed: int, actions: list[Any]) -> Trace:
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
def test_the_checker_of_gymnasium_passes(name: str, kwargs: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(unwrapped(name, **kwargs))


@every_sim
def test_the_checker_of_sb3_passes(name: str, kwargs: dict[str, Any]) -> None:
    of_sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_sb3.check_env(unwrapped(name, **kwargs))


@every_sim
@settings(max_examples=15)
@given(seeds, choices)
def test_seed_and_actions_determine_every_bit(
    name: str, kwargs: dict[str, Any], seed: int, chosen: list[int]
) -> None:
    first, second = unwrapped(name, **kwargs), unwrapped(name, **kwargs)
    actions = actions_of(first, chosen)
    assert trace(first, seed, actions) == trace(second, seed, actions)
    assert trace(first, seed, actions) == trace(second, seed, actions), "an episode later"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("name", BATCHED)
def test_a_copy_continues_independently(name: str, copied: Callable[[Any], Any]) -> None:
    first = unwrapped(name)
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
    sim = unwrapped(name, **kwargs)
    starts = [sim.reset(seed=0)[0], sim.reset(seed=1)[0], sim.reset()[0]]
    assert len({as_bytes(start) for start in starts}) == 3


@every_sim
@settings(max_examples=15)
@given(seeds, choices)
def test_observations_are_in_the_space_to_the_very_end(
    name: str, kwargs: dict[str, Any], seed: int, chosen: list[int]
) -> None:
    sim = unwrapped(name, **kwargs)
    observation, _ = sim.reset(seed=seed)
    assert sim.observation_space.contains(observation)
    for action in actions_of(sim, chosen):
        observation, _, terminated, truncated, _ = sim.step(action)
        assert sim.observation_space.contains(observation)
        if terminated or truncated:
            break


@every_sim
def test_an_observation_is_a_copy(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    first, _ = sim.reset(seed=0)
    kept = as_bytes(first)
    sim.step(action_of(sim.action_space, 1))
    assert as_bytes(first) == kept


@every_sim
def test_every_end_has_one_cause_and_a_reason(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    sim.action_space.seed(0)
    for seed in range(10):
        sim.reset(seed=seed)
        terminated = truncated = False
        for _ in range(LONGEST):
            _, _, terminated, truncated, info = sim.step(sim.action_space.sample())
            assert ("reason" in info) == (terminated or truncated)
            if terminated or truncated:
                break
        assert terminated != truncated


@every_sim
def test_every_shape_can_be_drawn(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    sim.reset(seed=0)
    names = [shape.name for shape in sim.scene()]
    sim.step(action_of(sim.action_space, 1))
    shapes = [*sim.static_scene(), *sim.scene()]
    frames = {"map", *(frame.name for frame in [*sim.static_frames(), *sim.frames()])}
    for shape in shapes:
        check_shape(shape, frames)
    assert len({shape.name for shape in shapes}) == len(shapes)
    assert [shape.name for shape in sim.scene()] == names


@pytest.mark.parametrize(("name", "action"), [("lane", 4), ("powerline", 6)])
def test_the_moving_shapes_keep_their_names_and_stay_few(name: str, action: int) -> None:
    sim = unwrapped(name)
    sim.reset(options={"pose": POSES[name]})
    names = [shape.name for shape in sim.scene()]
    for _ in range(70):
        sim.step(action)
    assert [shape.name for shape in sim.scene()] == names
    assert sum(len(shape.points) for shape in sim.scene()) < {"lane": 60, "powerline": 80}[name]


@pytest.mark.parametrize("name", ON_THE_GROUND)
def test_the_frame_and_the_trail_are_where_the_car_is(name: str) -> None:
    x_m, y_m, yaw_rad = POSES[name]
    sim = unwrapped(name, **ROADS.get(name, {}))
    sim.reset(options={"pose": POSES[name]})
    (frame,) = sim.frames()
    assert (frame.name, frame.parent, frame.position) == ("car", "map", (x_m, y_m, 0.0))
    ahead, left = (math.cos(yaw_rad), math.sin(yaw_rad)), (-math.sin(yaw_rad), math.cos(yaw_rad))
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), [*ahead, 0], atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (0, 1, 0)), [*left, 0], atol=1e-12)
    for _ in range(2):
        (trail,) = (shape.points for shape in sim.scene() if shape.name == "trail")
        assert trail[0, :2].tolist() == [x_m, y_m]
        place = sim.telemetry()
        assert trail[-1, :2].tolist() == [place["x_m"], place["y_m"]]
        sim.step(1)


@pytest.mark.parametrize("name", ["lane", "racer"])
def test_the_wheels_touch_the_ground(name: str) -> None:
    sim = unwrapped(name)
    sim.reset(seed=0)
    shapes = [*sim.static_scene(), *sim.scene()]
    wheels = [shape for shape in shapes if shape.name.startswith("car_wheel")]
    assert len(wheels) == 4
    for wheel in wheels:
        assert wheel.points[:, 2].min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "kwargs", "view", "right"),
    [
        ("lane", {}, (1, 0, 0), (0, -1, 0)),
        ("powerline", {"camera": "front"}, (1, 0, 0), (0, -1, 0)),
        ("powerline", {"camera": "down"}, (0, 0, -1), (0, -1, 0)),
    ],
)
def test_the_camera_has_optical_axes(
    name: str, kwargs: dict[str, Any], view: tuple[int, ...], right: tuple[int, ...]
) -> None:
    (frame,) = unwrapped(name, **kwargs).static_frames()
    assert (frame.name, frame.parent) == ("camera", "car" if name == "lane" else "drone")
    assert frame.position == (0.4, 0.0, 1.4) or name != "lane"
    np.testing.assert_allclose(rotated(frame, (0, 0, 1)), view, atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (1, 0, 0)), right, atol=1e-12)
    np.testing.assert_allclose(rotated(frame, (0, 1, 0)), np.cross(view, right), atol=1e-12)


@pytest.mark.parametrize("name", SIMS)
def test_a_window_shows_each_step(name: str) -> None:
    env = make_sim(name, render_mode="human")
    env.reset(seed=0)
    env.step(1)
    assert env.render() is None
    env.close()


@pytest.mark.parametrize("name", SIMS)
def test_rendering_needs_a_mode(name: str) -> None:
    """The environment is unwrapped, because Gymnasium's wrapper warns if there is no mode."""
    sim = unwrapped(name)
    sim.reset(seed=0)
    assert sim.render() is None


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("lane", {"observation": "depth"}),
        ("lane", {"observation": "dashboard"}),
        ("powerline", {"observation": "depth", "camera": "down"}),
        ("powerline", {"observation": "depth", "camera": "front"}),
    ],
)
def test_the_camera_image_is_observed(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    observation, _ = sim.reset(seed=4)
    for _ in range(2):
        seen = observation["depth"] if isinstance(observation, dict) else observation
        depth_m = sim.depth_image_m()
        assert (depth_m.shape, depth_m.dtype) == ((84, 84), np.float32)
        assert (seen.shape, seen.dtype) == ((84, 84, 1), np.uint8)
        np.testing.assert_array_equal(seen[:, :, 0], encode_depth(depth_m))
        observation, *_ = sim.step(1)


@pytest.mark.parametrize(("name", "far_m", "code"), [("lane", 50.0, 5), ("powerline", 20.0, 12)])
def test_half_of_the_classic_image_codes_are_for_1_to_2_m(
    name: str, far_m: float, code: int
) -> None:
    """A known fault of the published images."""
    sim = unwrapped(name, rules="classic", observation="depth")
    observation, _ = sim.reset(seed=0)
    depth_m = sim.depth_image_m()
    assert observation[:, :, 0][depth_m > 2.0].max() <= 127
    assert observation[:, :, 0][depth_m > far_m].max() <= code


@pytest.mark.parametrize(
    ("name", "limits"),
    [
        # The path of the racer is a polyline, so offsets differ slightly from those of the spline.
        ("lane", {"lateral_offset_m": 1.5, "heading_error_rad": 0.2, "speed_m_s": 10.0}),
        ("racer", {"lateral_offset_m": 1.25, "heading_error_rad": 0.32, "speed_m_s": 6.0}),
    ],
)
def test_random_starts_are_where_the_card_says(name: str, limits: dict[str, float]) -> None:
    sim = unwrapped(name)
    for seed in range(200):
        _, info = sim.reset(seed=seed)
        for key, limit in limits.items():
            assert abs(info[key]) <= limit + 1e-9
        assert info["speed_m_s"] >= 0.0
        assert info["progress_m"] == info.get("gates_passed", 0.0) == 0.0


_FLOWN = 4.6 * np.array([1.0, -0.5, -1.0])


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("lane", {"x_m": (2.0, 0.0), "y_m": (1.0, 0.3), "speed_m_s": (0.0, 0.0)}),
        ("racer", {"x_m": (5.0, 0.3), "y_m": (30.0, 0.02), "yaw_rad": (-math.pi / 2, 0.05)}),
        ("powerline", {"x_m": (float(POINTS_M[0, 0] + _FLOWN[0]), 0.25)}),
    ],
)
def test_starts_on_the_line_are_near_it_and_not_all_the_same(
    name: str, places: dict[str, tuple[float, float]]
) -> None:
    sim = unwrapped(name, start="line")
    found = set()
    for seed in range(20):
        sim.reset(seed=seed)
        telemetry = sim.telemetry()
        for key, (place, tolerance) in places.items():
            assert telemetry[key] == pytest.approx(place, abs=tolerance + 1e-9)
        found.add((telemetry["x_m"], telemetry["y_m"]))
    assert len(found) == 20


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("lane", {"observation": "depth"}),
        ("racer", {}),
        ("powerline", {}),
        ("powerline", {"observation": "depth"}),
        ("highway-lane", {}),
        *((name, {"actions": "continuous"}) for name in SIMS),
    ],
)
def test_actions_of_the_pilot_have_a_leading_dimension_of_one(
    name: str, kwargs: dict[str, Any]
) -> None:
    env = make_sim(name, **kwargs)
    observation, _ = env.reset(seed=0)
    pilot = make_pilot(env)
    actions = pilot.act(batched(observation))
    assert pilot.name == "pilot"
    assert actions.shape == (1, *(env.action_space.shape or ()))
    assert actions.dtype == env.action_space.dtype
    assert env.action_space.contains(actions[0])
    with pytest.raises(ValueError, match="not 2"):
        pilot.act(batched(observation, 2))
    if isinstance(env.action_space, spaces.Discrete):
        assert pilot.log_prob(batched(observation), actions).tolist() == [0.0]
    else:
        with pytest.raises(PolicyError, match="pilot has no action probabilities"):
            pilot.log_prob(batched(observation), actions)


@every_sim
def test_names_and_metadata_fit_the_sim(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    sim.reset(seed=0)
    is_discrete = isinstance(sim.action_space, spaces.Discrete)
    assert len(sim.action_meanings) == (sim.action_space.n if is_discrete else 0)
    parts = 0 if is_discrete else sim.action_space.shape[0]
    assert (len(set(sim.action_part_names)), len(sim.action_units)) == (parts, parts)
    # Only vectors have names.
    is_vector = len(sim.observation_space.shape or ()) == 1
    names = sim.observation_names
    assert (len(names),) == (sim.observation_space.shape if is_vector else (0,))
    if name == "racer" or kwargs.get("rules", "default") == "default":
        # `metadata` is an attribute of the class, so its frame rate is that of the default rules.
        # The decisions of the classic car and drone are longer.
        assert sim.step_duration_s * sim.metadata["render_fps"] == pytest.approx(1.0)
    assert {"x_m", "y_m", "speed_m_s"} <= set(sim.telemetry())
    before = sim.telemetry()
    sim.step(action_of(sim.action_space, 1))
    assert before.keys() == sim.telemetry().keys()
    assert all(type(value) is float and math.isfinite(value) for value in before.values())


@every_sim
def test_the_time_limit_truncates_without_a_reason(name: str, kwargs: dict[str, Any]) -> None:
    env = make_sim(name, max_episode_steps=2, **kwargs)
    env.reset(seed=1)
    action = action_of(env.action_space, 0)
    assert env.step(action)[3] is False
    _, _, terminated, truncated, info = env.step(action)
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
    assert description.continuous_id is not None
    continuous = make_sim(description.continuous_id)
    assert continuous.action_space == make_sim(name, actions="continuous").action_space
    assert isinstance(continuous.action_space, spaces.Box)
    assert make_pilot(continuous).action_space == continuous.action_space
    discrete = make_sim(description.continuous_id, actions="discrete")
    assert isinstance(discrete.action_space, spaces.Discrete)


@every_sim
def test_an_invalid_action_is_refused(name: str, kwargs: dict[str, Any]) -> None:
    sim = unwrapped(name, **kwargs)
    sim.reset(seed=0)
    if not isinstance(sim.action_space, spaces.Discrete):
        zeros = np.zeros(sim.action_space.shape, np.float32)
        for wrong, words in [(math.nan, "NaN"), (1.001, r"1\.00100005"), (-math.inf, "-inf")]:
            parts = zeros.copy()
            parts[-1] = wrong
            problem = f"action: {sim.action_part_names[-1]} is {words}; it must be -1 to 1"
            with pytest.raises(UsageError, match=problem):
                sim.step(parts)
        for other in (np.zeros(9, np.float32), 0, "left", zeros.astype(complex), None):
            with pytest.raises(UsageError, match=f"numbers .{sim.action_part_names[0]}.*not"):
                sim.step(other)
        return
    last = int(sim.action_space.n) - 1
    for action in (-1, last + 1):
        with pytest.raises(UsageError, match=f"actions are 0 to {last}"):
            sim.step(action)
    with pytest.raises(UsageError, match="is not an integer"):
        sim.step(1.5)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("lane", "continuous"), ("racer", "continuous"), ("powerline", "increments")],
)
def test_the_published_rules_have_discrete_actions(name: str, kind: str) -> None:
    words = (
        f"actions '{kind}' need the rules 'default': the rules 'classic' are published with disc"
    )
    with pytest.raises(UsageError, match=words):
        unwrapped(name, rules="classic", actions=kind)


@pytest.mark.parametrize("name", SIMS)
@pytest.mark.parametrize("argument", ["rules", "observation", "start"])
def test_an_unknown_value_is_refused_with_the_known_ones(name: str, argument: str) -> None:
    with pytest.raises(UnknownNameError, match=f"unknown {argument} 'nonsense': .*known: "):
        unwrapped(name, **{argument: "nonsense"})


@pytest.mark.parametrize(
    ("name", "kwargs", "words"),
    [
        ("lane", {"rules": "classics"}, "did you mean classic or classic-code\\?"),
        ("lane", {"observation": "stat"}, "did you mean state\\?"),
        ("lane", {"start": "pole"}, "known: None, anywhere, line"),
        ("racer", {"rules": "clasic"}, "did you mean classic\\? known: classic, default"),
        ("racer", {"observation": "depth"}, "unknown observation 'depth': known: rays"),
        ("racer", {"start": "pole"}, "known: None, anywhere, line"),
        ("racer", {"actions": 7}, "unknown actions '7': .*known: 5, 8, 9, continuous, discrete"),
        ("racer", {"drift": "yes"}, "unknown drift 'yes': known: False, True"),
        ("racer", {"render_mode": "ansi"}, "known: None, human, rgb_array"),
        ("powerline", {"actions": "velocity"}, "known: continuous, discrete, increments"),
        ("highway-lane", {"actions": "sticks"}, "known: continuous, discrete"),
        ("powerline", {"rules": "clasic"}, "unknown rules 'clasic': did you mean classic"),
        ("powerline", {"camera": "up"}, "known: down, front"),
        ("powerline", {"plant": "plane"}, "known: None, point, quad"),
        ("powerline", {"start": "pole"}, "known: anywhere, line"),
        ("highway-lane", {"road": "motorway"}, "unknown road 'motorway': .*racetrack-oval-v0"),
    ],
)
def test_an_unknown_value_is_refused_with_the_nearest(
    name: str, kwargs: dict[str, Any], words: str
) -> None:
    # Gymnasium warns of render modes before it makes an environment.
    make = type(unwrapped(name))
    with pytest.raises(UnknownNameError, match=words):
        make(**kwargs)


@pytest.mark.parametrize("name", SIMS)
@pytest.mark.parametrize("pose", [(1.0, 2.0), "home", (1.0, math.nan, 0.0), (1.0, math.inf, 0.0)])
def test_a_pose_has_its_numbers(name: str, pose: Any) -> None:
    with pytest.raises(UsageError, match=r"is not \(x_m, y_m, (yaw_rad|z_m)\)"):
        unwrapped(name).reset(options={"pose": pose})


@pytest.mark.parametrize("name", SIMS)
def test_only_a_pose_is_an_option(name: str) -> None:
    with pytest.raises(UsageError, match=r"only the option 'pose', not \['place'\]"):
        unwrapped(name).reset(options={"place": POSES[name]})


@pytest.mark.parametrize(
    ("name", "pose", "words"),
    [
        ("lane", (50.0, 1.0, 0.0, -99.0), "speed_m_s must be 0 to 30, not -99.0"),
        ("lane", (50.0, 1.0, 0.0, -1.0), "speed_m_s must be 0 to 30, not -1.0"),
        ("lane", (50.0, 9.0, 0.0), "8.0 m from the path: the lane's edge is at 3.5 m"),
        ("racer", (50.0, 1.0, 0.0, -99.0), "speed_m_s must be -?[0-9]+ to [0-9]+, not -99.0"),
        ("racer", (20.0, 30.0, -math.pi / 2), "must be inside the walls at 4\\.15 m"),
        ("racer", (1.0, 30.0, -math.pi / 2), "must be inside the walls at 4\\.15 m"),
        ("racer", (-50.0, 0.0, -math.pi / 2), "must be inside the walls at 4\\.15 m"),
        ("powerline", (0.0, -32.0), "is not .* or \\(x_m, y_m, z_m, vx_m_s"),
        ("powerline", (0.0, -32.0, 19.0), "ends the episode at once: collision.*z points down"),
        ("powerline", (0.0, -32.0, -30.0), "ends the episode at once: off_line, .* m from the"),
        ("powerline", (0.0, -32.0, -19.0, 9.0, 0.0, 0.0), "speed in m/s must be 0 to 8, not 9.0"),
        ("highway-lane", (50.0, 1.0, 0.0, -99.0), "speed_m_s must be -?[0-9]+ to [0-9]+, not -99"),
        ("highway-lane", (60.0, -45.0, 0.0), "is 40.0 m from the middle of a lane: .* at 2.5 m"),
    ],
)
def test_a_pose_that_ends_the_episode_is_refused(name: str, pose: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        unwrapped(name, **ROADS.get(name, {})).reset(options={"pose": pose})


def test_importing_the_sims_loads_no_engine() -> None:
    code = (
        "import sys, mcaprl.sims, mcaprl.sims.evaluation.evaluate, mcaprl.sims.drawing.scene\n"
        "heavy = {'numba', 'torch', 'pygame', 'matplotlib', 'stable_baselines3'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
