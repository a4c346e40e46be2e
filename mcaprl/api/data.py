"""Logs and bags as arguments of the public API."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mcaprl.errors import BAG_HINT, NotMcapError, UnknownNameError, UsageError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.image_cache import STORAGES, Storage
from mcaprl.recorder.dataset.open import Episodes, open_logs

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.format_registry import Format
    from mcaprl.recorder.mapping.read import MappedBag

Paths = str | Path | Sequence[str | Path]
"""A file, a folder or a glob of logs, or several of them."""
MAPPING_NAME = "mapping.json"
"""Name of the file in a run folder that contains a copy of the mapping used for training."""
Data = Dataset | Paths
"""A dataset, or paths of logs."""


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
) -> Dataset:
    """Read logs, a dataset of another tool, or a bag that a mapping describes.

    The CRCs of all chunks that are read are checked. If a log was cut off or is still being
    written, its finished episodes are read, with a warning. If there are several logs, those
    without a finished episode are skipped, with a warning.

    Args:
        data: A file, a folder of `.mcap` files, its `manifest.json`, a glob, or a sequence of
            these. The logs must have the same spaces; their episodes are concatenated in the order
            of the files. `data` can also be one dataset of another tool; see docs/formats.md. With
            a mapping, `data` can be MCAP files of any writer, rosbag2 folders and databases, or ROS
            1 bags.
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

    Raises:
        LogError: A file is missing, not an MCAP file, damaged, or has no finished episode.
        SpaceError: The logs' spaces differ.
        UnknownNameError: There is no such format or storage of images.
        UsageError: A column or an episode does not exist, the mapping does not fit the bag, or an
            option does not fit the data.
        MissingExtraError: A mapping needs the packages of the `bags` extra.
    """
    if images not in STORAGES:
        raise UnknownNameError("storage of images", str(images), STORAGES)
    other = None if mapping is not None else _other_format(data, format)
    reading = {"one_episode": one_episode, "dones": dones, "lossy": lossy}
    if other is None and (one_episode or dones):
        raise UsageError("one_episode and dones are for datasets of other tools")
    if mapping is None and other is None:
        try:
            return open_logs(
                data, columns=columns, episodes=episodes, images=images, threads=threads
            )
        except NotMcapError as error:
            from mcaprl.recorder.dataset.format_registry import every_format

            if BAG_HINT in str(error):
                raise
            raise NotMcapError(
                f"{error}, nor is it a dataset of one of the formats"
                f" {', '.join(form.name for form in every_format())}"
            ) from error
    if columns is not None or episodes is not None:
        what = f"the format {other.name}" if other is not None else "a mapping"
        raise UsageError(f"columns and episodes are for logs, not for {what}")
    if other is not None:
        if images == "mapped":
            raise UsageError(
                f"mapped images are for logs and bags, not for the format {other.name}"
            )
        from mcaprl.recorder.dataset.format_registry import read_format

        one = _only(data)
        if one is None:
            raise UsageError(f"only logs may have several paths: pass one {other.name} dataset")
        return read_format(one, other, **reading)
    assert mapping is not None
    found = mapped(data, mapping, trust_code=trust_code, definitions=definitions, images=images)
    for problem in (*found.report.left_out, *found.report.images):
        warnings.warn(str(problem), stacklevel=2)
    return found.dataset


def _only(data: Paths) -> str | Path | None:
    """Return the path if there is exactly one, else None."""
    if isinstance(data, str | Path):
        return data
    return data[0] if len(data) == 1 else None


def _other_format(data: Paths, name: str | None) -> Format | None:
    """Return the format of another tool's dataset; None for logs."""
    one = _only(data)
    if name is None and (one is None or str(one).endswith(".mcap")):
        return None
    from mcaprl.recorder.dataset.format_registry import format_named, other_format

    if name is not None:
        return format_named(name)
    return None if one is None else other_format(one)


def mapped(
    data: Paths,
    mapping: MappingFile,
    *,
    trust_code: bool = False,
    images: Storage = "auto",
    definitions: Definitions = (),
) -> MappedBag:
    """Read a bag by a mapping; raise the same errors as `open_data`."""
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
    )


def mapping_tree(mapping: MappingFile) -> dict[str, Any]:
    """Return the keys and values of a mapping, with defaults, as JSON types."""
    from mcaprl.recorder.mapping.config import load_mapping

    source, changes = mapping if isinstance(mapping, ChangedMapping) else (mapping, {})
    found = load_mapping(source)[0].model_copy(update=dict(changes))
    return found.model_dump(mode="json", by_alias=True)


def changed_mapping(
    mapping: str | Path | Mapping[str, Any] | None, changes: Mapping[str, Any]
) -> MappingFile | None:
    """Return a mapping with other values of some keys.

    Raises:
        UsageError: There are changes, but no mapping.
    """
    if not changes:
        return mapping
    if mapping is None:
        raise UsageError(f"{', '.join(changes)} needs a mapping")
    return ChangedMapping(mapping, changes)


def opened(
    data: Data,
    *,
    mapping: MappingFile | None = None,
    trust_code: bool = False,
    definitions: Definitions = (),
    threads: int = 1,
) -> Dataset:
    """Return a dataset unchanged, or read it from paths with `open_data`."""
    if isinstance(data, Dataset):
        return data
    return open_data(
        data, mapping=mapping, trust_code=trust_code, definitions=definitions, threads=threads
    )


def named(data: Data) -> str:
    """Return the name of the data in tables.

    >>> named("lane.mcap"), named(["a.mcap", "b.mcap"])
    ('lane.mcap', 'a.mcap, b.mcap')
    """
    paths = data.sources if isinstance(data, Dataset) else data
    return str(paths) if isinstance(paths, str | Path) else ", ".join(map(str, paths))
