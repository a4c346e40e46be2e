"""Checkpoints: a resumed run has the same result as an uninterrupted one.

`checkpoint.safetensors` contains one seed's tensors (weights, target network, optimizer,
generator). Its header contains the number of updates and the run's identity. All are in one file,
because two files would be inconsistent if the process were killed between the two writes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from torch import Tensor

from mcaprl.offline.algorithms.learner import Learner
from mcaprl.runs import CHECKPOINT_NAME, RunIdentity, broken_checkpoint
from mcaprl.storage.tensor_files import read_tensors, write_tensors


@dataclass(frozen=True)
class Checkpoint:
    """Stored state of the training of one seed.

    Attributes:
        path: Path of the file.
        step: Number of finished updates.
        tensors: State as `Learner.state` returns it.
    """

    path: Path
    step: int
    tensors: dict[str, Tensor]

    def restore(self, learner: Learner, seed: int) -> None:
        """Load this state into a seed of a fresh learner."""
        try:
            learner.load_state(seed, self.tensors, self.step)
        except (KeyError, RuntimeError) as error:
            raise broken_checkpoint(self.path, error) from error


def save_checkpoint(folder: Path, learner: Learner, seed: int, identity: RunIdentity) -> None:
    """Replace the checkpoint in a folder with the current training state of a seed."""
    description = {"step": learner.step, **identity.parts}
    write_tensors(folder / CHECKPOINT_NAME, learner.state(seed), description)


def read_checkpoint(folder: Path, identity: RunIdentity) -> Checkpoint | None:
    """Read the checkpoint in a folder; return None if there is none."""
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return None
    try:
        tensors, description = read_tensors(path)
        identity.check_same(description, path)
        return Checkpoint(path, int(description["step"]), tensors)
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise broken_checkpoint(path, error) from error
