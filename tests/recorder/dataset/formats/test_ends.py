"""Ends of episodes: every usual name is read, contradictions and unknown ends are refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, SpaceError, UsageError
from mcaprl.recorder.dataset.formats.flat import MEANINGS

h5py = pytest.importorskip("h5py", reason="needs the extra interop")

# Three episodes of 3, 2 and 2 rows. The first one terminates, the others are cut off.
TERMINALS = np.array([0, 0, 1, 0, 0, 0, 0])
TIMEOUTS = np.array([0, 0, 0, 0, 1, 0, 1])
LAST = TERMINALS | TIMEOUTS
NO_NEXT = "there are no next_observations.*last steps of 2 episodes"
UNKNOWN = "no array says"


def _write(path: Path, arrays: dict[str, Any], *, has_next: bool = False) -> Path:
    """Write arrays of seven rows; row k has observation k and reward k."""
    count = len(next(iter(arrays.values()))) if "rewards" in arrays else 7
    rows = np.arange(count, dtype=np.float32)
    every: dict[str, Any] = {
        "observations": rows[:, None],
        "actions": np.zeros((count, 1), np.float32),
        "rewards": rows,
        **({"next_observations": rows[:, None] + 1} if has_next else {}),
        **arrays,
    }
    if path.suffix == ".npz":
        np.savez(path, **every)
    else:
        with h5py.File(path, "w") as file:
            for name, values in every.items():
                file[name] = values
    return path


def _open(path: Path, *messages: str, **options: Any) -> Dataset:
    """Open a file, and check that there is one warning for each message."""
    with pytest.warns(UserWarning, match=str(path)) as caught:
        found = mcaprl.open(path, **options)
    texts = [str(one.message) for one in caught]
    assert len(texts) == len(messages), texts
    for message in messages:
        assert [text for text in texts if re.search(message, text)], (message, texts)
    return found


def _is_expected(found: Dataset) -> bool:
    """Check the transitions: the last rows of the episodes that were cut off are left out."""
    assert found.frames.ravel().tolist() == [0, 1, 2, 2, 3, 4, 5, 6]
    assert found.rewards.tolist() == [0, 1, 2, 3, 5]
    assert found.terminated.tolist() == [False, False, True, False, False]
    assert found.truncated.tolist() == [False, False, False, True, True]
    return bool(found.episode_lengths.tolist() == [3, 1, 1])


DIVISIONS: dict[str, Any] = {
    "last": LAST.astype(bool),
    "done": LAST.astype(np.uint8),
    "first": np.array([1.0, 0, 0, 1, 0, 1, 0]),
    "stops": np.array([3, 5, 7]),
    "lengths": np.array([3, 2, 2], np.int32),
    "number": np.array([4, 4, 4, 0, 0, 9, 9]),
}


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@pytest.mark.parametrize("name", MEANINGS)
def test_every_name_of_an_end_is_read(tmp_path: Path, suffix: str, name: str) -> None:
    meaning = MEANINGS[name]
    if meaning == "terminated":
        arrays = {name: TERMINALS, "timeouts": TIMEOUTS}
    elif meaning == "continues":
        arrays = {name: 1 - TERMINALS, "timeouts": TIMEOUTS}
    elif meaning == "truncated":
        arrays = {"terminals": TERMINALS, name: TIMEOUTS.astype(bool)}
    else:
        arrays = {"terminals": TERMINALS[:, None].astype(np.float32), name: DIVISIONS[meaning]}
    assert _is_expected(_open(_write(tmp_path / f"their{suffix}", arrays), NO_NEXT))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("episode_ends", LAST),
        ("ends", LAST.astype(bool)),
        ("episode_starts", [0, 3, 5]),
        ("episode_ids", ["b", "b", "b", "a", "a", "c", "c"]),
    ],
)
def test_flags_numbers_and_names_are_distinguished(tmp_path: Path, name: str, values: Any) -> None:
    arrays = {"terminals": TERMINALS, name: np.array(values)}
    assert _is_expected(_open(_write(tmp_path / "their.npz", arrays), NO_NEXT))


def test_dones_alone_are_terminal_or_what_the_user_says(tmp_path: Path) -> None:
    path = _write(tmp_path / "their.npz", {"dones": LAST})
    found = _open(path, "'dones' may also mark truncated", "of 3 terminated episodes is repeated")
    assert np.flatnonzero(found.terminated).tolist() == [2, 4, 6]
    found = _open(path, "last steps of 3 episodes", dones="truncated")
    assert found.episode_lengths.tolist() == [2, 1, 1]
    assert np.flatnonzero(found.truncated).tolist() == [1, 2, 3]
    with pytest.raises(mcaprl.McaprlError, match="unknown kind of ends 'timeouts'"):
        mcaprl.open(path, dones="timeouts")


@pytest.mark.parametrize("name", ["episode_ids", "is_last", "episode_lengths"])
def test_ends_of_unknown_kind_are_cut_off_or_what_the_user_says(tmp_path: Path, name: str) -> None:
    path = _write(tmp_path / "their.npz", {name: DIVISIONS[MEANINGS[name]]})
    found = _open(path, rf"'{name}' ends 3 episodes, and {UNKNOWN}", "last steps of 3")
    assert found.episode_lengths.tolist() == [2, 1, 1]
    found = _open(path, "of 3 terminated", dones="terminated")
    assert np.flatnonzero(found.terminated).tolist() == [2, 4, 6]


def test_dones_with_timeouts_mark_all_ends_or_terminal_steps(tmp_path: Path) -> None:
    for dones in (LAST, TERMINALS):
        path = _write(tmp_path / "their.npz", {"dones": dones, "timeouts": TIMEOUTS})
        assert _is_expected(_open(path, NO_NEXT))
    path = _write(tmp_path / "their.npz", {"dones": TERMINALS, "episode_lengths": [3, 2, 2]})
    assert _is_expected(_open(path, NO_NEXT))
    arrays = {"dones": TERMINALS, "terminals": TERMINALS, "timeouts": TIMEOUTS}
    assert _is_expected(_open(_write(path, arrays), NO_NEXT))


def test_rlds_has_the_final_observation_in_the_last_row(tmp_path: Path) -> None:
    arrays = {
        "is_first": DIVISIONS["first"],
        "is_last": LAST,
        "is_terminal": TERMINALS,
        # Of the last rows, only the observation is defined.
        "rewards": np.where(LAST, np.nan, np.arange(7.0)),
    }
    found = _open(_write(tmp_path / "their.npz", arrays), "3 episodes is the final obs.*RLDS")
    assert found.episode_lengths.tolist() == [2, 1, 1]
    assert found.frames.ravel().tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert found.terminated.tolist() == [False, True, False, False]
    assert found.truncated.tolist() == [False, False, True, True]


def test_flags_without_any_end_are_refused_unless_it_is_one_episode(tmp_path: Path) -> None:
    none = np.zeros(7)
    for has_next in (False, True):
        for name in ("terminals", "dones", "is_last"):
            path = _write(tmp_path / "their.hdf5", {name: none}, has_next=has_next)
            with pytest.raises(
                LogError, match=r"nothing says .* of 7 rows end: .*`one_episode=True`"
            ):
                mcaprl.open(path)
    found = _open(
        _write(path, {"terminals": none}), "there are no timeouts", "no next", one_episode=True
    )
    assert found.episode_lengths.tolist() == [6]
    assert not found.truncated.any()
    # An explicit length says that it is one episode.
    path = _write(tmp_path / "their.npz", {"terminals": none, "episode_lengths": [7]})
    assert _open(path, "last steps of 1 episode").truncated.tolist() == [False] * 5 + [True]
    path = _write(path, {"terminals": TERMINALS, "timeouts": TIMEOUTS})
    with pytest.raises(UsageError, match="one_episode is set, but the arrays have 3 episodes"):
        mcaprl.open(path, one_episode=True)
    log = tmp_path / "one.mcap"
    path = _write(tmp_path / "their.npz", {"terminals": none}, has_next=True)
    converted = mcaprl.convert(mcaprl.open(path, one_episode=True), log)
    assert converted.dataset.episode_lengths.tolist() == [7]
    with pytest.raises(UsageError, match="for datasets of other tools"):
        mcaprl.open(log, one_episode=True)


def test_terminals_without_timeouts_are_reported(tmp_path: Path) -> None:
    path = _write(tmp_path / "maze.hdf5", {"terminals": TERMINALS})
    found = _open(path, "there are no timeouts .*: if a time limit", "no next_observations")
    assert found.episode_lengths.tolist() == [3, 3]
    # D4RL's `qlearning_dataset` uses the next row as the next observation, also at an end.
    path = _write(tmp_path / "maze.hdf5", {"terminals": TERMINALS}, has_next=True)
    assert _open(path, "there are no timeouts").episode_lengths.tolist() == [3, 4]
    path = _write(path, {"terminals": TERMINALS, "timeouts": TIMEOUTS}, has_next=True)
    found = _open(path, "next_observations are those of the following row.*1 truncated episode")
    assert found.episode_lengths.tolist() == [3, 2, 2]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"terminals": TERMINALS, "masks": np.ones(7)}, "terminals and masks .* in row 2"),
        ({"terminals": TERMINALS, "dones": TIMEOUTS}, "terminals and dones .* in row 2"),
        ({"terminals": TERMINALS, "is_last": TIMEOUTS}, "terminals and is_last .* in row 2"),
        (
            {"terminals": TERMINALS, "timeouts": TIMEOUTS, "episode_lengths": [3, 4]},
            "timeouts and episode_lengths .* in row 4",
        ),
        (
            {"terminals": TERMINALS, "episode_ends": [3, 5, 7], "is_first": [1, 0, 0, 0, 0, 1, 0]},
            "episode_ends and is_first .* in row 2|is_first and episode_ends .* in row 2",
        ),
        (
            {"dones": [0, 0, 1, 0, 0, 0, 1], "timeouts": [0, 0, 1, 0, 1, 0, 0]},
            "timeouts and dones .* in row 4",
        ),
        ({"dones": LAST, "done": LAST}, "both dones and done"),
        ({"terminals": TERMINALS, "episode_ends": [3, 5]}, "episode_ends does not divide"),
        ({"terminals": TERMINALS, "episode_lengths": [3, 0, 4]}, "expected whole numbers"),
        ({"terminals": TERMINALS, "episode_lengths": [3, -3, 7]}, "expected whole numbers"),
        ({"terminals": TERMINALS, "episode_lengths": [2**62, 2**62, 7]}, "expected whole"),
        ({"terminals": TERMINALS, "episode_starts": [1, 4]}, "episode_starts does not divide"),
        ({"terminals": TERMINALS, "traj_ids": [0, 0, 1, 1, 0, 0, 0]}, "row 4 is 0 again"),
        ({"timeouts": TIMEOUTS}, "no terminals or terminations or terminated"),
        ({"terminals": TERMINALS[:6]}, r"terminals has shape \(6,\)"),
    ],
)
def test_contradictions_are_refused_by_row(
    tmp_path: Path, arrays: dict[str, Any], message: str
) -> None:
    path = _write(tmp_path / "their.npz", arrays)
    with pytest.raises(LogError, match=rf"their\.npz.*({message})"):
        mcaprl.open(path)


@pytest.mark.parametrize("flag", [np.nan, -1, 2, 0.3, 255, "1", np.datetime64(1, "s"), 1j])
@pytest.mark.parametrize("name", ["terminals", "timeouts", "dones", "masks", "is_last"])
def test_flags_are_0_or_1(tmp_path: Path, name: str, flag: Any) -> None:
    values = np.array([flag] * 7) if np.asarray(flag).dtype.kind in "UMc" else TERMINALS * 1.0
    if values.dtype.kind == "f":
        values[3] = flag
    path = _write(tmp_path / "their.npz", {"terminated": TERMINALS, name: values})
    if name == "terminals":
        path = _write(path, {name: values})
    where = rf"{name} (are not flags: row 3 is|has dtype .*: row 0 is)"
    with pytest.raises(SpaceError, match=where):
        mcaprl.open(path)


def test_arrays_that_are_not_read_are_named(tmp_path: Path) -> None:
    arrays = {"terminals": TERMINALS, "timeouts": TIMEOUTS}
    others = {"discount": np.ones(7), "metadata/policy/w": np.ones((2, 3)), "seed": 3}
    path = _write(tmp_path / "their.hdf5", {**arrays, **others, "infos/odd": np.zeros(3)})
    _open(path, NO_NEXT, "not read: discount, infos/odd, metadata$")
    path = _write(tmp_path / "their.npz", {**arrays, **others, "masks": np.ones((7, 4))})
    _open(path, NO_NEXT, "not read: discount, masks, metadata/policy/w$")
    many = {f"x{number:03d}": np.zeros(7) for number in range(30)}
    _open(_write(path, {**arrays, **many}), NO_NEXT, "not read: x000, .* x019 and 10 more$")
