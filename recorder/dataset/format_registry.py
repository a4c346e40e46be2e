"""The formats of other tools, selected by name or recognized by path.

A package adds a format with an entry point of the group `mcaprl.formats`, which maps the format's
name to its `Format` subclass, `module:Class`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from mcaprl.errors import LogError, UnknownNameError, UsageError
from mcaprl.files import check_plain, replacing, replacing_folder
from mcaprl.lazy import installed, load
from mcaprl.recorder.dataset.transitions import Origin
from mcaprl.recorder.format.behavior import FIELDS, BehaviorField
from mcaprl.recorder.format.metadata import NO_TIMES, LogMetadata
from mcaprl.storage.remote import is_url

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset

ENTRY_POINT_GROUP: Final = "mcaprl.formats"
VIDEO_NOTE: Final = "video: "
"""Begin of the sentences of `Format.write` on videos of which nothing is lost."""
KINDS = ("terminated", "truncated")
"""Kinds of the end of an episode."""
_OTHERS = ("success_reasons", "view", "epsilon", "seed", "unstored_kwargs")


def _any_summary(*names: str) -> Callable[[Dataset], bool]:
    return lambda data: any(
        getattr(e.summary, n) not in (None, "") for e in data.episodes for n in names
    )


def _metadata(data: Dataset) -> LogMetadata:
    return LogMetadata.from_strings(data.metadata)


def _has_final_infos(data: Dataset) -> bool:
    rows = np.cumsum(data.episode_lengths + 1) - 1
    return any(not np.ma.getmaskarray(values[rows]).all() for values in data.infos.values())


def _has_behavior(field: BehaviorField, data: Dataset) -> bool:
    return data.behavior_field == field and not np.isnan(data.behavior).all()


FACTS: Mapping[str, Callable[[Dataset], bool]] = {
    "spaces": lambda data: True,
    "times": lambda data: data.metadata.get("times") != NO_TIMES,
    "environment": lambda data: bool(data.env_id),
    "names of observations": lambda data: bool(data.observation_names),
    "names and commands of actions": lambda data: (
        bool(data.action_meanings) or data.action_commands is not None
    ),
    "names of parts of actions": lambda data: bool(data.action_part_names),
    "units of parts of actions": lambda data: any(data.action_units),
    **{field.name: partial(_has_behavior, field) for field in FIELDS},
    "policy names": _any_summary("policy"),
    "seeds and reset options": _any_summary("seed", "options"),
    "end reasons": lambda data: any(e.summary.reason not in ("", *KINDS) for e in data.episodes),
    "infos": lambda data: bool(data.infos),
    "infos of final observations": _has_final_infos,
    "final observations after a termination": lambda data: bool(data.terminated.any()),
    "description of the source": lambda data: bool(_metadata(data).about),
    "other metadata": lambda data: any(getattr(_metadata(data), name) for name in _OTHERS),
}
"""What a dataset has beside its transitions: names, and whether a dataset has it."""


class Format:
    """A data format of another tool. A subclass overrides `matches`, `read`, `write` or all three.

    A package adds a format to `mcaprl` with an entry point in its `pyproject.toml`, which has the
    format's name:

        [project.entry-points."mcaprl.formats"]
        columns = "columns.mcaprl_format:Columns"

    Attributes:
        name: Name in `--to` and `--from`.
        about: Description of the format, for lists of formats.
        suffix: Suffix of the file names, such as `.npz`; empty if the format is a folder.
        keeps: Data beside the transitions that the format has a place for; default: all of
            `spaces`, `times`, `environment`, `names of observations`, `names and commands of
            actions`, `names of parts of actions`, `units of parts of actions`, `behavior_prob`,
            `behavior_log_prob`, `policy names`, `seeds and reset options`, `end reasons`, `infos`,
            `infos of final observations`, `final observations after a termination`, `description of
            the source` and `other metadata`. Writing lists the others that a dataset has.
    """

    name: ClassVar[str]
    about: ClassVar[str] = ""
    suffix: ClassVar[str] = ""
    keeps: ClassVar[frozenset[str]] = frozenset(FACTS)

    def matches(self, path: Path) -> bool:
        """Return whether an existing file or folder is of the format."""
        return False

    def read(self, path: Path, **options: Any) -> Dataset:
        """Read all episodes of a file or folder.

        Args:
            path: Existing file or folder.
            options: `one_episode`, `dones` and `lossy`, as in `mcaprl.open`. A format has those
                that its method names.

        Raises:
            LogError: The data is damaged.
            SpaceError: The data has a space that a log cannot hold, or impossible values.
        """
        raise UsageError(f"{self.name} can only be written, not read")

    def write(self, dataset: Dataset, path: Path, *, lossy: bool, **options: Any) -> list[str]:
        """Write a dataset.

        Args:
            dataset: Episodes to write.
            path: New file, or empty folder.
            lossy: Whether to leave out or convert transitions that the format cannot store.
            options: Further options of the format.

        Returns:
            One sentence for each thing that was left out or changed, beside what `keeps` lacks.

        Raises:
            SpaceError: The format cannot store the transitions, and `lossy` is not set.
        """
        raise UsageError(f"{self.name} can only be read, not written")

    def located(self, name: str) -> Path:
        """Return the path of the dataset `FORMAT:NAME`."""
        raise UsageError(f"'{self.name}:{name}' is not a path: {self.name} has no named datasets")

    def options_for(self, path: Path) -> dict[str, Any]:
        """Return options of `write` that depend on the final path."""
        return {}

    def reading_options(self) -> set[str]:
        """Return the names of the options of `read`."""
        return set(signature(self.read).parameters) - {"path", "options"}

    def left_out(self, dataset: Dataset) -> list[str]:
        """Return a sentence that lists the facts of a dataset that the format has no place for."""
        lost = [name for name, has in FACTS.items() if name not in self.keeps and has(dataset)]
        if "infos" in lost:
            lost = [name for name in lost if name != "infos of final observations"]
        return [f"{self.name} has no place for {', '.join(lost)}: a log keeps them"] if lost else []


Format.__module__ = "mcaprl"  # the path in messages and documentation


def module_of(tool: str) -> Any:
    """Return the module of this package that converts data of a tool."""
    return import_module(f"mcaprl.recorder.dataset.formats.{tool}")


class _BuiltIn(Format):
    """A format of this package, whose module is imported on first use.

    The module has functions with the names and arguments of the methods that it overrides.
    """

    @property
    def _module(self) -> Any:
        return module_of(self.name)

    def matches(self, path: Path) -> bool:
        return bool(self._module.matches(path))

    def read(self, path: Path, **options: Any) -> Dataset:
        found: Dataset = self._module.read(path, **options)
        return found

    def write(self, dataset: Dataset, path: Path, *, lossy: bool, **options: Any) -> list[str]:
        lost: list[str] = self._module.write(dataset, path, lossy=lossy, **options)
        return lost

    def reading_options(self) -> set[str]:
        return set(signature(self._module.read).parameters) - {"path"}


class _LeRobot(_BuiltIn):
    name, about = "lerobot", "LeRobot dataset v3 (folder)"
    keeps = frozenset(
        {
            "names of observations",
            "names of parts of actions",
            "behavior_prob",
            "behavior_log_prob",
            "infos",
            "infos of final observations",
        }
    )


class _Minari(_BuiltIn):
    name, about = "minari", "Minari dataset (folder, or minari:ID of a local dataset)"
    keeps = frozenset(FACTS) - {
        "times",
        "names of observations",
        "names and commands of actions",
        "names of parts of actions",
        "units of parts of actions",
        "behavior_prob",
        "behavior_log_prob",
        "policy names",
        "end reasons",
        "other metadata",
    }

    def located(self, name: str) -> Path:
        found: Path = self._module.local_path(name)
        return found

    def options_for(self, path: Path) -> dict[str, Any]:
        found: dict[str, Any] = self._module.options_for(path)
        return found


class _Parquet(_BuiltIn):
    name, about = "parquet", "Parquet files of transitions and episodes (folder)"


class _Npz(_BuiltIn):
    name, about, suffix = "npz", "NumPy arrays by name", ".npz"
    keeps = frozenset(
        {
            "times",
            "behavior_prob",
            "behavior_log_prob",
            "infos",
            "infos of final observations",
            "final observations after a termination",
        }
    )


class _D3rlpy(_BuiltIn):
    name, about, suffix = "d3rlpy", "d3rlpy's ReplayBuffer file", ".h5"
    keeps = frozenset()


class _Hdf5(_BuiltIn):
    name, about, suffix = "hdf5", "D4RL's or robomimic's HDF5 file", ".hdf5"
    keeps = frozenset(
        {"behavior_prob", "behavior_log_prob", "infos", "final observations after a termination"}
    )


# If several formats match a path, the first of them reads it.
FORMATS: dict[str, Format] = {
    form.name: form() for form in (_LeRobot, _Minari, _Parquet, _Npz, _D3rlpy, _Hdf5)
}
"""The built-in formats by name."""


def every_format() -> Iterator[Format]:
    """Yield the built-in formats, and then those of installed packages."""
    yield from FORMATS.values()
    for entry in installed(ENTRY_POINT_GROUP).values():
        yield load(entry, Format, FORMATS)()


def format_named(name: str) -> Format:
    """Return a format by its name."""
    found = next((form for form in every_format() if form.name == name), None)
    if found is None:
        raise UnknownNameError("format", name, [form.name for form in every_format()])
    return found


def other_format(name: str | Path) -> Format | None:
    """Return the format of a file, a folder or `FORMAT:NAME`; None for logs and unknown ones."""
    path = Path(name)
    if is_url(name) or path.suffix == ".mcap" or (path.is_dir() and any(path.glob("*.mcap"))):
        return None
    prefix, colon, _ = str(name).partition(":")
    exists = path.exists()
    for form in every_format():
        if (colon and form.name == prefix) or (exists and form.matches(path)):
            return form
    return None


def target_format(path: str | Path, name: str | None) -> Format:
    """Return the format to write, given by its name or by the suffix of the path."""
    if name is not None:
        form = format_named(name)
        if Path(path).suffix == ".mcap":
            raise UsageError(
                f"{path} has the suffix of logs: choose another name for `to={name!r}`, or omit"
                " `to=` to write a log"
            )
        return form
    every = list(every_format())
    prefix, colon, _ = str(path).partition(":")
    suffix = Path(path).suffix
    found = [form for form in every if form.name == prefix] if colon else []
    # A folder may have the name of its format as its suffix: `drives.parquet`.
    found = found or [form for form in every if suffix == (form.suffix or f".{form.name}")]
    if len(found) != 1:
        raise UsageError(
            f"{path}: the format is not clear from the name; pass `to=` with one of"
            f" {', '.join(form.name for form in every)}, or a name that ends with .mcap"
        )
    return found[0]


def target_path(path: str | Path, form: Format) -> Path:
    """Resolve a path, or a name such as `minari:drive/lane-v0`, to a file or folder."""
    prefix = f"{form.name}:"
    return (
        form.located(str(path).removeprefix(prefix)) if str(path).startswith(prefix) else Path(path)
    )


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of reading that differ from their defaults."""
    dones = options.get("dones")
    if dones is not None and dones not in KINDS:
        raise UnknownNameError("kind of ends", str(dones), KINDS)
    return {name: value for name, value in options.items() if value not in (None, False)}


def read_format(path: str | Path, form: Format, **options: Any) -> Dataset:
    """Read a file or folder of another format.

    Args:
        path: File or folder.
        form: Format of the data.
        options: Options of the format's reader; those that are None or False are ignored.
    """
    source, given = target_path(path, form), _given(options)
    for name in given.keys() - form.reading_options():
        # What is stored in other formats, a log can store.
        if name != "lossy":
            having = ", ".join(f.name for f in every_format() if name in f.reading_options())
            raise UsageError(f"{name} is an option of reading {having}, not {form.name}")
        del given[name]
    if not source.exists():
        raise LogError(f"{path}: no such file or folder")
    try:
        check_plain(source)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error}") from error
    dataset = form.read(source, **given)
    if not dataset.sources:
        dataset.origin = Origin((source,))
    return dataset


def write_format(
    dataset: Dataset,
    path: str | Path,
    form: Format,
    *,
    lossy: bool = False,
    overwrite: bool = False,
    **options: Any,
) -> list[str]:
    """Write a dataset in another format; `path` only appears when the data is complete.

    Args:
        dataset: Episodes to write.
        path: File or folder to create.
        form: Format to write.
        lossy: Whether to leave out or convert transitions that the format cannot store.
        overwrite: Whether to replace an existing file or folder.
        options: Further arguments of the format's `write`.

    Returns:
        One sentence for each thing that was left out or changed.
    """
    if not len(dataset.episode_lengths):
        raise LogError(f"nothing to write to {path}: the dataset has no episodes")
    place = target_path(path, form)
    options = {**form.options_for(place), **options}
    target = replacing if form.suffix else replacing_folder
    with target(place, LogError, overwrite=overwrite) as unfinished:
        lost = form.write(dataset, unfinished, lossy=lossy, **options)
    return lost + form.left_out(dataset)
