"""What is to be learnt, and how: the same for every seed of a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv

from mcaprl.errors import TrainingError, UsageError
from mcaprl.online.algorithms import find_algorithm
from mcaprl.online.config import OnlineConfig
from mcaprl.online.presets import find_preset
from mcaprl.online.sim_settings import settings_for
from mcaprl.settings import check_settings, plain_settings
from mcaprl.sims import make_sims

CONFIG_NAME = "config.json"
DEFAULT_ALGO = "double-dqn"


@dataclass(frozen=True)
class Task:
    """An algorithm with its settings, and the environment that it learns in.

    Attributes:
        algo: the algorithm's name.
        config: its settings.
        sim: short name or Gymnasium id.
        sim_options: arguments to the environment.
    """

    algo: str
    config: OnlineConfig
    sim: str
    sim_options: dict[str, Any]

    @classmethod
    def for_sim(
        cls,
        sim: str,
        algo: str | None = None,
        sim_options: Mapping[str, Any] | None = None,
        **settings: Any,
    ) -> Task:
        """With the settings that a sim was seen to be learnt with, or else SB3's.

        Args:
            sim: short name or Gymnasium id.
            algo: a key of `ALGORITHMS`; None is Double DQN.
            sim_options: arguments to the environment.
            **settings: that are to be others.

        Raises:
            UnknownNameError: there is no such algorithm.
            UsageError: it has no such setting, or the setting is outside its range.
        """
        algo, options = algo or DEFAULT_ALGO, dict(sim_options or {})
        config_type = find_algorithm(algo).config_type
        return cls._checked(algo, sim, options, settings_for(config_type, sim, options), settings)

    @classmethod
    def of_preset(
        cls, name: str, sim_options: Mapping[str, Any] | None = None, **settings: Any
    ) -> Task:
        """With published settings; those given here go first.

        Raises:
            UnknownNameError: there is no such preset.
            UsageError: its algorithm has no such setting, or the setting is outside its range.
        """
        preset = find_preset(name)
        options = {**preset.sim_options, **(sim_options or {})}
        return cls._checked(preset.algo, preset.sim, options, preset.settings, settings)

    @classmethod
    def of_run(cls, folder: Path, **settings: Any) -> Task:
        """That of an earlier session.

        Args:
            folder: of the run.
            **settings: that the user gives anew; if they differ, the run cannot be resumed.

        Raises:
            TrainingError: the folder does not tell.
        """
        found = read_config(folder)
        try:
            earlier = plain_settings(found["config"])
            return cls._checked(
                found["algo"], found["sim"], dict(found["sim_options"]), earlier, settings
            )
        except (KeyError, TypeError) as error:
            raise TrainingError(f"{folder / CONFIG_NAME} is of no online run: {error}") from error

    @classmethod
    def _checked(
        cls,
        algo: str,
        sim: str,
        sim_options: dict[str, Any],
        defaults: Mapping[str, Any],
        given: Mapping[str, Any],
    ) -> Task:
        config_type = find_algorithm(algo).config_type
        check_settings(algo, config_type, given)
        return cls(algo, config_type(**{**defaults, **given}), sim, sim_options)

    def batch(self, count: int) -> VectorEnv[Any, Any, Any]:
        """So many environments; each resets itself in the step that ends its episode."""
        mode = AutoresetMode.SAME_STEP.value
        return make_sims(self.sim, count, autoreset_mode=mode, **self.sim_options)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON types."""
        config = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.config).items()}
        return {
            "algo": self.algo,
            "sim": self.sim,
            "sim_options": self.sim_options,
            "config": config,
        }

    def check_same(self, found: Mapping[str, Any], where: Path) -> None:
        """Compare with the task that a file tells.

        Raises:
            TrainingError: it is another; the message names the first difference.
        """
        mine = self.to_json()
        theirs = found.get("config")
        pairs = [(part, found.get(part), mine[part]) for part in ("algo", "sim", "sim_options")]
        if isinstance(theirs, dict):
            pairs += [(name, theirs.get(name), value) for name, value in mine["config"].items()]
        for name, old, new in pairs:
            if old != new:
                raise TrainingError(
                    f"cannot resume: {where} has {name} {old!r}, not {new!r}; resume with the same"
                    " settings, or train into another folder"
                )


def choose_task(
    sim: str | None,
    algo: str | None,
    sim_options: Mapping[str, Any],
    given: Mapping[str, Any],
    *,
    preset: str | None = None,
    resumed: Path | None = None,
) -> Task:
    """The task that a command line means.

    Args:
        sim: short name or Gymnasium id; None leaves it to the preset or the run.
        algo: likewise.
        sim_options: arguments to the environment.
        given: settings of the algorithm.
        preset: published settings to start from.
        resumed: folder of a run to go on with, if there is one in it.

    Raises:
        UnknownNameError: there is no such algorithm or preset.
        UsageError: nothing tells the sim, or what is given contradicts the preset.
        TrainingError: what is given contradicts the run.
    """
    if resumed is not None and (resumed / CONFIG_NAME).exists():
        task = Task.of_run(resumed, **given)
        options = {**task.sim_options, **sim_options}
        asked = Task(algo or task.algo, task.config, sim or task.sim, options)
        asked.check_same(read_config(resumed), resumed / CONFIG_NAME)
        return asked
    if preset is not None:
        task = Task.of_preset(preset, sim_options, **given)
        for name, value, own in (("SIM", sim, task.sim), ("--algo", algo, task.algo)):
            if value not in (None, own):
                raise UsageError(f"preset {preset} has {name} {own}, not {value}: leave it out")
        return task
    if sim is None:
        raise UsageError("train-online needs a SIM, such as lane, or a --preset")
    return Task.for_sim(sim, algo, sim_options, **given)


def read_config(folder: Path) -> dict[str, Any]:
    """What RUN/config.json says: `algo`, `sim`, `sim_options` and `config`.

    Raises:
        TrainingError: it cannot be read, or is no JSON object.
    """
    path = folder / CONFIG_NAME
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise TrainingError(f"cannot resume: {path} is no JSON object")
    return found
