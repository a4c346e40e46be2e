"""The folder of a training run: whose it is, and whether it may be written to."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaprl.errors import OutputExistsError, TrainingError
from mcaprl.files import write_json
from mcaprl.offline.training.checkpoint import RunIdentity
from mcaprl.offline.training.metrics import METRICS_NAME

CONFIG_NAME = "config.json"


@dataclass(frozen=True)
class RunFolder:
    """A run folder with one folder for each seed.

    Attributes:
        path: of the folder.
        identity: of the run.
        source: what else to write down of the data.
    """

    path: Path
    identity: RunIdentity
    source: dict[str, Any]

    def open(self, resume: bool) -> None:
        """Make the folder, or make sure that it is this run's.

        What a run left that ended before its first checkpoint is no obstacle, and is removed.

        Raises:
            OutputExistsError: it is taken.
            TrainingError: it is another run's, or cannot be written.
        """
        config = self.path / CONFIG_NAME
        leftovers = self._leftovers()
        if leftovers is not None:
            for path in leftovers:
                path.unlink()
        elif resume and config.exists():
            self.identity.check_same(read_config(config), config)
            if not self.identity.other_data:
                return
        else:
            hint = (
                "; it holds no run to resume" if resume else ", or resume the run in it (--resume)"
            )
            raise OutputExistsError(f"{self.path} exists: choose another folder{hint}")
        write_json(config, {**self.identity.to_json(), **self.source}, TrainingError)

    def of_seed(self, seed: int) -> Path:
        """The folder of one seed; it is made."""
        folder = self.path / f"seed-{seed}"
        folder.mkdir(exist_ok=True)
        return folder

    def _leftovers(self) -> list[Path] | None:
        """Files of a start that came to nothing; None if the folder has anything else."""
        if not self.path.exists():
            return []
        if not self.path.is_dir():
            return None
        found: list[Path] = []
        for path in self.path.iterdir():
            is_seed = path.is_dir() and path.name.startswith("seed-")
            found += path.iterdir() if is_seed else [path]
        return found if all(map(_is_leftover, found)) else None


def read_config(path: Path) -> dict[str, Any]:
    """What RUN/config.json says: `algo`, `config`, `data` and where the data came from.

    Raises:
        TrainingError: it cannot be read, or is no JSON object.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise TrainingError(f"cannot resume: {path} is no JSON object")
    return found


def _is_leftover(path: Path) -> bool:
    names = (CONFIG_NAME, METRICS_NAME)
    return path.is_file() and (path.name in names or path.name.startswith("events.out.tfevents"))
