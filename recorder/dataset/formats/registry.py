"""The formats that can be read and written, selected by name or recognized by path.

The module of a format has these functions. A format that can only be written has no `matches` and
`read`:

    matches(path: Path) -> bool                 whether a file or folder is of the format
    read(path: Path, ...) -> Dataset            all episodes; `one_episode`, `dones` and
                                                `lossy` are options of some formats
    write(dataset: Dataset, path: Path, *, lossy: bool) -> list[str]
                                                writes the new file or the empty folder `path`;
                                                returns one sentence for each thing lost
    local_path(name: str) -> Path               optional: the folder of the dataset `FORMAT:NAME`
    options_for(path: Path) -> dict             optional: further arguments of `write`
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from mcaprl.errors import LogError, UnknownNameError, UsageError
from mcaprl.files import check_plain, replacing, replacing_folder
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.origin import Origin
from mcaprl.storage.remote import is_url

KINDS = ("terminated", "truncated")
"""Kinds of the end of an episode."""


class Format(NamedTuple):
    """A data format.

    Attributes:
        name: Name in `--to` and `--from`.
        about: Description of the format, for lists of formats.
        suffix: Suffix of the file names; empty if the format is a folder.
        reads: Whether the format can be read.
    """

    name: str
    about: str
    suffix: str = ""
    reads: bool = True

    @property
    def module(self) -> Any:
        """Module that reads and writes the format."""
        return import_module(f"mcaprl.recorder.dataset.formats.{self.name}")


# If several formats match a path, the first of them reads it.
FORMATS = {
    form.name: form
    for form in (
        Format("lerobot", "LeRobot dataset v3 (folder)"),
        Format("minari", "Minari dataset (folder, or minari:ID of a local dataset)"),
        Format("parquet", "Parquet files of transitions and episodes (folder)"),
        Format("npz", "NumPy arrays by name", ".npz"),
        Format("d3rlpy", "d3rlpy's ReplayBuffer file", ".h5"),
        Format("hdf5", "D4RL's or robomimic's HDF5 file", ".hdf5"),
    )
}
"""All formats, by name."""


def format_named(name: str) -> Format:
    """Return a format by its name.

    Raises:
        UnknownNameError: There is no such format; the message lists all formats.
    """
    if name not in FORMATS:
        raise UnknownNameError("format", name, list(FORMATS))
    return FORMATS[name]


def other_format(name: str | Path) -> Format | None:
    """Return the format of a file, a folder or `FORMAT:NAME`; None for logs and unknown ones."""
    path = Path(name)
    if is_url(name) or path.suffix == ".mcap" or (path.is_dir() and any(path.glob("*.mcap"))):
        return None
    start, colon, _ = str(name).partition(":")
    if colon and start in FORMATS:
        return FORMATS[start]
    readable = (form for form in FORMATS.values() if form.reads and path.exists())
    return next((form for form in readable if form.module.matches(path)), None)


def target_format(path: str | Path, name: str | None) -> Format:
    """Return the format to write, given by its name or by the suffix of the path.

    Raises:
        UnknownNameError: There is no format with this name.
        UsageError: The path has the suffix of logs, or the name is not given, and no format or more
            than one format has this suffix.
    """
    if name is not None:
        form = format_named(name)
        if Path(path).suffix == ".mcap":
            raise UsageError(
                f"{path} has the suffix of logs: choose another name for --to {name}, or omit --to"
                " to write a log"
            )
        return form
    start, colon, _ = str(path).partition(":")
    if colon and start in FORMATS:
        return FORMATS[start]
    suffix = Path(path).suffix
    found = [form for form in FORMATS.values() if form.suffix and form.suffix == suffix]
    if len(found) != 1:
        raise UsageError(
            f"{path}: the format is not clear from the name; pass --to with one of"
            f" {', '.join(FORMATS)}, or a name that ends with .mcap"
        )
    return found[0]


def target_path(path: str | Path, form: Format) -> Path:
    """Resolve a path, or a name such as `minari:drive/lane-v0`, to a file or folder."""
    prefix = f"{form.name}:"
    if str(path).startswith(prefix) and hasattr(form.module, "local_path"):
        local: Path = form.module.local_path(str(path).removeprefix(prefix))
        return local
    return Path(path)


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of reading that differ from their defaults.

    Raises:
        UnknownNameError: `dones` is not one of `KINDS`.
    """
    dones = options.get("dones")
    if dones is not None and dones not in KINDS:
        raise UnknownNameError("kind of ends", str(dones), KINDS)
    return {name: value for name, value in options.items() if value not in (None, False)}


def _options(form: Format) -> set[str]:
    """Return the names of the options of a format's reader."""
    return set(signature(form.module.read).parameters)


def read_format(path: str | Path, form: Format, **options: Any) -> Dataset:
    """Read a file or folder of another format.

    Args:
        path: File or folder.
        form: Format of the data.
        options: Options of the format's reader; those that are None or False are ignored.

    Raises:
        LogError: The file is missing or damaged.
        SpaceError: The data has a space that a log cannot hold, or impossible values.
        UsageError: The format does not have an option, or the option contradicts the data.
        MissingExtraError: The format needs a package that is not installed.
    """
    if not form.reads:
        raise UsageError(f"{form.name} can only be written, not read")
    source, given = target_path(path, form), _given(options)
    for name in [name for name in given if name not in _options(form)]:
        # What is stored in other formats, a log can store.
        if name != "lossy":
            having = ", ".join(one.name for one in FORMATS.values() if name in _options(one))
            raise UsageError(f"{name} is an option of reading {having}, not {form.name}")
        del given[name]
    if not source.exists():
        raise LogError(f"{path}: no such file or folder")
    try:
        check_plain(source)
    except OSError as error:
        raise LogError(f"cannot read {path}: {error}") from error
    dataset: Dataset = form.module.read(source, **given)
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
        lossy: Whether to leave out or convert data that the format cannot store.
        overwrite: Whether to replace an existing file or folder.
        options: Further arguments of the format's `write`.

    Returns:
        One sentence for each thing that was left out or changed.

    Raises:
        SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
        OutputExistsError: `path` exists, and `overwrite` is not set.
        LogError: The file cannot be written, or the dataset has no episodes.
        MissingExtraError: The format needs a package that is not installed.
    """
    if not len(dataset.episode_lengths):
        raise LogError(f"nothing to write to {path}: the dataset has no episodes")
    place = target_path(path, form)
    if hasattr(form.module, "options_for"):
        options = {**form.module.options_for(place), **options}
    target = replacing if form.suffix else replacing_folder
    with target(place, LogError, overwrite=overwrite) as unfinished:
        lost: list[str] = form.module.write(dataset, unfinished, lossy=lossy, **options)
    return lost
