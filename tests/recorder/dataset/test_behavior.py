"""Probabilities of actions of a finite space, and log densities of actions of floats."""

from __future__ import annotations

import json
import math
import pickle
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import LogError, SpaceError
from mcaprl.recorder.dataset.format_registry import FORMATS, write_format
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.behavior import LOG_DENSITY, PROBABILITY
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.repair.check import check_log
from tests.support.foreign_logs import PLAIN, Codec, steps_of, write_with_mcap
from tests.support.paths import GOLDEN
from tests.support.recordings import KnownCommands

COMMANDS = spaces.Box(np.array([-1, 0], np.float32), np.array([1, 2.5], np.float32))


def made(space: spaces.Space[Any] = COMMANDS, **given: Any) -> Dataset:
    """Return an episode of three steps."""
    states = np.arange(4, dtype=np.float32)[:, np.newaxis]
    actions = np.array([[-1, 0], [0.5, 2.5], [0, 1]], np.float32)
    columns = {
        "observations": states[:-1],
        "next_observations": states[1:],
        "actions": actions if isinstance(space, spaces.Box) else np.arange(3),
        "rewards": np.ones(3),
        "terminated": [False, False, True],
        "truncated": [False] * 3,
        **given,
    }
    return Dataset.from_arrays(**columns, action_space=space)


def described(data: Dataset, **fields: Any) -> Dataset:
    """Return a dataset whose action has named parts."""
    metadata = LogMetadata(
        data.observation_space,
        data.action_space,
        action_part_names=("steering", "speed"),
        action_units=("right | left", "m/s"),
        **fields,
    )
    return Dataset(data._transitions, metadata)


def test_densities_of_arrays() -> None:
    data = made(behavior_log_probs=[5.5, math.nan, -300])
    np.testing.assert_array_equal(data.behavior_log_probs, [5.5, np.nan, -300])
    np.testing.assert_array_equal(data.behavior, data.behavior_log_probs)
    assert data.behavior.dtype == np.float32
    assert data.behavior_field is LOG_DENSITY
    again = data.with_behavior_log_probs(np.array([1.0, 2, 3]), estimated=True)
    assert again.behavior_log_probs.tolist() == [1, 2, 3]
    assert again.has_estimated_probs
    assert not data.has_estimated_probs
    assert data.batch(np.array([2, 0])).behavior_log_probs.tolist() == [-300, 5.5]
    assert data.episodes[0].behavior_log_probs[2] == -300
    assert np.isnan(made().behavior_log_probs).all()


def test_pickled_parts_keep_the_meaning_of_the_column() -> None:
    data = made(behavior_log_probs=[5.5, 0, -300])
    for part in (data, data.episodes[0], data.batch(np.arange(3))):
        again = pickle.loads(pickle.dumps(part))
        assert again.behavior_log_probs.tolist() == [5.5, 0, -300]
        with pytest.raises(SpaceError, match="use behavior_log_probs"):
            _ = again.behavior_probs


def test_probabilities_of_arrays() -> None:
    data = made(spaces.Discrete(3), behavior_probs=[1, 0.5, math.nan])
    assert data.behavior_field is PROBABILITY
    np.testing.assert_allclose(data.behavior_log_probs, np.log([1, 0.5, np.nan]), rtol=1e-6)
    same = made(spaces.Discrete(3), behavior_log_probs=np.log([1, 0.5, np.nan]))
    np.testing.assert_allclose(same.behavior_probs, [1, 0.5, np.nan])
    again = data.with_behavior_log_probs(np.log([0.25, 0.5, 0.125]))
    np.testing.assert_allclose(again.behavior_probs, [0.25, 0.5, 0.125])


@pytest.mark.parametrize(
    ("space", "given", "message"),
    [
        (COMMANDS, {"behavior_probs": [1, 1, 1]}, "use behavior_log_probs"),
        (COMMANDS, {"behavior_log_probs": [0, math.inf, 0]}, "row 1 is inf, expected a finite"),
        (COMMANDS, {"behavior_log_probs": [0, 0, -math.inf]}, "row 2 is -inf, expected a finite"),
        (COMMANDS, {"behavior_log_probs": [1e39, 0, 0]}, r"row 0 is 1e\+39, expected a finite"),
        (COMMANDS, {"behavior_log_probs": [0, 0]}, r"behavior_log_probs has shape \(2,\)"),
        (spaces.Discrete(3), {"behavior_log_probs": [0, 0.1, 0]}, "row 1 is 0.1, expected the log"),
        (spaces.Discrete(3), {"behavior_log_probs": [0, 0, -math.inf]}, "row 2 is -inf, exp"),
        (
            spaces.Discrete(3),
            {"behavior_probs": [1, 1, 1], "behavior_log_probs": [0, 0, 0]},
            "not both",
        ),
    ],
)
def test_impossible_arrays_are_refused(
    space: spaces.Space[Any], given: dict[str, Any], message: str
) -> None:
    with pytest.raises(SpaceError, match=message) as caught:
        made(space, **given)
    assert "\n" not in str(caught.value)


def test_other_columns_than_that_of_the_space_are_refused() -> None:
    with pytest.raises(SpaceError, match="use behavior_log_probs"):
        made().with_behavior_probs(np.ones(3))
    with pytest.raises(SpaceError, match=r"log_probs has shape \(2,\), expected \(3,\)"):
        made().with_behavior_log_probs(np.ones(2))


@pytest.mark.parametrize("fields", [("behavior_prob",), ("behavior_log_prob",), ()])
@pytest.mark.parametrize("action", ["float32[2]", "int64"])
def test_logs_of_other_writers_may_have_either_column(
    fields: tuple[str, ...], action: str, log_path: Path
) -> None:
    """The values are those of the action space, whichever of the columns the writer chose."""
    prob = np.array([0.5, 0.25, np.nan, np.nan], np.float32)
    steps = steps_of([3])
    given = {"behavior_prob": prob, "behavior_log_prob": np.log(prob)}
    steps.fields |= given
    if action != "int64":
        steps.fields["action"] = np.zeros((4, 2), np.float32)
    text = PLAIN.replace("int64 action", f"{action} action")
    columns = "".join(f"float32 {name}\n" for name in fields)
    codec = Codec(text.replace("float32 behavior_prob\n", columns))
    messages = [
        (time_ns, codec.encode(**{name: row[name] for name in codec.fields}))
        for time_ns, row in steps.rows()
    ]
    write_with_mcap(log_path, messages, codec.text)
    data = mcaprl.open(log_path)
    assert (data.behavior_field is LOG_DENSITY) == (action != "int64")
    expected = np.log(prob)[:3] if fields else np.full(3, np.nan)
    np.testing.assert_allclose(data.behavior_log_probs, expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["parquet", "npz", "hdf5", "lerobot"])
def test_datasets_of_earlier_versions_have_probabilities_of_commands(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = made(behavior_log_probs=np.log([0.5, 1, 0.125]))
    probs = np.exp(data.behavior)
    old = Dataset(Transitions(**{**vars(data._transitions), "behavior": probs}), data._description)
    path = tmp_path / f"old{FORMATS[name].suffix}"
    with warnings.catch_warnings(), monkeypatch.context() as patch:
        warnings.simplefilter("ignore")
        # Earlier versions wrote this column whatever the space was.
        for module in ("dataset", "tables"):
            name_of = f"mcaprl.recorder.dataset.{module}.behavior_field"
            patch.setattr(name_of, lambda _: PROBABILITY)
        write_format(old, path, FORMATS[name], lossy=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = mcaprl.open(path)
    assert found.behavior_field is LOG_DENSITY
    np.testing.assert_allclose(found.behavior_log_probs, data.behavior_log_probs, rtol=1e-6)


def test_impossible_values_are_reported_by_name(log_path: Path) -> None:
    data = described(made())
    beyond = data.actions.copy()
    beyond[1] = [np.nan, 3]
    beyond[2, 1] = -0.5
    densities = np.array([np.inf, 0, -np.inf], np.float32)
    columns = {**vars(data._transitions), "actions": beyond, "behavior": densities}
    bad = Dataset(Transitions(**columns), data._description)
    found = [str(one) for one in lint(bad) if one.severity == "problem"]
    assert [text.partition(":")[0] for text in found] == [
        "steering is not in [-1, 1] in 1 of 3 steps (episode 0 step 1)",
        "speed is not in [0, 2.5] in 2 of 3 steps (episode 0 step 1, episode 0 step 2)",
        "behavior_log_prob is not a finite number in 2 of 3 steps (episode 0 step 0, episode 0"
        " step 2)",
    ]
    bad.save(log_path)
    assert [f"{one.what}: {one.where}" for one in check_log(log_path)] == [
        "steering nan is outside of -1 to 1: episode 0 step 1",
        "speed -0.5 is outside of 0 to 2.5: episode 0 step 2",
        "behavior_log_prob is inf, expected a finite number: episode 0 step 0",
        "behavior_log_prob is -inf, expected a finite number: episode 0 step 2",
    ]


def test_a_part_that_never_changes_is_reported_by_name() -> None:
    actions = np.array([[-1, 2], [0.5, 2], [0, 2]], np.float32)
    data = made(actions=actions)
    (found,) = (one for one in lint(described(data)) if "part" in one.what)
    assert str(found).startswith("1 part of the action never change (speed is 2): ")
    assert found.severity == "problem"
    (found,) = (one for one in lint(data) if "part" in one.what)
    assert "(action[1] is 2)" in str(found)


def test_info_names_the_parts_and_counts_the_densities(tmp_path: Path) -> None:
    found = mcaprl.info(GOLDEN / "densities.mcap", report=tmp_path)
    assert found.action_parts == ["steering (-1 right, 1 left)", "speed (0 to 2.5 m/s)"]
    rows = dict(found.rows())
    assert rows["behavior_log_prob"] == "known in 5 of 6 steps"
    assert rows["action parts"] == "steering (-1 right, 1 left), speed (0 to 2.5 m/s)"
    assert "behavior_prob" not in rows
    facts = json.loads((tmp_path / "dataset.json").read_text())
    assert facts["action_parts"] == found.action_parts
    assert (facts["behavior_field"], facts["behavior_known"]) == ("behavior_log_prob", 5)
    assert dict(mcaprl.info(made()).rows())["behavior_log_prob"] == "unknown"


def test_copies_keep_densities_names_and_units(tmp_path: Path) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    mcaprl.slice(GOLDEN / "densities.mcap", first, steps=(0, 3))
    mcaprl.slice(GOLDEN / "densities.mcap", second, steps=(3, 5))
    mcaprl.merge([first, second], tmp_path / "merged.mcap")
    mcaprl.recover(first, tmp_path / "recovered.mcap")
    mcaprl.filter("seed == 0", GOLDEN / "densities.mcap", tmp_path / "filtered.mcap")
    mcaprl.open(GOLDEN / "densities.mcap").save(tmp_path / "saved.mcap")
    expected = mcaprl.open(GOLDEN / "densities.mcap")
    for name in ("first", "second", "merged", "recovered", "filtered", "saved"):
        path = tmp_path / f"{name}.mcap"
        found = mcaprl.open(path)
        assert found.action_labels == expected.action_labels, name
        assert not [one for one in check_log(path) if one.severity == "problem"], name
        start = 3 if name == "second" else 0
        rows = slice(start, start + len(found))
        np.testing.assert_array_equal(found.behavior_log_probs, expected.behavior_log_probs[rows])


def test_a_table_has_columns_for_the_parts() -> None:
    pytest.importorskip("pyarrow", reason="needs the extra tables")
    table = mcaprl.open(GOLDEN / "densities.mcap").to_arrow()
    assert {"action.steering", "action.speed", "behavior_log_prob"} < set(table.column_names)
    assert "behavior_prob" not in table.column_names


def _record(path: Path, value: float, **options: Any) -> None:
    with closing(mcaprl.RecordMcap(KnownCommands(), path, **options)) as env:
        env.reset()
        for step in range(3):
            setattr(env, env._field.name, value)
            env.step(np.full(2, step / 4, np.float32))


def test_an_older_log_of_commands_is_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has the other column; one file, or one log of several, cannot have both."""
    old, new = tmp_path / "old.mcap", tmp_path / "new.mcap"
    with monkeypatch.context() as patch:
        for module in ("format.schema", "format.log_writer", "record.wrapper"):
            name = f"mcaprl.recorder.{module}.behavior_field"
            patch.setattr(name, lambda _: PROBABILITY)
        patch.setattr(LogMetadata, "action_labels", lambda _: ())
        _record(old, 0.5)
    assert not check_log(old)
    np.testing.assert_allclose(mcaprl.open(old).behavior_log_probs, np.log([0.5] * 3), rtol=1e-6)
    content = old.read_bytes()
    with pytest.raises(LogError, match=r"earlier version recorded its behavior_prob of floats"):
        _record(old, 1.5, append=True)
    assert old.read_bytes() == content
    _record(new, 1.5)
    with pytest.raises(LogError, match=r"has behavior_prob, as earlier.*has behavior_log_prob"):
        mcaprl.merge([old, new], tmp_path / "merged.mcap", shift=True)
    again = tmp_path / "again.mcap"
    mcaprl.open(old).save(again)
    mcaprl.merge([again, new], tmp_path / "merged.mcap", shift=True)
    expected = [*np.log([0.5] * 3), 1.5, 1.5, 1.5]
    merged = mcaprl.open(tmp_path / "merged.mcap")
    np.testing.assert_allclose(merged.behavior_log_probs, expected, rtol=1e-6)


def test_a_log_of_commands_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    for run in range(2):
        with closing(mcaprl.RecordMcap(KnownCommands(), path, append=run > 0)) as env:
            env.reset()
            for step in range(3):
                env.behavior_log_prob = 10 * run + step
                env.step(np.zeros(2, np.float32))
    assert mcaprl.open(path).behavior_log_probs.tolist() == [0, 1, 2, 10, 11, 12]
    other = KnownCommands()
    other.action_part_names = ("wheel", "speed")
    with pytest.raises(LogError, match="its action_part_names is"):
        mcaprl.RecordMcap(other, path, append=True)


def test_estimates_say_what_they_need(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra offline")
    whole = made(
        spaces.Box(0, 3, (2,), np.int32), actions=np.arange(6, dtype=np.int32).reshape(3, 2) % 4
    )
    data = Dataset.concatenate([whole] * 6)
    for estimated in (False, True):
        with pytest.raises(SpaceError, match=r"Box\(.*int32\)"):
            mcaprl.estimate("random", data, estimate_behavior=estimated)
