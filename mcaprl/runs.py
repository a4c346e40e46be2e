"""Run folders of offline and online training, and what both report of a run.

RUN/config.json                         algorithm, settings, and the source of experience
RUN/seed-K/checkpoint.safetensors       state to resume from
RUN/seed-K/metrics.csv                  loss terms of an offline run
RUN/seed-K/policy.json, .safetensors    policy of an offline run
RUN/seed-K/curve.csv                    evaluations of an online run
RUN/seed-K/best_model.zip               policy of an online run, as Stable-Baselines3 writes it
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import OutputExistsError, TrainingError
from mcaprl.files import parse_json, write_json

CONFIG_NAME = "config.json"
CHECKPOINT_NAME = "checkpoint.safetensors"
METRICS_NAME = "metrics.csv"
CURVE_NAME = "curve.csv"
POLICY_NAME = "policy.json"
BEST_NAME = "best_model.zip"
Curve = dict[str, NDArray[np.float64]]
"""Columns of a curves file by name."""


@dataclass(frozen=True)
class RunSummary:
    """The outcome of training one seed.

    Attributes:
        folder: Folder of the seed, RUN/seed-K.
        algo: Name of the algorithm.
        seed: K.
        steps: Steps done by all sessions: gradient updates offline, environment steps online.
        resumed_at: Steps done by earlier sessions; 0 for a fresh start.
        seconds: Wall time of this session; offline, seeds that are trained together share it.
    """

    folder: Path
    algo: str
    seed: int
    steps: int
    resumed_at: int
    seconds: float


@dataclass(frozen=True)
class RunIdentity:
    """What has to be the same for a run to be resumed.

    Attributes:
        parts: Algorithm (`algo`), settings (`config`) and source of experience as plain JSON types.
        other_data: Whether the part `data`, a fingerprint, may differ.
    """

    parts: dict[str, Any]
    other_data: bool = False

    def check_same(self, found: Mapping[str, Any], where: Path) -> None:
        """Compare with the identity in a file.

        Args:
            found: Identity in the file; it may have further parts.
            where: Path of the file.

        Raises:
            TrainingError: They differ; the message names the first difference.
        """
        mine = self.parts
        theirs: dict[str, Any] = {name: found.get(name) for name in mine}
        if isinstance(theirs.get("config"), dict):
            mine, theirs = ({**side, **side["config"], "config": None} for side in (mine, theirs))
        for name in [*mine, *theirs]:
            old, new = theirs.get(name), mine.get(name)
            if old == new or (name == "data" and self.other_data):
                continue
            if name == "data":
                raise TrainingError(
                    f"cannot resume: {where} was trained on other data; resume with the same data"
                    " and weights, train into another folder, or allow other data (--other-data)"
                )
            raise TrainingError(
                f"cannot resume: {where} has {name} {old!r}, not {new!r}; resume with the same"
                " settings, or train into another folder"
            )


def open_run(folder: Path, identity: RunIdentity, resume: bool, **source: Any) -> None:
    """Create a run folder, or check that it is this run's, and write its `config.json`.

    Files of a run that ended before its first checkpoint are removed.

    Args:
        folder: Folder of the run.
        identity: Identity of the run.
        resume: Whether the folder may contain this run.
        **source: Further entries of `config.json`.

    Raises:
        OutputExistsError: The folder contains something else.
        TrainingError: The folder is another run's, or cannot be written.
    """
    leftovers = _leftovers(folder)
    if leftovers is not None:
        for path in leftovers:
            path.unlink()
    elif resume and (folder / CONFIG_NAME).exists():
        identity.check_same(read_config(folder), folder / CONFIG_NAME)
    else:
        hint = "; it contains no run to resume" if resume else ", or resume its run (--resume)"
        raise OutputExistsError(f"{folder} exists: choose another folder{hint}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / CONFIG_NAME, {**identity.parts, **source})
    except OSError as error:
        raise TrainingError(f"cannot write {folder}: {error.strerror}") from error


def seed_folder(run: Path, seed: int) -> Path:
    """Create the folder of a seed where there is none, and return it."""
    folder = run / f"seed-{seed}"
    folder.mkdir(exist_ok=True)
    return folder


def read_config(folder: Path) -> dict[str, Any]:
    """Read the `config.json` of a run.

    Raises:
        TrainingError: The file cannot be read, or is not a JSON object.
    """
    path = folder / CONFIG_NAME
    try:
        found = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise TrainingError(f"cannot resume: {path} is not a JSON object")
    return found


def broken_checkpoint(path: Path, error: Exception) -> TrainingError:
    """Return the error that reports a checkpoint which cannot be read."""
    return TrainingError(
        f"cannot resume: {path} is broken ({error}); delete it to restart this seed"
    )


def policy_files(path: Path) -> list[Path]:
    """Return the policy files of a run's seeds by rising seed; none where there are none.

    Args:
        path: Run folder, folder of one seed, or a file, which is returned as it is.
    """
    if path.is_file():
        return [path]
    numbered = {
        int(number): folder
        for folder in path.glob("seed-*")
        if (number := folder.name.removeprefix("seed-")).isdigit()
    }
    folders = [path, *(numbered[number] for number in sorted(numbered))]
    files = [folder / name for folder in folders for name in (POLICY_NAME, BEST_NAME)]
    return [file for file in files if file.exists()]


def read_curve(path: Path) -> Curve:
    """Read the columns of a `metrics.csv` or `curve.csv`.

    Raises:
        TrainingError: The file cannot be read, or has no rows.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise TrainingError(f"cannot read the curve in {path}: {error}") from error


def read_curves(run: Path, name: str) -> list[Curve]:
    """Read a curves file, `metrics.csv` or `curve.csv`, of all seeds of a run that have one."""
    return [read_curve(path) for path in sorted(run.glob(f"seed-*/{name}"))]


def _leftovers(folder: Path) -> list[Path] | None:
    """Return the files of a run that ended early; None if the folder contains anything else."""
    if not folder.exists():
        return []
    if not folder.is_dir():
        return None
    found: list[Path] = []
    for path in folder.iterdir():
        is_seed = path.is_dir() and path.name.startswith("seed-")
        found += path.iterdir() if is_seed else [path]
    return found if all(map(_is_leftover, found)) else None


def _is_leftover(path: Path) -> bool:
    names = (CONFIG_NAME, METRICS_NAME)
    return path.is_file() and (path.name in names or path.name.startswith("events.out.tfevents"))
