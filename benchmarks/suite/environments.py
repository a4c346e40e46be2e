"""Environments of other packages as the suite needs them; registered with Gymnasium on import.

They differ from those of their packages in what their docstrings say, above all in that
`reset(seed=...)` determines the start and goal. The packages are imported when they are made.
"""

from __future__ import annotations

import tempfile
from typing import Any, Final
from unittest import mock

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class Breakout(gym.ObservationWrapper[NDArray[np.uint8], Any, Any]):
    """MinAtar's Breakout with the three actions that it uses, and cells of 0 or 255, not of bool.

    So an observation (10, 10, 4) is an image, whose channels are paddle, ball, trail and bricks.
    """

    def __init__(self) -> None:
        """Make the game of the package `minatar`."""
        from minatar.gym import BaseEnv

        super().__init__(BaseEnv("breakout", use_minimal_action_set=True))
        shape = self.env.observation_space.shape
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset the game, and the action that the first step may repeat, which it does not."""
        game: Any = self.unwrapped
        game.game.last_action = 0
        return super().reset(seed=seed, options=options)

    def observation(self, observation: NDArray[np.bool]) -> NDArray[np.uint8]:
        """Return cells as pixels."""
        return observation * np.uint8(255)


class PointMaze(gym.Wrapper[Any, Any, Any, Any]):
    """The medium maze of `ogbench` with one start and one goal, its default task.

    The package draws the noise of the start from NumPy's global generator.
    """

    def __init__(self) -> None:
        """Make the maze of the package `ogbench`."""
        import ogbench  # noqa: F401

        # The package leaves a temporary file, and its descriptor, for each environment.
        with tempfile.TemporaryDirectory() as folder:
            path = f"{folder}/maze.xml"
            with mock.patch.object(tempfile, "mkstemp", return_value=(None, path)):
                env: Any = gym.make("pointmaze-medium-singletask-v0").unwrapped
        super().__init__(env)
        env.add_noise = self._near
        self._random = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset the maze."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        return self.env.reset(seed=seed, options=options)

    def _near(self, position: tuple[float, float]) -> tuple[float, ...]:
        """Return a random position within a unit, a fourth of a cell, along each axis."""
        return tuple(position + self._random.uniform(-1, 1, 2))


def arm(task: str) -> gym.Env[Any, Any]:
    """Return a task of `metaworld` whose positions are drawn at each reset, and are observed.

    The package requires MuJoCo 3.3.0 because it sets all parameters of the weld that moves the
    hand; here, the parameters that MuJoCo 4 added keep their values.
    """
    import metaworld
    import mujoco

    base: Any = metaworld.ALL_V3_ENVIRONMENTS[task]

    class Arm(base):  # type: ignore[misc]
        def reset_mocap_welds(self) -> None:
            welds = self.model.eq_type == mujoco.mjtEq.mjEQ_WELD
            self.model.eq_data[welds, :11] = [0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5]

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            if seed is not None:
                self.np_random, _ = gym.utils.seeding.np_random(seed)
            return super().reset(options=options)

    env = Arm()
    env._partially_observable = False
    del env.sawyer_observation_space
    env.observation_space = env.sawyer_observation_space
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    return env


_ENTRIES: Final[dict[str, tuple[Any, int, dict[str, Any]]]] = {
    "Breakout-v1": (Breakout, 1_000, {}),
    "PointMaze-v0": (PointMaze, 1_000, {}),
    "Reach-v3": (arm, 200, {"task": "reach-v3"}),
    "DrawerOpen-v3": (arm, 200, {"task": "drawer-open-v3"}),
}
for _id, (_make, _steps, _given) in _ENTRIES.items():
    gym.register(_id, f"{__name__}:{_make.__name__}", max_episode_steps=_steps, kwargs=_given)
