"""Infos of the episode that is being recorded."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mcaprl.recorder.format.log_writer import InfoTopics, flat_infos, info_array
from mcaprl.recorder.record.array_types import as_array, is_other_array


class EpisodeInfos:
    """Collector of the infos of one episode, which are written at its end."""

    def __init__(self, topics: InfoTopics, names: bool | Sequence[str]) -> None:
        """Begin without infos."""
        self._topics = topics
        one = [names] if isinstance(names, str) else names
        self._names = None if isinstance(one, bool) else tuple(one)
        self._values: dict[str, tuple[list[int], list[Any]]] = {}
        self._twice: set[str] = set()

    def begin(self, info: Mapping[str, Any]) -> None:
        """Drop the infos of earlier episodes, and store the info that `reset` returned."""
        self._values.clear()
        self.add(0, info)

    def add(self, step: int, info: Mapping[str, Any]) -> None:
        """Store the info that came with observation `step` of the episode."""
        for name, value in flat_infos(info):
            if self._names is None or any(
                name == one or name.startswith(f"{one}.") for one in self._names
            ):
                steps, values = self._values.setdefault(name, ([], []))
                if steps and steps[-1] == step:
                    self._twice.add(name)
                steps.append(step)
                values.append(_copied(value))

    def end(self, length: int, start_ns: int, step_ns: int) -> None:
        """Write the infos of the episode.

        Args:
            length: Number of recorded transitions; infos of later steps are not written.
            start_ns: log_time of the first observation.
            step_ns: Time between two observations, nanoseconds.
        """
        found, refused = {}, self._topics.refused
        for name, (steps, values) in self._values.items():
            count = sum(step <= length for step in steps)
            if not count:
                continue
            array = info_array(values[:count])
            if name in self._twice:
                refused[name] = "two entries of the info have this name"
            elif array is None:
                refused[name] = (
                    "a log stores flags, texts, integers, float32, float64, and arrays of one"
                    " shape, but not a mixture of these"
                )
            else:
                found[name] = ([start_ns + step * step_ns for step in steps[:count]], array)
        self._values.clear()
        self._topics.write(found)

    def warn(self) -> None:
        """Warn once about each info that the log cannot store; call this after `end`."""
        for name, why in self._topics.refused.items():
            if name not in self._topics.warned:
                self._topics.warned.add(name)
                warnings.warn(f"the info '{name}' is not recorded: {why}", stacklevel=5)


def _copied(value: Any) -> Any:
    """Copy arrays and lists, because the environment may change them later."""
    if is_other_array(value):
        value = as_array(value)
        return value.copy() if value.ndim else value[()]
    if isinstance(value, np.ndarray):
        return value.copy()
    return [_copied(each) for each in value] if isinstance(value, list | tuple) else value


def info_of(infos: Any, number: int, count: int) -> dict[str, Any]:
    """Return the info of one of `count` environments from the infos of a vector environment.

    Gymnasium stores the values of all environments in one array per info. The mask `_name` selects
    the environments that returned the info `name`. A value with another length is the info of
    each environment. Some vector environments return a sequence with one dict for each
    environment.
    """
    if not isinstance(infos, Mapping):
        one = infos[number] if len(infos) == count else None
        return dict(one) if isinstance(one, Mapping) else {}
    found: dict[str, Any] = {}
    for name, value in infos.items():
        mask = infos.get(f"_{name}")
        is_own = name in ("final_obs", "final_observation", "final_info") or name.startswith("_")
        if is_own or (mask is not None and not mask[number]):
            continue
        if isinstance(value, Mapping):
            inner = info_of(value, number, count)
            if inner:
                found[name] = inner
        elif isinstance(value, np.ndarray | list | tuple):
            found[name] = value[number] if np.shape(value)[:1] == (count,) else value
    return found


def final_info(infos: dict[str, Any]) -> Any:
    """Return the infos of the episodes that ended in same-step mode."""
    found = infos.get("final_info")
    return {} if found is None else found


def info_reason(infos: Any, number: int) -> Any:
    """Return the reason in the infos of one environment; None if there is none."""
    if not isinstance(infos, Mapping):
        # Some vector environments return one dict for each environment.
        one = infos[number] if isinstance(infos, np.ndarray | list | tuple) else None
        return one.get("reason") if isinstance(one, Mapping) else None
    found = infos.get("reason")
    return found[number] if isinstance(found, np.ndarray | list | tuple) else None
