"""Measure the sims relative to highway-env's environments, on one core.

`python -m benchmarks.speed.sims` prints steps per second on this machine; `make bench` has the
ratios.
"""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import OURS, Side, Table, after, compare, cpu_s
from benchmarks.speed.gl_camera import GlCamera
from mcaprl.sims import DepthCamera, encode_depth, lens, make_sim, make_sims

CARS, DRONES, RACERS = 1024, 64, 256
QUADROTOR_STEPS = 5
"""Number of steps of 0.1 s in one drone action (0.5 s); a step has 50 integration steps."""

NO_CHANGE = 6
"""Discrete action of the drone that keeps the commanded velocity."""
STEPS = 1_000_000
"""Number of steps to which the measured time of each sim is scaled up."""


GOALS = {
    "car": 1_000_000,
    f"car, {CARS} in a batch": 20_000_000,
    "depth image of 84x84": 12_000,
    f"quadrotor, 0.1 s of flight, {DRONES} in a batch": 200_000,
    f"racer with 18 rays, {RACERS} in a batch": 800_000,
}
"""Steps or frames per CPU second, on a fast core."""


def ours() -> list[Side]:
    """Return a benchmark side for each of our sims.

    A turn takes only hundredths of a second, so that disturbances affect few turns. An episode that
    is not finished at the end of a turn continues in the next turn.
    """
    return [
        _single("car", make_sim("lane"), 10_000),
        _batch(f"car, {CARS} in a batch", make_sims("lane", CARS), 200),
        _single("car, continuous actions", make_sim("lane", actions="continuous"), 10_000),
        _batch(
            f"car, continuous actions, {CARS} in a batch",
            make_sims("lane", CARS, actions="continuous"),
            200,
        ),
        _single("car with 16 rays", make_sim("lane", observation="rays"), 2_000),
        _frames_of("depth image of 84x84", make_sim("lane"), 100),
        _single("car with a depth image", make_sim("lane", observation="depth"), 100),
        _batch(
            f"quadrotor, 0.1 s of flight, {DRONES} in a batch",
            make_sims("powerline", DRONES),
            40,
            QUADROTOR_STEPS,
        ),
        # Random increments end more episodes than random discrete actions, and starts take time.
        *(
            _batch(
                f"quadrotor, {actions}, no change, 0.1 s of flight, {DRONES} in a batch",
                make_sims("powerline", DRONES, actions=actions),
                40,
                QUADROTOR_STEPS,
                action,
            )
            for actions, action in (("discrete", NO_CHANGE), ("increments", np.zeros(3, "f4")))
        ),
        _single("racer with 18 rays", make_sim("racer"), 4_000),
        _batch(f"racer with 18 rays, {RACERS} in a batch", make_sims("racer", RACERS), 50),
        _batch(
            f"racer, continuous actions, {RACERS} in a batch",
            make_sims("racer", RACERS, actions="continuous"),
            50,
        ),
    ]


def tables() -> list[Table]:
    """Time a step of each sim."""
    sides = [
        *ours(),
        _single("highway-env, lane-keeping-v0", _highway("highway_env:lane-keeping-v0"), 500),
        _single("highway-env, racetrack-v1", _highway("highway_env:racetrack-v1"), 50),
    ]
    table = compare(
        "A sim step with random actions, resets included",
        sides,
        goal="1,000 steps of the car in the time of one step of highway-env's racetrack",
        rounds=20,
        ours="car",
    )
    table.unit = "CPU time, one car = 1"
    return [table, depth_images()]


def depth_images() -> Table:
    """Time depth images of a city of boxes beside OpenGL's software renderer.

    Both cameras render 256x144 pixels, which the same code downsamples to 84x84.
    """
    random = np.random.default_rng(0)
    mesh, view, small = _city(random), lens(256, 144, math.pi / 2), (84, 84)
    poses = [_pose(random) for _ in range(100)]
    camera = DepthCamera(mesh, view, small)
    rivals: list[GlCamera] = []

    def prepare() -> None:
        rivals.append(GlCamera(mesh, view, small))
        for pose in poses[:10]:
            codes = [encode_depth(each.image_m(*pose)).astype(int) for each in (camera, *rivals)]
            differing = float((abs(codes[0] - codes[1]) > 2).mean())
            assert differing < 0.02, f"{differing:.1%} of the pixels differ"

    sides = [
        Side(OURS, lambda: [camera.image_m(*pose) for pose in poses]),
        Side(
            "moderngl with Mesa's llvmpipe, one thread",
            after(prepare, lambda: [rivals[0].image_m(*pose) for pose in poses]),
        ),
    ]
    return compare(
        f"A depth image of 84x84: {len(mesh):,} triangles at 256x144, downsampled",
        sides,
        goal="1.3 times as fast as moderngl's software renderer",
        rounds=20,
    )


def _city(random: np.random.Generator) -> NDArray[np.float64]:
    """Return the triangles (T, 3, 3) of the ground and of 118 boxes around the origin, meters."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)), float)
    # The corners of the faces run counter-clockwise, seen from outside.
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([part for a, b, c, d in faces for part in ((a, b, c), (a, c, d))])
    at = random.uniform(-150, 150, (118, 2))
    at = np.where(abs(at).min(axis=1, keepdims=True) < 10, at + 20 * np.sign(at), at)
    sizes = random.uniform((4, 4, 3), (20, 20, 25), (len(at), 3))
    boxes = (
        corners[triangles] * sizes[:, None, None]
        + np.column_stack([at, 0 * at[:, 0]])[:, None, None]
    )
    ground = 500.0 * np.array(
        [[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]]
    )
    return np.concatenate([ground, boxes.reshape(-1, 3, 3)])


def _pose(random: np.random.Generator) -> tuple[tuple[float, float, float], NDArray[np.float64]]:
    """Return the position and the axes of a level camera on one of two streets."""
    along, yaw = random.uniform(-100, 100), random.uniform(-math.pi, math.pi)
    cos, sin = math.cos(yaw), math.sin(yaw)
    position = (along, 0.0, 1.5) if random.random() < 0.5 else (0.0, along, 1.5)
    return position, np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])


def main() -> None:
    """Print the steps per second of each sim, in the best of a hundred turns."""
    for side in ours():
        taken_s = min(cpu_s(side.run) for _ in range(100))
        rate, goal = side.share * STEPS / taken_s, GOALS.get(side.name)
        print(f"{side.name}: {rate:,.0f} steps/s" + (f" (goal {goal:,})" if goal else ""))


def _highway(env_id: str) -> gym.Env[Any, Any]:
    with warnings.catch_warnings():
        # Gymnasium warns about the float64 in some of highway-env's spaces.
        warnings.simplefilter("ignore")
        return gym.make(env_id, disable_env_checker=True)


def _single(name: str, env: gym.Env[Any, Any], steps: int) -> Side:
    sim = env.unwrapped
    sim.action_space.seed(0)
    actions = [sim.action_space.sample() for _ in range(steps)]
    sim.reset(seed=0)

    def run() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = sim.step(action)
            if terminated or truncated:
                sim.reset()

    return Side(name, run, share=steps / STEPS)


def _frames_of(name: str, env: gym.Env[Any, Any], frames: int) -> Side:
    """Return a benchmark side that renders a frame after each step, but not after a reset."""
    sim: Any = env.unwrapped
    sim.action_space.seed(0)
    actions = [sim.action_space.sample() for _ in range(frames)]
    sim.reset(seed=0)

    def run() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = sim.step(action)
            encode_depth(sim.depth_image_m())
            if terminated or truncated:
                sim.reset()

    return Side(name, run, share=frames / STEPS)


def _batch(
    name: str,
    env: gym.vector.VectorEnv[Any, Any, Any],
    steps: int,
    each: int = 1,
    action: Any = None,
) -> Side:
    """Return a side that steps a batch with one action, or with random ones."""
    random = np.random.default_rng(0)
    space = env.single_action_space
    actions: NDArray[Any]
    if action is not None:
        actions = np.array([[action] * env.num_envs] * steps)
    elif isinstance(space, gym.spaces.Discrete):
        actions = random.integers(int(space.n), size=(steps, env.num_envs))
    else:
        shape = (steps, env.num_envs, *(space.shape or ()))
        actions = random.uniform(-1.0, 1.0, shape).astype(np.float32)
    env.reset(seed=0)

    def run() -> None:
        for action in actions:
            env.step(action)

    return Side(name, run, share=steps * env.num_envs * each / STEPS)


if __name__ == "__main__":
    main()
