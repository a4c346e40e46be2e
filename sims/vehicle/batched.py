"""Base class of the batched environments, which step N vehicles as one Gymnasium VectorEnv."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.sims.vehicle.controls import check_name
from mcaprl.sims.vehicle.fleet import GOING_ON, Fleet

Bools = NDArray[np.bool_]


class BatchedEnv(VectorEnv[Any, Any, NDArray[Any]]):
    """Vector environment that steps N vehicles of one sim together.

    Vehicle i has the same observations, rewards, ends and infos as the sim's single environment
    would have with the seed `seed + i` and a TimeLimit wrapper. Infos have Gymnasium's vector
    format: for each key, an array and a mask `_key` of the environments that have the key.

    `reset` accepts the options of the sim's single environment. They apply to all vehicles, but a
    `pose` of shape (N, K) has one row for each vehicle. The option `reset_mask`, an array of N
    bools, selects the vehicles to reset.

    The autoreset modes are Gymnasium's. `NextStep` resets in the step after an episode's end and
    ignores the action of that step. `SameStep` resets immediately; it returns the last observation
    in `final_obs` and the last info in `final_info`. With `Disabled`, the caller resets.
    """

    fleet_type: ClassVar[type[Fleet]]
    render_mode = None

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **kwargs: Any,
    ) -> None:
        """Create N vehicles.

        Args:
            num_envs: Number of vehicles N, at least 1.
            max_episode_steps: Steps after which an episode is truncated; None for no limit.
            autoreset_mode: Autoreset mode, as described for the class.
            **kwargs: Arguments of the sim's single environment, except `render_mode`.

        Raises:
            UnknownNameError: An argument has an unknown value.
            UsageError: A number is outside its range.
        """
        if kwargs.pop("render_mode", None) is not None:
            raise UsageError("batched sims do not render: make a single sim with render_mode")
        _check_count("num_envs", num_envs)
        if max_episode_steps is not None:
            _check_count("max_episode_steps", max_episode_steps)
        self.num_envs = num_envs
        if not isinstance(autoreset_mode, AutoresetMode):
            check_name("autoreset_mode", autoreset_mode, [mode.value for mode in AutoresetMode])
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.fleet = fleet = self.fleet_type(num_envs, **kwargs)
        self.step_duration_s = fleet.step_duration_s
        self.action_meanings = fleet.controls.meanings
        self.action_part_names, self.action_units = fleet.controls.parts
        self.observation_names = fleet.observation_names
        self.single_observation_space = fleet.observation_space
        self.single_action_space = fleet.controls.space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._truncates = np.array(fleet.truncates)
        self._some_truncate = bool(self._truncates.any())
        self._reasons = np.array(fleet.reasons, dtype=object)
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._max_steps = np.iinfo(np.int64).max if max_episode_steps is None else max_episode_steps
        # Number of steps so far, and its value when each vehicle's episode started.
        self._steps = 0
        self._started = np.zeros(num_envs, dtype=np.int64)
        self._randoms = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended = np.ones(num_envs, dtype=np.bool_)
        self._is_started = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: Seed of the first vehicle (vehicle i uses seed + i), one seed for each vehicle, or
                None to keep the current random generators.
            options: Options as described for the class.

        Raises:
            UsageError: The number of seeds is wrong, or an option is unknown or malformed.
        """
        others = dict(options or {})
        chosen = _mask_of(others.pop("reset_mask", None), self.num_envs)
        seeds = _seeds_of(seed, self.num_envs)
        starts = _starts_of(others, self.num_envs)
        for i in np.flatnonzero(chosen).tolist():
            if seeds[i] is not None:
                self._randoms[i] = seeding.np_random(seeds[i])[0]
            self.fleet.begin(i, self._randoms[i], starts[i])
        self._started[chosen], self._ended[chosen] = self._steps, False
        self._is_started = True
        return self.fleet.observations(), self._infos_of(chosen, np.zeros_like(chosen))

    def step(self, actions: Any) -> tuple[Any, NDArray[np.float64], Bools, Bools, dict[str, Any]]:
        """Advance each vehicle by one step.

        Args:
            actions: (N,) integers, or (N, P) parts of continuous actions.

        Raises:
            UsageError: The actions are invalid, or autoreset is disabled and an ended episode was
                not reset.
            ResetNeeded: `reset` was not called.
        """
        self.fleet.set_actions(actions)
        if not self._is_started:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise UsageError(
                f"episodes {np.flatnonzero(self._ended).tolist()} have ended and autoreset is"
                " disabled: call reset(options={'reset_mask': terminated | truncated}) first"
            )
        fleet = self.fleet
        if fleet.noise.size:
            for i in (~self._ended).nonzero()[0].tolist():
                fleet.noise[i] = self._randoms[i].standard_normal(fleet.noise.shape[1])
        fleet.advance()
        self._steps += 1
        # In mode `NextStep`, this step resets the environments whose episodes ended before it.
        self._begin_all(self._ended.nonzero()[0])
        has_reason = fleet.ends != GOING_ON
        terminated, truncated = has_reason, self._started <= self._steps - self._max_steps
        if self._some_truncate:
            cut = self._truncates[fleet.ends]
            terminated, truncated = has_reason & ~cut, cut | truncated
        rewards = fleet.rewards.copy()
        self._ended = terminated | truncated
        infos = self._infos(has_reason)
        return fleet.observations(), rewards, terminated, truncated, infos

    def places(self) -> NDArray[np.float64]:
        """Return the positions of all vehicles, (N, 2) x and y in the map, meters."""
        return self.fleet.places()

    def _begin_all(self, chosen: NDArray[np.int64]) -> None:
        if len(chosen):
            self.fleet.begin_all(chosen, self._randoms)
            self._started[chosen], self._ended[chosen] = self._steps, False

    def _infos(self, has_reason: Bools) -> dict[str, Any]:
        """Return the infos of a step. In mode `SameStep`, first reset the episodes that ended."""
        if self.autoreset_mode is not AutoresetMode.SAME_STEP or not self._ended.any():
            return self._infos_of(self._all, has_reason)
        ended = self._ended.copy()
        last = np.empty(self.num_envs, dtype=object)
        final = self._infos_of(ended, has_reason)
        chosen = ended.nonzero()[0]
        for i in chosen.tolist():
            last[i] = self.fleet.observation(i)
        self._begin_all(chosen)
        return {
            "final_obs": last,
            "_final_obs": ended,
            "final_info": final,
            "_final_info": ended.copy(),
            **self._infos_of(self._all, ~self._all),
        }

    def _infos_of(self, chosen: Bools, has_reason: Bools) -> dict[str, Any]:
        """Return the infos of the chosen vehicles, with the reasons why episodes ended."""
        infos: dict[str, Any] = {}
        for key, values in self.fleet.infos().items():
            infos[key] = values if chosen is self._all else np.where(chosen, values, 0)
            infos[f"_{key}"] = chosen.copy()
        those = has_reason.nonzero()[0]
        if len(those):
            # The items of an empty object array are None.
            reasons = np.empty(self.num_envs, dtype=object)
            reasons[those] = self._reasons[self.fleet.ends[those]]
            infos["reason"], infos["_reason"] = reasons, has_reason.copy()
        return infos


def _check_count(argument: str, value: object) -> None:
    if not isinstance(value, int | np.integer) or value < 1:
        raise UsageError(f"{argument} must be an integer of at least 1, not {value!r}")


def _seeds_of(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Return one seed for each vehicle."""
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(count)]
    seeds = list(seed)
    if len(seeds) != count:
        raise UsageError(f"{len(seeds)} seeds for {count} environments: pass one for each")
    return seeds


def _mask_of(mask: Any, count: int) -> Bools:
    """Validate `reset_mask`. If it is None, select all vehicles."""
    if mask is None:
        return np.ones(count, dtype=np.bool_)
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != np.bool_ or not chosen.any():
        raise UsageError(
            f"reset_mask must be an array of {count} bools, at least one of them true, not {mask!r}"
        )
    return chosen


def _starts_of(options: dict[str, Any], count: int) -> list[dict[str, Any] | None]:
    """Return the options for each vehicle; split a pose of shape (N, K) into its rows."""
    poses: Any = options.get("pose")
    if np.ndim(poses) != 2:
        return [options] * count
    if len(poses) != count:
        raise UsageError(f"{len(poses)} poses for {count} environments: pass one, or one for each")
    return [{**options, "pose": pose} for pose in poses]
