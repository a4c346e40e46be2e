"""Origin of a dataset: what is known of it beyond its transitions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Origin:
    """Files and mapping of a dataset.

    Attributes:
        sources: Files that the data was read from.
        logs: Absolute path and weight of each log if the dataset has all of their episodes
            unchanged, else empty. Other processes read the data again from these logs.
        mapping: Keys and values of the mapping that the data was read by, as JSON types.
        report: Report of the mapping on what was read and what was left out.
        grow: Function that returns the data with the episodes that have ended since; None if the
            logs are not followed.
    """

    sources: tuple[Path, ...] = ()
    logs: tuple[tuple[Path, float], ...] = ()
    mapping: Mapping[str, Any] | None = None
    report: Any = None
    grow: Callable[[], Any] | None = None

    @classmethod
    def common(cls, origins: Sequence[Origin]) -> Origin:
        """Return the origin of concatenated datasets."""
        mappings = [one.mapping for one in origins]
        return cls(
            tuple(path for one in origins for path in one.sources),
            tuple(log for one in origins for log in one.logs if all(o.logs for o in origins)),
            mappings[0] if all(mapping == mappings[0] for mapping in mappings) else None,
        )

    def changed(self) -> Origin:
        """Return the origin of a dataset with other episodes or values."""
        return Origin(self.sources, mapping=self.mapping, report=self.report)
