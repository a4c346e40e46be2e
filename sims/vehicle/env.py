"""Base classes of environments with one vehicle (a fleet of one), and of their pilots."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from operator import index
from typing import Any, ClassVar, Final, Generic, Literal, Protocol, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from mcaprl.actions import joint_actions
from mcaprl.base_policy import BasePolicy
from mcaprl.sims.vehicle.controls import check_name
from mcaprl.sims.vehicle.fleet import GOING_ON, Fleet

RenderMode = Literal["human", "rgb_array"]
RENDER_MODES = ("human", "rgb_array")
FLOAT: Final = np.dtype(np.float32)


class View(Protocol):
    """Renderer of a sim."""

    def close(self) -> None:
        """Close the window, if there is one."""


Frames = Sequence[Any]
"""Moving coordinate frames at one moment, each a `mcaprl.sims.drawing.scene.Frame`."""
AnyFleet = TypeVar("AnyFleet", bound=Fleet)
AnyView = TypeVar("AnyView", bound=View)


class RenderedEnv(gym.Env[Any, Any], Generic[AnyView]):
    """Environment that creates its renderer on first use."""

    def __init__(self, render_mode: RenderMode | None) -> None:
        """Set the render mode."""
        check_name("render_mode", render_mode, (None, *RENDER_MODES))
        self.render_mode = self._render_mode = render_mode
        self._view: AnyView | None = None

    @abstractmethod
    def _open_view(self, render_mode: RenderMode) -> AnyView:
        """Import pygame and create the renderer of the sim."""

    @abstractmethod
    def _draw(self, view: AnyView) -> NDArray[np.uint8]:
        """Render the vehicle in its current state as an (H, W, 3) image."""

    def render(self) -> NDArray[np.uint8] | None:
        """Render the sim. Mode `rgb_array` returns (H, W, 3) uint8, mode `human` shows a window."""
        if self._render_mode is None:
            return None
        if self._view is None:
            self._view = self._open_view(self._render_mode)
        image = self._draw(self._view)
        return image if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None


class VehicleEnv(RenderedEnv[AnyView], Generic[AnyFleet, AnyView]):
    """Environment of one vehicle, with the seeding, steps and rendering that sims share."""

    fleet_type: type[AnyFleet]
    trail_length: int = 40
    success_reasons: ClassVar[tuple[str, ...]]
    """Reasons that count as success; `time_limit` includes truncation by the TimeLimit wrapper."""

    def __init__(self, *, render_mode: RenderMode | None = None, **kwargs: Any) -> None:
        """Make the environment; see "Arguments" of the class.

        Raises:
            UnknownNameError: An argument has a value that is not allowed.
            UsageError: A number is outside its range.
        """
        super().__init__(render_mode)
        self.fleet = fleet = self.fleet_type(1, **kwargs)
        self.step_duration_s = fleet.step_duration_s
        self.controls = controls = fleet.controls
        self.action_meanings = controls.meanings
        self.action_part_names, self.action_units = controls.parts
        self.observation_names = fleet.observation_names
        self.action_space = controls.space
        self.observation_space = fleet.observation_space
        self._noise_size = fleet.noise.shape[1]
        # Copy attributes of the fleet, so that a step needs one attribute lookup instead of two.
        commands = controls.commands
        self._commands = None if commands is None else list(map(tuple, commands.tolist()))
        self._n_actions, self._n_parts = len(controls.meanings), (len(controls.names),)
        self._trail: deque[tuple[float, ...]] = deque(maxlen=self.trail_length)
        self._is_watched = render_mode == "human"
        # The current state, and the state before the last step with that step's command. They are
        # set only if `_is_watched` is true.
        self._now: Any = None
        self._last_step: tuple[Any, Sequence[float]] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see "Starting State".

        Raises:
            UsageError: `options` has an unknown key or an invalid pose.
        """
        if seed is not None:
            super().reset(seed=seed)
        started = self.fleet.start_one(self.np_random, options)
        if self._is_watched:
            self._trail.clear()
            self._last_step = None
            self._watch()
        return started

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance the vehicle by one decision.

        Raises:
            UsageError: There is no such action.
        """
        # `Controls.read` returns the same command, but is slow.
        commands, command = self._commands, None
        if commands is None:
            if (
                type(action) is np.ndarray
                and action.dtype == FLOAT
                and action.shape == self._n_parts
            ):
                parts = action.tolist()
                for part in parts:
                    if not -1.0 <= part <= 1.0:
                        break
                else:
                    command = parts
        else:
            try:
                number = index(action)
            except TypeError:
                number = -1
            if 0 <= number < self._n_actions:
                command = commands[number]
        if command is None:
            command = self.controls.read(action)
        if self._noise_size:
            self.fleet.noise[0] = self.np_random.standard_normal(self._noise_size)
        observation, reward, end, info = self.fleet.step_one(command)
        if self._is_watched:
            self._last_step = (self._now, command)
            self._watch()
        if end == GOING_ON:
            return observation, reward, False, False, info
        info["reason"] = self.fleet.reasons[end]
        truncated = self.fleet.truncates[end]
        return observation, reward, not truncated, truncated, info

    @property
    @abstractmethod
    def place(self) -> tuple[float, ...]:
        """Current position of the vehicle, for its trail."""

    @property
    def trail(self) -> list[tuple[float, ...]]:
        """Last positions of the vehicle, at least one.

        The first read starts the collection, so earlier positions may be missing.
        """
        if not self._trail:
            self._is_watched = True
            self._trail.append(self.place)
            self._now, self._last_step = self._state(), None
        return list(self._trail)

    def motion(self) -> list[tuple[float, Frames]]:
        """Return the poses of the moving coordinate frames within the last step, in order of time.

        The moments are at most 0.05 s apart. Each element consists of the number of seconds before
        the end of the step and the coordinate frames at that moment. The list is empty after
        `reset` and before the first read of `trail`.
        """
        if self._last_step is None:
            return []
        return before_end(self._moments(*self._last_step), self.step_duration_s)

    def imitate(self, fleet: AnyFleet, j: int, action: Any) -> None:
        """Copy the state of vehicle j of a fleet, so that this environment shows the vehicle.

        Call this method after each step of the vehicle.

        Args:
            fleet: Fleet of this sim.
            j: Index of the vehicle.
            action: Action of the vehicle's last step; None after a reset.
        """
        self.fleet.imitate(0, fleet, j)
        self._is_watched = True
        if action is None:
            self._trail.clear()
        self._last_step = None if action is None else (self._now, self.fleet.commands[0].tolist())
        self._watch()

    @abstractmethod
    def _state(self) -> Any:
        """Return a copy of the state of the vehicle."""

    @abstractmethod
    def _moments(self, before: Any, command: Sequence[float]) -> list[Frames]:
        """Return the moving coordinate frames at equal intervals of the last step."""

    def _watch(self) -> None:
        """Store the vehicle's position and state. In mode `human`, render the vehicle."""
        self._trail.append(self.place)
        self._now = self._state()
        if self.render_mode == "human":
            self.render()


def before_end(moments: Sequence[Frames], duration_s: float) -> list[tuple[float, Frames]]:
    """Return the seconds before a step's end and the frames of all moments but the last."""
    count = len(moments)
    return [(duration_s * (count - 1 - k) / count, moments[k]) for k in range(count - 1)]


AnySim = TypeVar("AnySim")


class ScriptedPilot(BasePolicy, ABC, Generic[AnySim]):
    """Policy that reads the full state of one environment instead of its observations."""

    name = "pilot"

    def __init__(self, sim: AnySim) -> None:
        """Drive the vehicle of `sim`, an unwrapped environment."""
        self.sim = sim
        self.action_space = getattr(sim, "action_space", None)

    def act(self, observations: Any) -> NDArray[Any]:
        """Return the action (1, *shape) for the current state of the environment.

        Args:
            observations: Observations with a leading dimension of 1, or a dict of them.

        Raises:
            ValueError: There is not exactly one environment.
        """
        rows = next(iter(observations.values())) if isinstance(observations, dict) else observations
        if len(rows) != 1:
            raise ValueError(f"a pilot drives one environment, not {len(rows)}")
        space = self.action_space
        return np.array([self.choose()], dtype=np.int64 if space is None else space.dtype)

    def action_probabilities(self, observations: Any) -> NDArray[np.floating[Any]]:
        """Return the probabilities (1, A) of the actions: 1 for that of `act`.

        Raises:
            PolicyError: The actions are continuous.
        """
        if (joint := joint_actions(self.action_space)) is None:
            return super().action_probabilities(observations)
        return np.eye(joint.count)[joint.indexes(self.act(observations))]

    @abstractmethod
    def choose(self) -> Any:
        """Choose the action for the current state."""
