"""Checkpoints: a killed run goes on from one as if it had never been killed.

`checkpoint.safetensors` holds one seed's tensors (weights, target, optimiser, generator) and, in
its header, the update it belongs to and the run's identity. They are one file because two could be
torn apart by a kill between them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from torch import Tensor

from mcaprl.errors import TrainingError
from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.tensor_files import read_tensors, write_tensors

CHECKPOINT_NAME = "checkpoint.safetensors"


@dataclass(frozen=True)
class RunIdentity:
    """What must be the same for a run to go on.

    Attributes:
        algo: the algorithm's name.
        config: its settings.
        data: the fingerprint of the data and their weights.
        other_data: go on with other data all the same.
    """

    algo: str
    config: TrainingConfig
    data: str
    other_data: bool = False

    def to_json(self) -> dict[str, Any]:
        """As plain JSON types."""
        settings = {
            k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.config).items()
        }
        return {"algo": self.algo, "config": settings, "data": self.data}

    def check_same(self, found: dict[str, Any], where: Path) -> None:
        """Compare with the identity in a file.

        Raises:
            TrainingError: the file is from another run; the message names the first difference.
        """
        mine = self.to_json()
        for part in ("algo", "config") if self.other_data else ("algo", "config", "data"):
            if found.get(part) != mine[part]:
                raise TrainingError(
                    f"cannot resume: {where} {_difference(part, found.get(part), mine[part])}"
                )


@dataclass(frozen=True)
class Checkpoint:
    """One seed's state, as it was read.

    Attributes:
        path: of the file.
        step: updates done.
        tensors: see `Learner.state`.
    """

    path: Path
    step: int
    tensors: dict[str, Tensor]

    def restore(self, learner: Learner, seed: int) -> None:
        """Bring a fresh learner's seed to this state.

        Raises:
            TrainingError: the tensors are not the learner's.
        """
        try:
            learner.load_state(seed, self.tensors, self.step)
        except (KeyError, RuntimeError) as error:
            raise _broken(self.path, error) from error


def save_checkpoint(folder: Path, learner: Learner, seed: int, identity: RunIdentity) -> None:
    """Replace the folder's checkpoint by a seed's present state."""
    description = {"step": learner.step, **identity.to_json()}
    write_tensors(folder / CHECKPOINT_NAME, learner.state(seed), description)


def read_checkpoint(folder: Path, identity: RunIdentity) -> Checkpoint | None:
    """The folder's checkpoint, if there is one.

    Raises:
        TrainingError: it is from another run, or broken.
    """
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return None
    try:
        tensors, description = read_tensors(path)
        identity.check_same(description, path)
        return Checkpoint(path, int(description["step"]), tensors)
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception) -> TrainingError:
    return TrainingError(
        f"cannot resume: {path} is broken ({error}); delete it to start this seed anew"
    )


def _difference(part: str, found: Any, expected: Any) -> str:
    elsewhere = "resume with the same settings, or train into another folder"
    if part == "data":
        return (
            "was trained on other data; resume with the same data and weights, train into another"
            " folder, or go on with these data all the same (--other-data)"
        )
    if part == "config" and isinstance(found, dict):
        name = next(k for k in [*expected, *found] if found.get(k) != expected.get(k))
        return f"has {name} {found.get(name)}, not {expected.get(name)}; {elsewhere}"
    return f"has {part} {found!r}, not {expected!r}; {elsewhere}"
