"""The task of a run: algorithm, settings and environment, the same for every seed."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gymnasium import Env, spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from mcaprl.actions import BoxActions, joint_actions, short_name
from mcaprl.errors import SpaceError, TrainingError, UnknownNameError, UsageError, import_extra
from mcaprl.frames import parts_of_space
from mcaprl.online.config import (
    BOX_ALGOS,
    CONFIGS,
    ENGINES,
    FINITE_ALGOS,
    OnlineConfig,
    find_preset,
    reference_settings,
    settings_for,
    warm_settings,
)
from mcaprl.runs import CONFIG_NAME, RunIdentity, check_kind, read_config, run_to_resume
from mcaprl.settings import check_settings, settings_from_json
from mcaprl.sims import make_sim, make_sims
from mcaprl.sims.evaluation.rollout import make_limited, make_limited_sims


def find_config(algo: str) -> type[OnlineConfig]:
    """Find the settings of an algorithm by its name."""
    if algo not in CONFIGS:
        raise UnknownNameError("algorithm", algo, CONFIGS)
    return CONFIGS[algo]


def check_spaces(
    algo: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Check that an algorithm supports the spaces of an environment."""
    find_config(algo)
    for space in parts_of_space(observation_space).values():
        if not isinstance(space, spaces.Box):
            raise SpaceError(f"{algo} needs Box observations, or a Dict of them, got {space}")
    if isinstance(action_space, spaces.Box):
        if algo not in BOX_ALGOS:
            fitting = f"for {short_name(action_space)} use {' or '.join(BOX_ALGOS[:2])}"
            raise SpaceError(f"{algo} needs discrete actions; {fitting}")
        BoxActions.of(action_space)
        return
    if algo not in FINITE_ALGOS:
        fitting = f"for {short_name(action_space)} use {FINITE_ALGOS[0]}"
        raise SpaceError(f"{algo} needs the actions of a Box; {fitting}")
    joint = joint_actions(action_space)
    if joint is None or joint.shape:
        hint = ""
        if joint is not None:
            hint = ": wrap the environment so that one Discrete action has all elements, or record"
            hint += " and train offline (train-offline)"
        raise SpaceError(f"{algo} needs discrete actions, got {action_space}{hint}")
    if joint.first != 0:
        raise SpaceError(
            f"{algo} needs actions that start at 0, got {action_space}:"
            " wrap the environment in gymnasium.wrappers.TransformAction"
        )


def default_algo(sim: str, sim_options: Mapping[str, Any]) -> str:
    """Return the default algorithm for the actions of an environment."""
    with closing(make_sim(sim, **sim_options)) as env:
        is_box = isinstance(env.action_space, spaces.Box)
    return BOX_ALGOS[0] if is_box else FINITE_ALGOS[0]


def choose_engine(algo: str, engine: str | None) -> str:
    """Return the engine that trains an algorithm; None selects the first one that has it."""
    if algo == "tqc":
        import_extra("sb3_contrib", "contrib")
    if engine is None:
        return next(name for name, algos in ENGINES.items() if algo in algos)
    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if algo not in ENGINES[engine]:
        algos = ", ".join(ENGINES[engine])
        raise UsageError(f"`engine={engine!r}` has no {algo}, but {algos}")
    return engine


@dataclass(frozen=True)
class Task:
    """An algorithm with its settings, and the environment in which it learns."""

    algo: str
    config: OnlineConfig  # Settings of the algorithm
    sim: str  # Short name or Gymnasium id
    sim_options: dict[str, Any]  # Arguments of the environment
    # Steps after which an episode is truncated, in training and evaluation. None selects the
    # environment's own limit; evaluations of environments without one then have the limit of
    # `mcaprl.sims.evaluation.rollout`.
    max_steps: int | None = None
    engine: str = ""  # Key of `ENGINES`; empty selects the first one that has the algorithm

    @property
    def is_sb3(self) -> bool:
        """Whether Stable-Baselines3 trains the agents."""
        return choose_engine(self.algo, self.engine or None) == "sb3"

    @classmethod
    def for_sim(
        cls,
        sim: str,
        algo: str | None = None,
        sim_options: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> Task:
        """Return a task with the settings of `SIM_SETTINGS` for the sim, else SB3's defaults."""
        options = dict(sim_options or {})
        algo = algo or default_algo(sim, options)
        find_config(algo)
        return cls._checked(algo, sim, options, settings_for(algo, sim, options), settings)

    @classmethod
    def of_preset(
        cls, name: str, sim_options: Mapping[str, Any] | None = None, **settings: Any
    ) -> Task:
        """Return a task with the published settings of a preset, except those that are given."""
        preset = find_preset(name)
        options = {**preset.sim_options, **(sim_options or {})}
        return cls._checked(preset.algo, preset.sim, options, preset.settings, settings)

    @classmethod
    def of_run(cls, folder: Path, **settings: Any) -> Task:
        """Return an earlier session's task; repeated `settings` must have the same values."""
        found = read_config(folder)
        check_kind(folder, found, "online")
        if "device" in found:
            raise TrainingError(
                f"cannot resume: {folder} was trained with `device=`; train into another folder"
            )
        try:
            earlier = settings_from_json(found["config"])
            task = cls._checked(
                found["algo"], found["sim"], dict(found["sim_options"]), earlier, settings
            )
            return replace(task, max_steps=found.get("max_steps"), engine=found.get("engine", ""))
        except (KeyError, TypeError) as error:
            raise TrainingError(
                f"{folder / CONFIG_NAME} does not belong to an online run: {error}"
            ) from error

    @classmethod
    def _checked(
        cls,
        algo: str,
        sim: str,
        sim_options: dict[str, Any],
        defaults: Mapping[str, Any],
        given: Mapping[str, Any],
    ) -> Task:
        config_type = find_config(algo)
        check_settings(algo, config_type, given)
        return cls(algo, config_type(**{**defaults, **given}), sim, sim_options)

    def batch(self, count: int) -> VectorEnv[Any, Any, Any]:
        """Create a batch of environments, each reset in the step that ends its episode."""
        options = {"autoreset_mode": AutoresetMode.SAME_STEP.value, **self.sim_options}
        if self.max_steps is not None:
            return make_limited_sims(self.sim, count, self.max_steps, **options)
        return make_sims(self.sim, count, **options)

    def evaluation_batch(self, count: int) -> VectorEnv[Any, Any, Any]:
        """Create a batch of environments in which each episode ends, each reset a step later."""
        return make_limited_sims(self.sim, count, self.max_steps, **self.sim_options)

    def evaluation_env(self) -> Env[Any, Any]:
        """Create an environment in which each episode ends."""
        return make_limited(self.sim, self.max_steps, **self.sim_options)

    @property
    def identity(self) -> RunIdentity:
        """Settings of this task that must not change when a run is resumed."""
        parts = {"algo": self.algo, "sim": self.sim, "sim_options": self.sim_options}
        # Runs of earlier versions have no limit in their files.
        limit = {} if self.max_steps is None else {"max_steps": self.max_steps}
        engine = {"engine": self.engine} if self.engine else {}
        own = {**parts, **limit, **engine, "config": self.config.to_json()}
        return RunIdentity(own, defaults=type(self.config)().to_json())


def choose_task(
    sim: str | None,
    algo: str | None,
    sim_options: Mapping[str, Any],
    given: Mapping[str, Any],
    *,
    preset: str | None = None,
    max_steps: int | None = None,
    engine: str | None = None,
    resumed: Path | None = None,
    with_logs: bool = False,
    with_policy: bool = False,
) -> Task:
    """Return the task that arguments describe."""
    # `with_logs`, `with_policy` are what it starts from.
    is_resumed = resumed is not None and run_to_resume(resumed)
    if sim is not None and preset is None and not is_resumed:
        algo = algo or default_algo(sim, sim_options)
        find_config(algo)
        if choose_engine(algo, engine) == "sb3":
            replaced = reference_settings(algo, sim_options)
        else:
            replaced = warm_settings(algo, with_logs=with_logs, with_policy=with_policy)
        given = {**replaced, **given}
    task = _described(sim, algo, sim_options, given, preset, max_steps, engine, resumed)
    choose_engine(task.algo, task.engine or None)
    return task


def _described(
    sim: str | None,
    algo: str | None,
    sim_options: Mapping[str, Any],
    given: Mapping[str, Any],
    preset: str | None,
    max_steps: int | None,
    engine: str | None,
    resumed: Path | None,
) -> Task:
    if resumed is not None and run_to_resume(resumed):
        task = Task.of_run(resumed, **given)
        options = {**task.sim_options, **sim_options}
        limit = max_steps or task.max_steps
        engine = engine or task.engine
        task = Task(algo or task.algo, task.config, sim or task.sim, options, limit, engine)
        task.identity.check_same(read_config(resumed), resumed / CONFIG_NAME)
        return task
    if preset is not None:
        task = Task.of_preset(preset, sim_options, **given)
        for what, value, own in (("the sim", sim, task.sim), ("`algo=`", algo, task.algo)):
            if value not in (None, own):
                raise UsageError(f"preset {preset} sets {what} to {own}: omit {what} {value}")
        return replace(task, max_steps=max_steps, engine=engine or "")
    if sim is None:
        raise UsageError("online training needs a sim, such as lane, or `preset=NAME`")
    task = Task.for_sim(sim, algo, sim_options, **given)
    return replace(task, max_steps=max_steps, engine=engine or "")
