"""The table of docs/formats.md. Each cell is the result of a conversion to a format and back.

MCAPRL_WRITE_TABLE=1 pytest tests/recorder/dataset/formats/test_table.py     # writes the table
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import SpaceError
from mcaprl.recorder.dataset.format_registry import FACTS, FORMATS
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.metadata import ActionCommands, LogMetadata

for _package in ("h5py", "pyarrow", "PIL", "stable_baselines3"):
    pytest.importorskip(_package, reason="needs the extras interop, tables, video and online")

_PAGE = Path(__file__).parents[4] / "docs" / "formats.md"
_BEGIN, _END = "<!-- kept -->\n", "<!-- /kept -->\n"
_VECTOR = spaces.Box(-9, 9, (2,), np.float32)
_LENGTHS = (3, 2)
_KEPT = [0, 1, -2, -1]
"""Transitions beside the last one of the truncated episode, which has a separate row."""
_START_NS = 1_700_000_000 * 10**9

_Trip = Callable[[Dataset, Path, bool], Dataset]


def _by_file(name: str, suffix: str) -> _Trip:
    def trip(data: Dataset, folder: Path, lossy: bool) -> Dataset:
        target = folder / f"toy{suffix}"
        mcaprl.convert([_saved(data, folder)], target, to=name, lossy=lossy)
        return mcaprl.open(target, format=name)

    return trip


def _saved(data: Dataset, folder: Path) -> Path:
    path = folder / "toy.mcap"
    data.save(path, overwrite=True)
    return path


def _by_log(data: Dataset, folder: Path, lossy: bool) -> Dataset:
    return mcaprl.open(_saved(data, folder))


def _by_sb3(data: Dataset, folder: Path, lossy: bool) -> Dataset:
    return Dataset.from_sb3(data.to_sb3())


_TRIPS: dict[str, _Trip] = {
    "log": _by_log,
    "Minari": _by_file("minari", "-v0"),
    "LeRobot": _by_file("lerobot", "-lerobot"),
    "Parquet": _by_file("parquet", "-parquet"),
    "npz": _by_file("npz", ".npz"),
    "HDF5": _by_file("hdf5", ".hdf5"),
    "d3rlpy file": _by_file("d3rlpy", ".h5"),
    "SB3 buffer": _by_sb3,
}


def _made(
    observation: spaces.Space[Any] = _VECTOR,
    action: spaces.Space[Any] | None = None,
    **episode: Any,
) -> Dataset:
    """Return a truncated and a terminated episode with samples of these spaces."""
    action = action or spaces.Discrete(3)
    observation.seed(0)
    action.seed(0)
    metadata = LogMetadata(
        observation, action, env_id="mcaprl/LaneKeeping-v0", action_meanings=("a", "b", "c")
    )
    if not isinstance(action, spaces.Discrete) or int(action.n) != 3:
        metadata = LogMetadata(observation, action)
    random = np.random.default_rng(0)
    start_ns, episodes = _START_NS, []
    for number, length in enumerate(_LENGTHS):
        given = {name: value[number] for name, value in episode.items()}
        times_ns = start_ns + np.arange(length + 1) * 100_000_000
        start_ns = int(times_ns[-1]) + 100_000_000
        arrays: dict[str, Any] = {
            "observations": _stacked([observation.sample() for _ in range(length + 1)]),
            "actions": np.array([action.sample() for _ in range(length)]),
            "rewards": random.standard_normal(length).astype(np.float32),
            "terminated": number == 1,
            "truncated": number == 0,
            "times_ns": times_ns,
            "summary": {"reason": "truncated" if number == 0 else "terminated"},
        }
        episodes.append(EpisodeArrays(**{**arrays, **given}))
    return dataset_of(episodes, metadata, "test")


def _stacked(values: list[Any]) -> Any:
    if isinstance(values[0], dict):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return np.array(values)


def _same_arrays(first: Any, second: Any) -> bool:
    if isinstance(first, dict):
        return (
            isinstance(second, dict)
            and first.keys() == second.keys()
            and all(_same_arrays(first[key], second[key]) for key in first)
        )
    return (
        isinstance(second, np.ndarray)
        and first.dtype == second.dtype
        and np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    )


def _observations(before: Dataset, after: Dataset) -> bool:
    return _same_arrays(_tree(before.observations, _KEPT), _tree(after.observations, _KEPT))


def _tree(values: Any, rows: list[int]) -> Any:
    if isinstance(values, dict):
        return {key: _tree(part, rows) for key, part in values.items()}
    return values[rows]


def _actions(before: Dataset, after: Dataset) -> bool:
    return _same_arrays(_tree(before.actions, _KEPT), _tree(after.actions, _KEPT))


def _spaces(before: Dataset, after: Dataset) -> bool:
    return (before.observation_space, before.action_space) == (
        after.observation_space,
        after.action_space,
    )


def _summaries(*names: str) -> Callable[[Dataset, Dataset], bool]:
    def same(before: Dataset, after: Dataset) -> bool:
        found = [
            [[repr(getattr(one.summary, name)) for name in names] for one in each.episodes]
            for each in (before, after)
        ]
        return found[0] == found[1]

    return same


def _finals(number: int) -> Callable[[Dataset, Dataset], bool]:
    def same(before: Dataset, after: Dataset) -> bool:
        rows = [each.episodes[number].next_observations[-1] for each in (before, after)]
        return np.array_equal(rows[0].ravel(), rows[1].ravel())

    return same


def _ends(before: Dataset, after: Dataset) -> bool:
    def of(data: Dataset) -> list[Any]:
        lasts = np.cumsum(data.episode_lengths) - 1
        return [data.terminated[lasts].tolist(), data.truncated[lasts].tolist()]

    return of(before) == of(after)


def _last_transition(before: Dataset, after: Dataset) -> bool:
    return before.episode_lengths[0] == after.episode_lengths[0] and _finals(0)(before, after)


def _infos(rows: list[int]) -> Callable[[Dataset, Dataset], bool]:
    def of(data: Dataset) -> Any:
        speed = data.infos.get("speed")
        return None if speed is None else speed.filled(np.nan)[rows].tolist()

    return lambda before, after: of(before) == of(after)


_IMAGE = spaces.Box(0, 255, (32, 36, 3), np.uint8)
_SUMMARIES = [
    {"reason": "slow", "policy": "pilot", "seed": 7, "options": '{"start": 1}'},
    {"reason": "fell", "policy": "random", "seed": 8, "options": '{"start": 2}'},
]
_INFOS = [
    {"speed": np.ma.MaskedArray(np.arange(length + 1.0), np.arange(length + 1) < 1)}
    for length in _LENGTHS
]


_Aspect = tuple[Dataset, Callable[[Dataset, Dataset], bool]]
_COMMANDS = LogMetadata(
    _VECTOR, _VECTOR, action_part_names=("turn", "speed"), action_units=("rad/s", "m/s")
)


def _described(*names: str, metadata: LogMetadata | None = None) -> _Aspect:
    """Return a dataset with metadata, and whether these fields of the metadata are kept."""
    if metadata is not None:
        return Dataset(_made(action=_VECTOR)._transitions, metadata), _same_fields(names)
    metadata = LogMetadata(
        _VECTOR,
        spaces.Discrete(3),
        observation_names=("x", "y"),
        action_meanings=("a", "b", "c"),
        action_commands=ActionCommands(("/cmd",), ((0.0,), (1.0,), (2.0,))),
        success_reasons=("goal",),
        view={"distance_m": 2.0},
        epsilon="0.5",
        seed="4",
        about={"author": "A. Author"},
    )
    return Dataset(_made()._transitions, metadata), _same_fields(names)


def _same_fields(names: Sequence[str]) -> Callable[[Dataset, Dataset], bool]:
    def same(before: Dataset, after: Dataset) -> bool:
        found = [LogMetadata.from_strings(one.metadata) for one in (before, after)]
        return all(getattr(found[0], name) == getattr(found[1], name) for name in names)

    return same


def _same_behavior(before: Dataset, after: Dataset) -> bool:
    return _same_arrays(_tree(before.behavior, _KEPT), _tree(after.behavior, _KEPT))


_ASPECTS: dict[str, tuple[Dataset, Callable[[Dataset, Dataset], bool]]] = {
    "float32 vectors": (_made(), _observations),
    "float64 vectors": (_made(spaces.Box(-9, 9, (2,), np.float64)), _observations),
    "int16 vectors": (_made(spaces.Box(-9, 9, (2,), np.int16)), _observations),
    "Dict observations": (
        _made(spaces.Dict({"arm": spaces.Dict({"q": _VECTOR}), "on": spaces.Discrete(2)})),
        _observations,
    ),
    "color images": (_made(_IMAGE), _observations),
    "depth, float32": (_made(spaces.Box(0, 50, (32, 36, 1), np.float32)), _observations),
    "Discrete actions": (_made(), _actions),
    "Discrete actions from 5": (_made(action=spaces.Discrete(4, start=5)), _actions),
    "Box actions, float32": (_made(action=_VECTOR), _actions),
    "MultiDiscrete actions": (_made(action=spaces.MultiDiscrete([2, 3])), _actions),
    "rewards, float64": (
        _made(rewards=[np.full(length, 0.1) for length in _LENGTHS]),
        lambda before, after: _same_arrays(
            _tree(before.rewards, _KEPT), _tree(after.rewards, _KEPT)
        ),
    ),
    "ends: terminated, truncated": (_made(), _ends),
    "last transition, truncated": (_made(), _last_transition),
    "final observation, terminated": (_made(), _finals(1)),
    "infos": (_made(infos=_INFOS), _infos([1, 2, -2])),
    "infos of final observations": (_made(infos=_INFOS), _infos([-1])),
    "times": (_made(), _summaries("start_time_ns")),
    "spaces": (_made(), _spaces),
    "env id": (_made(), lambda before, after: before.env_id == after.env_id),
    "names of observations": _described("observation_names"),
    "names and commands of actions": _described("action_meanings", "action_commands"),
    "names of parts of actions": _described("action_part_names", metadata=_COMMANDS),
    "units of parts of actions": _described("action_units", metadata=_COMMANDS),
    "description of the source": _described("about"),
    "other metadata": _described("success_reasons", "view", "epsilon", "seed"),
    "behavior_prob": (
        _made(behavior_probs=[np.full(length, 0.25) for length in _LENGTHS]),
        _same_behavior,
    ),
    "behavior_log_prob": (
        _made(action=_VECTOR, behavior_log_probs=[np.full(length, 2.25) for length in _LENGTHS]),
        _same_behavior,
    ),
    "policy names": (_made(summary=_SUMMARIES), _summaries("policy")),
    "seeds": (_made(summary=_SUMMARIES), _summaries("seed")),
    "reset options": (_made(summary=_SUMMARIES), _summaries("options")),
    "end reasons": (_made(summary=_SUMMARIES), _summaries("reason")),
}

_FACTS = list(_ASPECTS)[list(_ASPECTS).index("last transition, truncated") :]
"""Aspects that are reported as `lost`, not as `changed`, if they differ after the conversion."""


def _outcome(trip: _Trip, aspect: str, folder: Path) -> str:
    data, same = _ASPECTS[aspect]
    for lossy in (False, True):
        folder.mkdir(parents=True)
        try:
            after = trip(data, folder, lossy)
        except SpaceError:
            folder = folder.with_name(f"{folder.name}-lossy")
            continue
        found = "kept" if same(data, after) else "lost" if aspect in _FACTS else "changed"
        return f"{found} (`--lossy`)" if lossy else found
    return "refused"


def _table(folder: Path) -> str:
    rows = [["", *_TRIPS], ["---"] * (len(_TRIPS) + 1)]
    for number, aspect in enumerate(_ASPECTS):
        cells = [
            _outcome(trip, aspect, folder / f"{number}-{name.replace(' ', '-')}")
            for name, trip in _TRIPS.items()
        ]
        rows.append([aspect, *cells])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def test_the_table_of_the_docs_is_what_conversions_give(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        # Conversions warn about data that they leave out.
        warnings.simplefilter("ignore")
        table = _table(tmp_path)
    page = _PAGE.read_text()
    begin, end = page.index(_BEGIN) + len(_BEGIN), page.index(_END)
    if os.environ.get("MCAPRL_WRITE_TABLE"):
        _PAGE.write_text(page[:begin] + table + page[end:])
    assert page[begin:end] == table


def test_the_facts_that_formats_declare_are_those_of_the_table() -> None:
    facts = {
        "final observation, terminated": "final observations after a termination",
        "env id": "environment",
        "seeds": "seeds and reset options",
        "reset options": "seeds and reset options",
    }
    table = _PAGE.read_text().partition(_BEGIN)[2].partition(_END)[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]
    columns = {"lerobot": 3, "minari": 2, "parquet": 4, "npz": 5, "hdf5": 6, "d3rlpy": 7}
    kept: dict[str, set[str]] = {name: set() for name in columns}
    for row in rows:
        for name, column in columns.items():
            if (fact := facts.get(row[0], row[0])) in FACTS and row[column] == "kept":
                kept[name].add(fact)
    assert kept == {name: set(form.keeps) for name, form in FORMATS.items()}
