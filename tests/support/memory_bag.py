"""A bag in memory, for tests of the mapping with numbers worked by hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.bags.bag import Failure, Stream, TopicInfo
from mcaprl.recorder.bags.source import Definition
from mcaprl.recorder.bags.values import ABSENT, column_of, value_at

SECOND_NS = 10**9


class MemoryBag:
    """Bag whose topics are given as times in seconds and columns."""

    paths: tuple[Path, ...] = (Path("memory.bag"),)
    recordings: tuple[int, ...] = (0,)
    cut: tuple[Path, ...] = ()

    def __init__(
        self,
        topics: Mapping[str, tuple[Sequence[float], Mapping[str, Any]]],
        kinds: Mapping[str, str] | None = None,
        types: Mapping[str, str] | None = None,
    ) -> None:
        """Store the `(times_s, columns)` of each topic.

        A column of lists with different lengths, or of dicts and lists of dicts, becomes an array
        with dtype `object`. Paths such as `motors[3].q` are read from it.
        """
        self._times: dict[str, NDArray[np.int64]] = {}
        self._columns: dict[str, dict[str, NDArray[Any]]] = {}
        self._places: dict[str, NDArray[np.int64]] = {}
        self.topics: dict[str, TopicInfo] = {}
        for name, (times_s, columns) in topics.items():
            times_ns = np.rint(np.array(times_s, np.float64) * SECOND_NS).astype(np.int64)
            self._times[name] = times_ns
            self._columns[name] = {key: _column(column) for key, column in columns.items()}
            fields = {key: (kinds or {}).get(f"{name}.{key}", "float64") for key in columns}
            ends = (int(times_ns.min()), int(times_ns.max())) if len(times_ns) else (0, 0)
            kind = (types or {}).get(name, "memory")
            self.topics[name] = TopicInfo(name, kind, "cdr", len(times_ns), *ends, fields, {})

    @classmethod
    def together(cls, *bags: MemoryBag) -> MemoryBag:
        """Return the bags as separate recordings; all bags must have the same topics and fields."""
        found = cls({})
        found.paths = tuple(Path(f"{k}.bag") for k in range(len(bags)))
        found.recordings = tuple(range(len(bags)))
        for name, info in bags[0].topics.items():
            parts = [bag._times[name] for bag in bags]
            found._times[name] = np.concatenate(parts)
            found._columns[name] = {
                key: np.concatenate([bag._columns[name][key] for bag in bags])
                for key in bags[0]._columns[name]
            }
            found._places[name] = np.concatenate(
                [
                    [(k, row) for row in range(len(part))]
                    for k, part in enumerate(parts)
                    if len(part)
                ]
            )
            found.topics[name] = dataclasses.replace(info, count=len(found._times[name]))
        return found

    def again(self) -> MemoryBag:
        return self

    def times(self, topic: str) -> NDArray[np.int64]:
        return self._times[topic]

    def places(self, topic: str) -> NDArray[np.int64]:
        rows = np.arange(len(self._times[topic]))
        return self._places.get(topic, np.column_stack([np.zeros_like(rows), rows]))

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        chosen = np.arange(len(self._times[topic])) if rows is None else rows
        columns, absent = {}, {}
        for name in fields:
            column = self._columns[topic].get(name)
            if column is None:
                every = self._columns[topic]
                values = [
                    value_at({key: each[row] for key, each in every.items()}, name)
                    for row in range(len(self._times[topic]))
                ]
                column = column_of(values, "")
                absent[name] = np.array([value is ABSENT for value in values], bool)[chosen]
            columns[name] = column[chosen]
        return Stream(self._times[topic][chosen], columns, chosen, (), absent)

    def definition(self, topic: str) -> Definition:
        return Definition(self.topics[topic].type_name, "cdr")

    def failures(self, topic: str) -> Iterator[Failure]:
        return iter(())

    def close(self) -> None:
        """Do nothing."""


def _column(values: Any) -> NDArray[Any]:
    if isinstance(values, np.ndarray):
        return values
    flat = [item for value in values for item in (value if isinstance(value, list) else [value])]
    lengths = {len(value) if isinstance(value, list) else -1 for value in values}
    if all(isinstance(item, int | float) for item in flat) and len(lengths) < 2:
        return np.array(values, np.float64)
    return np.fromiter(values, object, len(values))
