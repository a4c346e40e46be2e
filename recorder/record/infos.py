"""Infos of the episode that is being recorded."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mcaprl.recorder.format.info_topics import InfoTopics, flat_infos, info_array
from mcaprl.recorder.format.log_writer import LogTopics


class EpisodeInfos:
    """Collector of the infos of one episode, which are written at its end."""

    def __init__(self, log: LogTopics, names: bool | Sequence[str]) -> None:
        """Begin without infos.

        Args:
            log: Log to write.
            names: Whether infos are recorded, or the names of those that are; `episode` includes
                `episode.r`.
        """
        self._topics = InfoTopics(log)
        self._names = None if isinstance(names, bool) else tuple(names)
        self._values: dict[str, tuple[list[int], list[Any]]] = {}
        self._warned: set[str] = set()

    def begin(self, info: Mapping[str, Any]) -> None:
        """Store the info that `reset` returned, in place of those of an earlier episode."""
        self._values.clear()
        self.add(0, info)

    def add(self, step: int, info: Mapping[str, Any]) -> None:
        """Store the info that came with observation `step` of the episode."""
        for name, value in flat_infos(info):
            if self._names is None or any(
                name == one or name.startswith(f"{one}.") for one in self._names
            ):
                steps, values = self._values.setdefault(name, ([], []))
                steps.append(step)
                # The environment may change its array later.
                values.append(value.copy() if isinstance(value, np.ndarray) else value)

    def end(self, length: int, start_ns: int, step_ns: int) -> None:
        """Write the infos of the episode, and warn of those that a log cannot store.

        Args:
            length: Number of recorded transitions; infos of later observations are left out.
            start_ns: log_time of the first observation.
            step_ns: Time between two observations, nanoseconds.
        """
        found, refused = {}, dict[str, str]()
        for name, (steps, values) in self._values.items():
            count = sum(step <= length for step in steps)
            if not count:
                continue
            array = info_array(values[:count])
            if array is None:
                refused[name] = "it is neither number, flag, text nor an array of one shape"
            else:
                found[name] = ([start_ns + step * step_ns for step in steps[:count]], array)
        self._values.clear()
        if found:
            self._topics.write(found)
        for name, why in (refused | self._topics.refused).items():
            if name not in self._warned:
                self._warned.add(name)
                warnings.warn(f"the info '{name}' is not recorded: {why}", stacklevel=5)
