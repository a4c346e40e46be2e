"""Checkpoints from which a killed run resumes as if it had never been killed.

`checkpoint.safetensors` contains one seed's tensors (weights, target network, optimizer,
generator) and, in its header, the number of updates and the run's identity. One file holds both,
because a kill between two writes could separate them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from torch import Tensor

from mcaprl.errors import TrainingError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.runs import CHECKPOINT_NAME, broken_checkpoint, check_same
from mcaprl.tensor_files import read_tensors, write_tensors


@dataclass(frozen=True)
class RunIdentity:
    """What has to be the same for a run to be resumed.

    Attributes:
        algo: Name of the algorithm.
        config: Settings of the algorithm.
        data: Fingerprint of the data and their weights.
        other_data: Whether the run may be resumed with other data.
    """

    algo: str
    config: TrainingConfig
    data: str
    other_data: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {"algo": self.algo, "config": self.config.to_json(), "data": self.data}

    def check_same(self, found: Mapping[str, Any], where: Path) -> None:
        """Compare with the identity in a file.

        Raises:
            TrainingError: The file is from another run; the message names the first difference.
        """
        check_same({"algo": self.algo, "config": self.config.to_json()}, found, where)
        if not self.other_data and found.get("data") != self.data:
            raise TrainingError(
                f"cannot resume: {where} was trained on other data; resume with the same data and"
                " weights, train into another folder, or allow other data (--other-data)"
            )


@dataclass(frozen=True)
class Checkpoint:
    """The stored state of one seed.

    Attributes:
        path: Path of the file.
        step: Number of finished updates.
        tensors: State as `Learner.state` returns it.
    """

    path: Path
    step: int
    tensors: dict[str, Tensor]

    def restore(self, learner: Learner, seed: int) -> None:
        """Load this state into a seed of a fresh learner.

        Raises:
            TrainingError: The tensors are not the learner's.
        """
        try:
            learner.load_state(seed, self.tensors, self.step)
        except (KeyError, RuntimeError) as error:
            raise broken_checkpoint(self.path, error) from error


def save_checkpoint(folder: Path, learner: Learner, seed: int, identity: RunIdentity) -> None:
    """Replace the checkpoint in a folder with the current state of a seed."""
    description = {"step": learner.step, **identity.to_json()}
    write_tensors(folder / CHECKPOINT_NAME, learner.state(seed), description)


def read_checkpoint(folder: Path, identity: RunIdentity) -> Checkpoint | None:
    """Read the checkpoint in a folder; None if there is none.

    Raises:
        TrainingError: The checkpoint is from another run, or broken.
    """
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return None
    try:
        tensors, description = read_tensors(path)
        identity.check_same(description, path)
        return Checkpoint(path, int(description["step"]), tensors)
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise broken_checkpoint(path, error) from error
