"""A bag in memory, for tests of the mapping with numbers worked by hand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.recorder.bags.bag import Failure, Stream, TopicInfo

SECOND_NS = 10**9


class MemoryBag:
    """Bag whose topics are given as times in seconds and columns."""

    paths: tuple[Path, ...] = (Path("memory.bag"),)
    cut: tuple[Path, ...] = ()

    def __init__(
        self,
        topics: Mapping[str, tuple[Sequence[float], Mapping[str, Any]]],
        kinds: Mapping[str, str] | None = None,
        types: Mapping[str, str] | None = None,
    ) -> None:
        """Store the `(times_s, columns)` of each topic.

        A column of lists with different lengths becomes an array with dtype `object`.
        """
        self._times: dict[str, NDArray[np.int64]] = {}
        self._columns: dict[str, dict[str, NDArray[Any]]] = {}
        self.topics: dict[str, TopicInfo] = {}
        for name, (times_s, columns) in topics.items():
            times_ns = np.rint(np.array(times_s, np.float64) * SECOND_NS).astype(np.int64)
            self._times[name] = times_ns
            self._columns[name] = {key: _column(column) for key, column in columns.items()}
            fields = {key: (kinds or {}).get(f"{name}.{key}", "float64") for key in columns}
            ends = (int(times_ns.min()), int(times_ns.max())) if len(times_ns) else (0, 0)
            kind = (types or {}).get(name, "memory")
            self.topics[name] = TopicInfo(name, kind, "cdr", len(times_ns), *ends, fields, {})

    def times(self, topic: str) -> NDArray[np.int64]:
        return self._times[topic]

    def places(self, topic: str) -> NDArray[np.int64]:
        rows = np.arange(len(self._times[topic]))
        return np.column_stack([np.zeros_like(rows), rows])

    def read(
        self, topic: str, fields: Sequence[str], rows: NDArray[np.int64] | None = None
    ) -> Stream:
        chosen = slice(None) if rows is None else rows
        columns = {name: self._columns[topic][name][chosen] for name in fields}
        return Stream(self._times[topic][chosen], columns)

    def failures(self, topic: str) -> Iterator[Failure]:
        return iter(())

    def close(self) -> None:
        """Do nothing."""


def _column(values: Any) -> NDArray[Any]:
    if isinstance(values, np.ndarray):
        return values
    is_text = bool(values) and isinstance(values[0], str | bytes)
    is_list = bool(values) and isinstance(values[0], list) and len(set(map(len, values))) > 1
    if is_text or is_list:
        column = np.empty(len(values), object)
        column[:] = values
        return column
    return np.array(values, np.float64)
