"""Checkpoints: a killed run goes on from one as if it had never been killed.

`checkpoint.safetensors` holds a learner's tensors (weights, target, optimiser, generators) and, in
its header, the update it belongs to and the run's identity. They are one file because two could be
torn apart by a kill between them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from mcaprl.errors import TrainingError
from mcaprl.offline.config import TrainingConfig
from mcaprl.offline.learner import Learner
from mcaprl.tensor_files import read_tensors, write_tensors

CHECKPOINT_NAME = "checkpoint.safetensors"


@dataclass(frozen=True)
class RunIdentity:
    """What must be the same for a run to go on.

    Attributes:
        algo: the algorithm's name.
        config: its settings.
        data: the dataset's fingerprint.
    """

    algo: str
    config: TrainingConfig
    data: str

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
        for part in ("algo", "config", "data"):
            if found.get(part) != mine[part]:
                raise TrainingError(
                    f"cannot resume: {where} {_difference(part, found.get(part), mine[part])}; "
                    "resume with the same data and settings, or train into another folder"
                )


def save_checkpoint(folder: Path, learner: Learner, identity: RunIdentity) -> None:
    """Replace the folder's checkpoint by the learner's present state."""
    description = {"step": learner.step, **identity.to_json()}
    write_tensors(folder / CHECKPOINT_NAME, learner.state(), description)


def load_checkpoint(folder: Path, learner: Learner, identity: RunIdentity) -> bool:
    """Bring a fresh learner to the state of the folder's checkpoint, if there is one.

    Returns:
        Whether there was one.

    Raises:
        TrainingError: it is from another run, or broken.
    """
    path = folder / CHECKPOINT_NAME
    if not path.exists():
        return False
    try:
        tensors, description = read_tensors(path)
        identity.check_same(description, path)
        learner.load_state(tensors, int(description["step"]))
    except (OSError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise TrainingError(
            f"cannot resume: {path} is broken ({error}); delete it to start this seed anew"
        ) from error
    return True


def _difference(part: str, found: Any, expected: Any) -> str:
    if part == "data":
        return "was trained on other data"
    if part == "config" and isinstance(found, dict):
        name = next(k for k in [*expected, *found] if found.get(k) != expected.get(k))
        return f"has {name} {found.get(name)}, not {expected.get(name)}"
    return f"has {part} {found!r}, not {expected!r}"
