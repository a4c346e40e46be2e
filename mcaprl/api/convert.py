"""Conversion between logs, other robots' bags and other tools' datasets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mcaprl.api.ranges import check_least
from mcaprl.errors import UsageError, import_extra
from mcaprl.files import check_target
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.format_registry import VIDEO_NOTE, target_format, write_format
from mcaprl.recorder.dataset.labels import carry_labels, labels_of
from mcaprl.recorder.source import Definitions, Paths, Source, opened
from mcaprl.storage.remote import check_upload, upload_all

if TYPE_CHECKING:
    from mcaprl.recorder.mapping.summary import MappingReport

_SHOWN = 5  # Number of transitions that a dry run shows


@dataclass(frozen=True)
class Conversion:
    """Result of `convert`.

    Attributes:
        dataset: Transitions that were read.
        report: Summary of the data that the mapping used and dropped; None without a mapping.
        out: Path of the written file or folder; None if nothing was written.
        lost: One sentence for each kind of data that the target format cannot store.
        videos: One sentence for each video: whether its packets were copied, and why not.
    """

    dataset: Dataset
    report: MappingReport | None
    out: Path | None
    lost: list[str] = field(default_factory=list)
    videos: list[str] = field(default_factory=list)

    def first(self) -> list[dict[str, Any]]:
        """Return the first five transitions, as JSON types."""
        data, count = self.dataset, min(_SHOWN, len(self.dataset))
        batch = data.batch(np.arange(count))
        return [
            {
                "observation": _plain(batch.observations, k),
                "action": batch.actions[k].tolist(),
                "reward": float(batch.rewards[k]),
                "terminated": bool(batch.terminated[k]),
                "truncated": bool(batch.truncated[k]),
            }
            for k in range(count)
        ]

    def first_table(self) -> tuple[list[str], list[list[str]]]:
        """Return the columns and rows of a table of the first five transitions.

        A vector has a column for each element. Numbers have four significant digits.
        """
        data, count = self.dataset, min(_SHOWN, len(self.dataset))
        batch = data.batch(np.arange(count))
        parts = batch.observations
        parts = _flat(parts) if isinstance(parts, dict) else {"": parts}
        names = list(data.observation_names or (self.report.elements if self.report else ()))
        table: dict[str, list[str]] = {"step": [str(k) for k in range(count)]}
        for key, values in parts.items():
            if values.ndim > 2:
                table[key or "image"] = [_image_text(row) for row in values]
                continue
            flat = values.reshape(count, -1)
            width = flat.shape[1]
            labels = names if len(names) == width else _labels(key or "state", width)
            table |= {label: [f"{x:.4g}" for x in flat[:, k]] for k, label in enumerate(labels)}
        table["action"] = [self._action_text(action) for action in batch.actions]
        table["reward"] = [f"{reward:.4g}" for reward in batch.rewards]
        ends = zip(batch.terminated, batch.truncated, strict=True)
        table["end"] = ["terminated" if t else "truncated" if u else "" for t, u in ends]
        return list(table), [list(row) for row in zip(*table.values(), strict=True)]

    def _action_text(self, action: Any) -> str:
        if np.ndim(action):
            return ", ".join(f"{x:.4g}" for x in np.ravel(action))
        return self.dataset.action_names.get(int(action), str(action))

    def run_table(self) -> tuple[list[str], list[list[str]]]:
        """Return the columns and rows of a table of the recordings; no rows if there is only one.

        The cell of a quantity has the share of the steps without a value, and the median and the
        largest age in seconds.
        """
        runs = [] if self.report is None else self.report.runs
        if len(runs) < 2:
            return [], []
        names = list(runs[0].fields)
        columns = ["recording", "clock steps", "steps", "episodes", *names]
        rows = [
            [str(k), str(run.clock_steps), str(run.steps), str(run.episodes)]
            + [run.fields[name].short for name in names]
            for k, run in enumerate(runs)
        ]
        return columns, rows

    def to_json(self) -> dict[str, Any]:
        """Return what `convert --json` prints."""
        out = None if self.out is None else str(self.out)
        report = {} if self.report is None else self.report.to_json()
        return {
            **report,
            "first": self.first(),
            "out": out,
            "lost": self.lost,
            "videos": self.videos,
        }


def convert(
    data: Source,
    out: str | Path | None,
    *,
    to: str | None = None,
    lossy: bool = False,
    overwrite: bool = False,
    upload: str | None = None,
    keep_topics: bool | str | Sequence[str] | None = None,
) -> Conversion:
    """Read logs, a bag, or a dataset of another tool, and write a log or a dataset.

    Args:
        data: Logs or a dataset of another tool; for bags and other options, what
            `mcaprl.open(..., mapping=...)` returns, or a function that returns it.
        out: Path of the log or dataset; None to write nothing.
        to: Name of the format to write; default: a log if `out` ends with .mcap, otherwise the
            format with the suffix of `out`.
        lossy: Whether data that the format, or a log, cannot store may be dropped or converted.
        overwrite: Whether an existing file or folder is replaced.
        upload: URL to which the written file is copied when it is complete.
        keep_topics: Topics of the bag that are copied to the log, beside `/rl/*`: True for all, or
            names and patterns such as `/camera/*`; None for those of the mapping's `keep`, False
            for none.

    Raises:
        UsageError: The format to write is not clear, or topics are kept without a bag or a log.
        UnknownNameError: The bag has no such topic.
        LogError: The source cannot be read, it has no episode, or `out` cannot be written.
        SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
        OutputExistsError: `out` exists.
        MissingExtraError: The packages of an extra are not installed.
    """
    is_log = out is not None and to is None and Path(out).suffix == ".mcap"
    form = None if out is None or is_log else target_format(out, to)
    if keep_topics and not is_log:
        raise UsageError("the topics of a bag are kept in a log: name an output that ends in .mcap")
    if out is not None and is_log:
        check_target(Path(out), overwrite=overwrite)
    if upload is not None:
        check_upload(upload, overwrite=overwrite)
        if out is None or (form is not None and not form.suffix):
            raise UsageError("upload copies one file: choose a file, not a folder, as the output")
    dataset = opened(data, lossy=lossy)
    notes: list[str] = []
    if out is not None and form is not None:
        notes = write_format(dataset, out, form, lossy=lossy, overwrite=overwrite)
    elif out is not None:
        labels = labels_of(dataset) if dataset.origin.labels else None
        dataset.save(out, overwrite=overwrite, keep_topics=keep_topics)
        carry_labels(labels, np.arange(len(dataset.episodes)), Path(out))
    if upload is not None and out is not None:
        upload_all([Path(out)], upload)
    videos = [each.removeprefix(VIDEO_NOTE) for each in notes if each.startswith(VIDEO_NOTE)]
    lost = [each for each in notes if not each.startswith(VIDEO_NOTE)]
    target = None if out is None else Path(out)
    return Conversion(dataset, dataset.origin.report, target, lost, videos)


def suggest_mapping(data: Paths, *, bins: int | None = None, definitions: Definitions = ()) -> str:
    """Return a commented draft of a mapping file, based on the topics and messages of a bag.

    The draft is tried: quantities that prevent all episodes become comments. A warning, which is
    also a comment of the draft, says if there is no command, or still no episode.

    Args:
        data: MCAP files, rosbag2 folders and databases, ROS 1 bags, or folders of these.
        bins: Number of bins of each element of a continuous command, with similar numbers of
            commands in each bin; default: a Box action with limits from the commands.
        definitions: Files and folders with definitions of ROS types that the bag lacks; see
            docs/bags.md.

    Raises:
        LogError: The bag cannot be read, or has no topic that can be observed.
        UsageError: `bins` is below 2, or there is no such file or folder of definitions.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    import_extra("pydantic", "bags")
    from contextlib import closing

    from mcaprl.recorder.bags.bag import open_bag
    from mcaprl.recorder.mapping.draft import suggested

    if bins is not None:
        check_least(2, bins=bins)
    with closing(open_bag(data, definitions=definitions)) as found:
        return suggested(found, bins)


def _flat(parts: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the arrays of a Dict observation by their path."""
    found: dict[str, Any] = {}
    for name, part in parts.items():
        path = f"{prefix}{name}"
        found |= _flat(part, f"{path}/") if isinstance(part, dict) else {path: part}
    return found


def _labels(name: str, count: int) -> list[str]:
    return [name] if count == 1 else [f"{name}_{k}" for k in range(count)]


def _image_text(image: Any) -> str:
    shape = "x".join(map(str, image.shape))
    return f"{image.dtype} {shape}, mean {image.mean():.4g}"


def _plain(observation: Any, k: int) -> Any:
    """Return observation k of a batch as JSON types; images are replaced by a description."""
    if isinstance(observation, dict):
        return {name: _plain(part, k) for name, part in observation.items()}
    row = observation[k]
    if row.ndim < 2:
        return row.tolist()
    return f"{row.dtype} image {list(row.shape)}, mean {row.mean():.4g}"
