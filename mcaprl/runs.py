"""Run folders and summaries of offline and online training.

RUN/config.json                         algorithm, settings, seeds, the data or sim, and versions
RUN/robot.json                          mapping and topics of the robot that the data is from
RUN/seed-K/checkpoint.safetensors       state to resume from
RUN/seed-K/metrics.csv                  loss terms of an offline run
RUN/seed-K/policy.json, .safetensors    policy of an offline run, best policy of an online run
RUN/seed-K/curve.csv                    evaluations of an online run
RUN/seed-K/best_model.zip               best policy of an online run of Stable-Baselines3
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import OutputExistsError, PolicyError, TrainingError, UsageError
from mcaprl.files import (
    as_type,
    check_regular,
    is_leftover,
    locked_folder,
    read_json,
    remove_leftover,
    subfolder,
    target_of,
    write_json,
)
from mcaprl.texts import counted

CONFIG_NAME = "config.json"
ROBOT_NAME = "robot.json"
CHECKPOINT_NAME = "checkpoint.safetensors"
METRICS_NAME = "metrics.csv"
CURVE_NAME = "curve.csv"
POLICY_NAME = "policy.json"
BEST_NAME = "best_model.zip"
_NUMERICAL = ("torch", "numpy", "stable-baselines3")
"""Packages whose version may change the numbers of a training."""
_MAX_SEEDS = 10_000
Curve = dict[str, NDArray[np.float64]]  # Columns of a `metrics.csv` or `curve.csv` by name


@dataclass(frozen=True)
class RunSummary:
    """Result of training one seed.

    A session is the first training of a run, or a training that resumes it.

    Attributes:
        folder: Folder of the seed, RUN/seed-K.
        algo: Name of the algorithm.
        seed: Seed K.
        steps: Number of gradient updates (offline) or environment steps (online) of all sessions.
        resumed_at: Number of steps of earlier sessions; 0 for a new run.
        seconds: Wall time of this session, the same for all seeds that are trained in parallel.
    """

    folder: Path
    algo: str
    seed: int
    steps: int
    resumed_at: int
    seconds: float


@dataclass(frozen=True)
class RunIdentity:
    """Parts of a run that must match for the run to be resumed."""

    # Algorithm (`algo`), settings (`config`), and the data or sim, as plain JSON types.
    parts: dict[str, Any]
    other_data: bool = False  # Whether `parts["data"]`, the fingerprint of the data, may differ
    longer: bool = False  # Whether the run may be continued to a larger number of `updates`
    # Default settings, which runs of earlier versions had without storing them.
    defaults: dict[str, Any] = field(default_factory=dict)

    def check_same(self, found: Mapping[str, Any], where: Path) -> None:
        """Check that the identity in a file is equal to this identity."""
        mine = self.parts
        theirs: dict[str, Any] = {name: found.get(name) for name in mine}
        if isinstance(theirs.get("config"), dict):
            mine, theirs = ({**side, **side["config"], "config": None} for side in (mine, theirs))
        for name in [*mine, *theirs]:
            old, new = theirs.get(name), mine.get(name)
            if old == new or (name == "data" and self.other_data):
                continue
            if name not in theirs and new == self.defaults.get(name, ""):
                # Earlier versions did not have this setting.
                continue
            if name == "updates" and self.longer and isinstance(old, int):
                if old < int(self.parts["config"]["updates"]):
                    continue
                raise TrainingError(
                    f"cannot resume: {where} has {old} updates, more than {new}; resume with at"
                    f" least {old}, or train into another folder"
                )
            if name == "data":
                raise TrainingError(
                    f"cannot resume: {where} was trained on other data; resume with the same data"
                    " and weights, train into another folder, or allow other data:"
                    " `other_data=True`"
                )
            raise TrainingError(
                f"cannot resume: {where} has {name} {old!r}, not {new!r}; resume with the same"
                " settings, or train into another folder"
            )


@contextmanager
def locked_run(folder: Path, resume: bool) -> Iterator[None]:
    """Lock a run folder against other trainings; create the folder of a new run."""
    if resume:
        run_to_resume(folder)
    elif folder.is_file():
        raise OutputExistsError(f"{folder} exists and is a file: choose another path")
    with locked_folder(folder, TrainingError):
        yield


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an OSError of the body to a TrainingError that names `path`."""
    try:
        yield
    except OSError as error:
        raise TrainingError(f"cannot write {path}: {error.strerror or error}") from error


def open_run(
    folder: Path, identity: RunIdentity, resume: bool, seeds: range, **source: Any
) -> None:
    """Create a run folder, or check that it belongs to this run, and write `config.json`."""
    # Files of a run that ended before its first checkpoint are removed. A resumed run that was
    # started with other versions of PyTorch, NumPy or SB3 warns.
    found = run_to_resume(folder) if resume else {}
    leftovers = _leftovers(folder)
    if leftovers is None and not resume:
        raise OutputExistsError(
            f"{folder} exists: choose another folder, or resume its run (`resume=True`)"
        )
    versions: Any = _numerical_versions()
    if leftovers is None:
        identity.check_same(found, folder / CONFIG_NAME)
        versions = found.get("versions")
        _warn_of_versions(folder, versions)
    with writing(folder):
        for path in leftovers or ():
            remove_leftover(path.with_name(target_of(path))) if path.is_dir() else path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
    written = {**identity.parts, "seeds": len(seeds), "seed": seeds.start, **source}
    if versions is not None:
        written["versions"] = versions
    write_json(folder / CONFIG_NAME, written, TrainingError)


def _numerical_versions() -> dict[str, str]:
    """Return the installed versions of `_NUMERICAL`."""
    found = {}
    for package in _NUMERICAL:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _warn_of_versions(folder: Path, started_with: object) -> None:
    """Warn if a run was started with other versions; earlier runs do not contain versions."""
    if not isinstance(started_with, dict):
        return
    now = _numerical_versions()
    changed = [
        f"{package} {started_with[package]}, not {now[package]}"
        for package in _NUMERICAL
        if package in now and started_with.get(package, now[package]) != now[package]
    ]
    if changed:
        warnings.warn(
            f"{folder} was started with {' and '.join(changed)}: the resumed run may end in other"
            " bits than an uninterrupted one",
            stacklevel=2,
        )


def choose_seeds(folder: Path, seeds: int | None, seed: int | None, resume: bool) -> range:
    """Return the seeds to train. A resumed run may get further seeds, but keeps its own."""
    if (seeds is not None and seeds < 1) or (seed is not None and seed < 0):
        raise UsageError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    earlier = _seeds_of_run(folder) if resume else range(0)
    first = earlier.start if seed is None else seed
    chosen = range(first, first + (seeds or len(earlier) or 1))
    if not set(earlier) <= set(chosen):
        raise UsageError(
            f"{folder} is a run of {counted(len(earlier), 'seed')}, the first of which is"
            f" {earlier.start}: resume it without `seeds=` and `seed=`, or choose another folder"
        )
    return chosen


def _seeds_of_run(folder: Path) -> range:
    """Return the seeds of a run; those with a folder if an earlier version wrote the config."""
    match run_to_resume(folder):
        case {"seeds": int(count), "seed": int(first)}:
            return range(first, first + count)
    started = _seed_folders(folder)
    return range(min(started), max(started) + 1) if started else range(0)


def seed_folder(run: Path, seed: int) -> Path:
    """Return the folder of a seed; create it if it is missing."""
    folder = run / f"seed-{seed}"
    with writing(folder):
        return subfolder(folder)


@dataclass(frozen=True)
class _Config:
    """Types of what is read of a `config.json`; each kind of run has some of these."""

    algo: str = ""
    config: dict[str, Any] = field(default_factory=dict)
    seeds: int = 1
    seed: int = 0
    sim: str = ""
    sim_options: dict[str, Any] = field(default_factory=dict)
    max_steps: int | None = None
    env_id: str = ""

    def __post_init__(self) -> None:
        if not (1 <= self.seeds <= _MAX_SEEDS and 0 <= self.seed < 2**63):
            raise ValueError(f"a run cannot have {self.seeds} seeds from {self.seed}")


def run_to_resume(folder: Path) -> dict[str, Any]:
    """Return the config of a run, or an empty dict if the run ended before writing its config."""
    if (folder / CONFIG_NAME).exists():
        return read_config(folder)
    if not folder.is_dir() or _leftovers(folder) is None:
        raise TrainingError(
            f"{folder} has no run to resume: check the path, or start a new run without"
            " `resume=True`"
        )
    return {}


def read_config(folder: Path) -> dict[str, Any]:
    """Read the `config.json` of a run."""
    path = folder / CONFIG_NAME
    try:
        found: dict[str, Any] = read_json(path, TrainingError)
        if not isinstance(found, dict):
            raise TrainingError(f"{path} is not a JSON object")
        as_type(_Config, found)
    except ValueError as error:
        raise TrainingError(f"cannot resume: {path} cannot be read: {error}") from error
    except (FileNotFoundError, TrainingError) as error:
        raise TrainingError(f"cannot resume: {error}") from error
    return found


def read_updates(folder: Path) -> int | None:
    """Return the number of updates of an offline run as last started; None without config."""
    match run_to_resume(folder):
        case {"config": {"updates": int(updates)}}:
            return updates
    return None


def check_kind(folder: Path, config: Mapping[str, Any], kind: str) -> None:
    """Check that a run is of the kind that a command trains, `online` or `offline`."""
    other, source = ("offline", "data") if kind == "online" else ("online", "sim")
    if source in config:
        raise TrainingError(f"{folder} is an {other} run: resume it with mcaprl train-{other}")


def broken_checkpoint(path: Path, error: Exception) -> TrainingError:
    """Return the error for an unreadable checkpoint."""
    return TrainingError(
        f"cannot resume: {path} is broken ({error}); delete it to restart this seed"
    )


def policy_files(path: Path) -> list[Path]:
    """Return the existing policy files of a run, a seed's folder or a file, sorted by seed."""
    if path.is_file():
        return [path]
    numbered = _seed_folders(path)
    folders = [path, *(numbered[number] for number in sorted(numbered))]
    files = [folder / name for folder in folders for name in (POLICY_NAME, BEST_NAME)]
    return [file for file in files if file.exists()]


def _seed_folders(run: Path) -> dict[int, Path]:
    """Return the folders of a run by seed."""
    return {
        int(number): folder
        for folder in run.glob("seed-*")
        if (number := folder.name.removeprefix("seed-")).isdigit()
    }


@dataclass(frozen=True)
class _Saved:
    """What `saved_updates` reads of a `policy.json`."""

    updates: int


def saved_updates(run: Path, seeds: int) -> int:
    """Return the number of updates that all saved policies have; 0 with fewer than `seeds`."""
    files = policy_files(run)
    if len(files) < seeds:
        return 0
    found: list[_Saved] = [read_json(file, PolicyError, _Saved) for file in files]
    return min(one.updates for one in found)


def read_curve(path: Path) -> Curve:
    """Read the columns of a `metrics.csv` or `curve.csv`."""
    try:
        check_regular(path)
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise TrainingError(f"cannot read the curve in {path}: {error}") from error


def read_curves(run: Path, name: str, columns: Iterable[str] = ()) -> list[Curve]:
    """Read `metrics.csv` or `curve.csv` of each seed that has this file."""
    curves = {path: read_curve(path) for path in sorted(run.glob(f"seed-*/{name}"))}
    for path, curve in curves.items():
        needed = {*columns, *next(iter(curves.values()))}
        if missing := sorted(needed - curve.keys()):
            raise TrainingError(f"cannot read the curve in {path}: it has no {missing[0]}")
    return list(curves.values())


def _leftovers(folder: Path) -> list[Path] | None:
    """Return the files of a run without checkpoint; None if the folder has any other file."""
    if not folder.exists():
        return []
    if not folder.is_dir():
        return None
    found: list[Path] = []
    for path in folder.iterdir():
        is_seed = _is_real_folder(path) and path.name.startswith("seed-")
        found += path.iterdir() if is_seed else [path]
    return found if all(map(_is_leftover, found)) else None


def _is_real_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_leftover(path: Path) -> bool:
    if path.is_symlink():
        return False
    if path.is_dir():
        # Some files are first written in such a temporary folder. A killed run leaves it.
        return is_leftover(path)
    return path.name in (CONFIG_NAME, METRICS_NAME) or path.name.startswith("events.out.tfevents")
