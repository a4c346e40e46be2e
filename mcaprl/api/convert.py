"""Conversion of another robot's bag into a log, and a mapping to begin with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mcaprl.api.data import MappingFile, Paths, mapped
from mcaprl.errors import UsageError
from mcaprl.files import check_target
from mcaprl.recorder.dataset.dataset import Dataset

if TYPE_CHECKING:
    from mcaprl.recorder.mapping.summary import MappingReport

_SHOWN = 5
"""Number of transitions of a dry run."""


@dataclass(frozen=True)
class Conversion:
    """Result of `convert`.

    Attributes:
        dataset: Transitions of the bag.
        report: What the mapping found and left out.
        out: Path of the log; None if none was written.
    """

    dataset: Dataset
    report: MappingReport
    out: Path | None

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

    def to_json(self) -> dict[str, Any]:
        """Return what `convert --json` prints."""
        out = None if self.out is None else str(self.out)
        return {**self.report.to_json(), "first": self.first(), "out": out}


def convert(
    bag: Paths,
    out: str | Path | None,
    *,
    mapping: MappingFile,
    trust_code: bool = False,
    overwrite: bool = False,
) -> Conversion:
    """Read another robot's bag by a mapping, and write its transitions as a log.

    Args:
        bag: MCAP files, rosbag2 folders and databases, or ROS 1 bags.
        out: Path of the log; None to write none.
        mapping: Mapping file, or its keys and values; see docs/bags.md.
        trust_code: Whether the mapping may name a Python function, which is imported.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: The mapping does not fit the bag; the message names file, line and key.
        LogError: The bag cannot be read, or has no episode; or `out` cannot be written.
        OutputExistsError: `out` exists.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    path = None if out is None else Path(out)
    if path is not None:
        if path.suffix != ".mcap":
            raise UsageError(f"{path}: the name of a log ends with .mcap")
        check_target(path, overwrite=overwrite)
    dataset, report = mapped(bag, mapping, trust_code=trust_code)
    if path is not None:
        dataset.save(path, overwrite=overwrite)
    return Conversion(dataset, report, path)


def suggest_mapping(bag: Paths) -> str:
    """Return a commented mapping file to begin with, from the topics and rates of a bag.

    Args:
        bag: MCAP files, rosbag2 folders and databases, or ROS 1 bags.

    Raises:
        LogError: The bag cannot be read.
        MissingExtraError: The packages of the `bags` extra are not installed.
    """
    from contextlib import closing

    from mcaprl.recorder.bags.bag import open_bag
    from mcaprl.recorder.mapping.suggest import suggested

    with closing(open_bag(bag)) as found:
        return suggested(found)


def _plain(observation: Any, k: int) -> Any:
    """Return an observation as JSON types; an image as its shape and mean."""
    if isinstance(observation, dict):
        return {name: _plain(part, k) for name, part in observation.items()}
    row = observation[k]
    if row.ndim < 2:
        return row.tolist()
    return f"{row.dtype} image {list(row.shape)}, mean {row.mean():.4g}"
