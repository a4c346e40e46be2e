"""Opening of logs, bags and datasets of other tools: the only way from names to a Dataset."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mcaprl.errors import BAG_HINT, NotMcapError, UnknownNameError, UsageError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.format_registry import (
    every_format,
    format_named,
    other_format,
    read_format,
)
from mcaprl.recorder.dataset.images import STORAGES, Storage
from mcaprl.recorder.dataset.labels import Labeled
from mcaprl.recorder.dataset.open import Episodes, GrowingLogs, open_logs, weighted_logs

Paths = str | Path | Sequence[str | Path]
"""A file, a folder or a glob of logs, or several of them."""
Data = Dataset | Paths
"""A dataset, or paths of logs."""
Source = Data | Callable[[], Dataset]
"""Data, or a function that opens them, which is called after other arguments are checked."""


_LISTED = 3


class ChangedMapping(NamedTuple):
    """A mapping file with other values of some keys at its top level."""

    source: str | Path | Mapping[str, Any]
    changes: Mapping[str, Any]


MappingFile = str | Path | Mapping[str, Any] | ChangedMapping
"""Path of a mapping file, or its keys and values."""
Definitions = Sequence[str | Path]
"""Files and folders with definitions of ROS types."""


def open_data(
    data: Paths,
    *,
    mapping: MappingFile | None = None,
    trust_code: bool = False,
    definitions: Definitions = (),
    format: str | None = None,
    one_episode: bool = False,
    dones: str | None = None,
    lossy: bool = False,
    columns: Sequence[str] | None = None,
    episodes: Episodes | None = None,
    images: Storage = "auto",
    threads: int = 1,
    follow: bool = False,
    weights: Sequence[float] | None = None,
) -> Dataset:
    """Read logs, a dataset of another tool, or a bag that a mapping describes.

    The CRCs of all chunks that are read are checked. If a log was cut off or is still being
    written, its finished episodes are read, with a warning. If there are several logs, those
    without a finished episode are skipped, with a warning.

    Args:
        data: A file, a folder of `.mcap` files, its `manifest.json`, a glob, or a sequence of
            these. The logs must have the same spaces; their episodes are concatenated in the order
            of the files. `data` can also be datasets of other tools, which follow the logs; see
            docs/formats.md. With a mapping, `data` can be MCAP files of any writer, rosbag2 folders
            and databases, or ROS 1 bags.
        mapping: Mapping that says which topics and fields of a bag are observations, actions,
            rewards and episode ends; see docs/bags.md. None for logs of this package.
        trust_code: Whether the mapping may name a Python function, which is imported.
        definitions: Files and folders with definitions of ROS types that a bag lacks; see
            docs/bags.md.
        format: Name of the other tool's format; default: detected from the path.
        one_episode: Whether flat arrays of another tool are one episode if nothing marks where an
            episode ends. Otherwise, such arrays are refused.
        dones: Kind of the ends in flat arrays of another tool that no array distinguishes:
            `terminated` or `truncated`; see docs/formats.md for the default.
        lossy: Whether parts of a Minari dataset that a log cannot store are left out. Otherwise,
            such a dataset is refused.
        columns: Keys to read from a Dict observation space, for example `joints/q` for a nested
            key. The dataset's observation space contains only these keys. An empty sequence reads
            no observations. Actions, rewards and end flags are always read. Default: all keys.
        episodes: Index, slice or indexes of the episodes to read, counted over all logs and
            returned in the logs' order. Default: all episodes.
        images: Storage of image observations: `memory`, `mapped` or `auto`. `mapped` leaves images
            on disk and reads them when they are indexed. For a compressed log or a bag, `mapped`
            writes an uncompressed copy of the images beside it once. `auto` is `mapped` if the
            images would take more than half of the free memory, else `memory`.
        threads: Number of threads that read chunks of a file.
        follow: Whether the logs are still being written: the function waits for the first finished
            episode, and `Dataset.grow` reads episodes that end later.
        weights: Weight of each path of `data` in training, at least 0: transitions of weight 2 are
            drawn twice as often as those of weight 1, the default. See `Dataset.weights`.

    Raises:
        LogError: A file is missing, not an MCAP file, damaged, or has no finished episode.
        SpaceError: The logs' spaces differ.
        UnknownNameError: There is no such format or storage of images.
        UsageError: A column or an episode does not exist, the mapping does not fit the bag, an
            option does not fit the data, or a file has two weights.
        MissingExtraError: A mapping needs the packages of the `bags` extra.
    """
    if images not in STORAGES:
        raise UnknownNameError("storage of images", str(images), STORAGES)
    names = _names(data)
    each = _path_weights(weights, len(names))
    selecting = {"columns": columns, "episodes": episodes, "follow": follow or None}
    reading = {"one_episode": one_episode or None, "dones": dones}
    if mapping is not None:
        _refuse("logs", "a mapping", **selecting, weights=weights)
        _refuse("datasets of other tools", "a mapping", **reading)
        dataset = read_mapped(names, mapping, trust_code, definitions, images)
        for problem in (*dataset.origin.report.left_out, *dataset.origin.report.images):
            warnings.warn(str(problem), stacklevel=2)
        return dataset
    forms = [other_format(name) if format is None else format_named(format) for name in names]
    given = list(zip(names, each, forms, strict=True))
    others = [(name, weight, form) for name, weight, form in given if form is not None]
    if others:
        what = f"the format {others[0][-1].name}"
        _refuse("logs", what, **selecting)
        _refuse("logs and bags", what, images=None if images != "mapped" else images)
    else:
        _refuse("datasets of other tools", "logs", **reading)
    if follow:
        _refuse(
            "finished logs", "growing ones", columns=columns, episodes=episodes, weights=weights
        )
        return GrowingLogs(names, images=images, threads=threads).dataset
    parts = []
    if len(others) < len(names) or not names:
        logs = [name for name, _, form in given if form is None]
        options: dict[str, Any] = {"columns": columns, "episodes": episodes, "images": images}
        options["weights"] = [weight for _, weight, form in given if form is None]
        try:
            parts.append(open_logs(logs, threads=threads, **options))
        except NotMcapError as error:
            if BAG_HINT in str(error):
                raise
            raise NotMcapError(
                f"{error}, nor is it a dataset of one of the formats"
                f" {', '.join(form.name for form in every_format())}"
            ) from error
    for name, weight, form in others:
        part = read_format(name, form, lossy=lossy, **reading)
        parts.append(part.with_weights(np.full(len(part.weights), weight)))
    return Dataset.concatenate(parts)


def _refuse(whose: str, what: str, **options: Any) -> None:
    """Raise UsageError if one of the options is given, which are for other data than `what`."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise UsageError(f"these options are for {whose}, not for {what}: {', '.join(given)}")


def _names(data: Paths) -> list[str | Path]:
    return [data] if isinstance(data, str | Path) else list(data)


def _path_weights(weights: Sequence[float] | None, count: int) -> list[float]:
    """Return a valid weight for each of `count` paths; by default, all are 1."""
    given = [1.0] * count if weights is None else list(map(float, weights))
    if len(given) != count or not all(0 <= weight < np.inf for weight in given):
        raise UsageError(f"weights must be {count} numbers of at least 0, one for each path")
    return given


def read_mapped(
    data: Paths,
    mapping: MappingFile,
    trust_code: bool = False,
    definitions: Definitions = (),
    images: Storage = "auto",
    to_label: bool = False,
) -> Dataset:
    """Read a bag by a mapping, as `open_data` does, but without warnings on what is left out."""
    import_extra("pydantic", "bags")
    from mcaprl.recorder.mapping.read import read_bag

    source, changes = mapping if isinstance(mapping, ChangedMapping) else (mapping, {})
    return read_bag(
        data,
        source,
        changes=changes,
        trust_code=trust_code,
        images=images,
        definitions=definitions,
        to_label=to_label,
    ).dataset


def labeled_recording(
    data: str | Path, mapping: MappingFile, trust_code: bool, definitions: Definitions
) -> Labeled:
    """Return the episodes of a bag's only recording, by a mapping, to which labels belong."""
    dataset = read_mapped(data, mapping, trust_code, definitions, to_label=True)
    found: Sequence[Labeled] = dataset.origin.labeled
    if len(found) != 1:
        names = ", ".join(str(one.path) for one in found[:_LISTED])
        raise UsageError(f"labels are of one recording: name one of the {len(found)}: {names}")
    return found[0]


def changed_mapping(
    mapping: str | Path | Mapping[str, Any] | None, changes: Mapping[str, Any]
) -> MappingFile | None:
    """Return a mapping with other values of some keys."""
    if not changes:
        return mapping
    if mapping is None:
        raise UsageError(f"{', '.join(changes)} needs a mapping")
    return ChangedMapping(mapping, changes)


def opened(data: Source, *, weighted: bool = False, **options: Any) -> Dataset:
    """Return a dataset, or the result of a function, or open names by the options of `open_data`.

    With `weighted`, a name may end with the weight of its logs, such as `:2`.
    """
    if isinstance(data, Dataset):
        return data
    if callable(data):
        return data()
    names, weights = split_weights(data) if weighted else (data, None)
    return open_data(names, weights=weights, **options)


def logs_of(data: Data, *, weighted: bool = False) -> dict[Path, float]:
    """Return the absolute paths and the weights of logs, for processes that read them again.

    With `weighted`, a name may end with the weight of its logs, such as `:2`.
    """
    if isinstance(data, Dataset):
        if not data.origin.logs:
            raise UsageError(
                "workers read logs: pass their paths, or a dataset that `open` returns for logs"
                " without a mapping and `follow`; `save` writes any other dataset as a log"
            )
        return dict(data.origin.logs)
    names, weights = split_weights(data) if weighted else (_names(data), None)
    for name in names:
        if other_format(name) is not None:
            raise UsageError(f"{name} is not a log: convert it first (mcaprl convert)")
    return {path.absolute(): weight for path, weight in weighted_logs(names, weights).items()}


def split_weights(data: Paths) -> tuple[list[str], list[float] | None]:
    """Split names such as `logs/a.mcap:2` into paths and weights; None if all weights are 1."""
    pairs = [_split_weight(str(name)) for name in _names(data)]
    weights = [weight for _, weight in pairs]
    return [name for name, _ in pairs], None if set(weights) <= {1.0} else weights


def _split_weight(part: str) -> tuple[str, float]:
    """Split a name and its weight, unless a file with the whole name exists."""
    name, colon, number = part.rpartition(":")
    if not colon or Path(part).exists():
        return part, 1.0
    try:
        weight = float(number)
    except ValueError:
        return part, 1.0
    if not 0 <= weight < np.inf:
        raise UsageError(f"{part}: a weight must be a number of at least 0")
    return name, weight


def named(data: Data) -> str:
    """Return the name of the data in tables.

    >>> named("lane.mcap"), named(["a.mcap", "b.mcap"])
    ('lane.mcap', 'a.mcap, b.mcap')
    """
    paths = data.sources if isinstance(data, Dataset) else data
    return str(paths) if isinstance(paths, str | Path) else ", ".join(map(str, paths))
