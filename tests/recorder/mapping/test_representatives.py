"""Commands of actions, with numbers calculated by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.format.metadata import ActionCommands, LogMetadata
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from tests.support.memory_bag import MemoryBag

V = [0.0, 0.1, 0.4, 0.9, 0.7, 0.5]
W = [-1.0, -0.2, 0.3, 0.4, 0.0, 0.6]
FIELDS = ("/cmd.v", "/cmd.w")


def read(**action: Any) -> MappedBag:
    """Read a bag with the commands V and W, modes and numbers, one for each of 7 steps."""
    times = [float(k) for k in range(7)]
    commands: dict[str, Any] = {
        "v": [*V, 9.0],
        "w": [*W, 9.0],
        "mode": ["go", "go", "stop", "go", "go", "go", "go"],
        "number": [0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    }
    topics = {"/odom": (times, {"x": times}), "/cmd": (times, commands)}
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"x": {"field": "/odom.x"}},
        "action": action,
    }
    return read_open_bag(MemoryBag(topics), parse_mapping(tree))


def commands(**action: Any) -> list[Any]:
    found = read(**action).dataset.action_commands
    assert found is not None
    return [None if each is None else list(each) for each in found.commands]


def test_named_commands_stand_for_themselves() -> None:
    actions = {"stop": [0, 0], "go": [1, 0.5]}
    data, report = read(fields=list(FIELDS), actions=actions)
    assert data.action_commands == ActionCommands(FIELDS, ((0, 0), (1, 0.5)))
    assert report.commands == {"stop": (0, 0), "go": (1, 0.5)}
    assert ("commands", "stop: 0, 0; go: 1, 0.5") in report.rows()
    given = commands(fields=list(FIELDS), actions=actions, representatives={"go": [2, 0.1]})
    assert given == [[0, 0], [2, 0.1]]


def test_bins_stand_for_the_median_of_their_commands() -> None:
    # The last command is that of the final observation, which has no action.
    assert commands(fields=["/cmd.v"], edges=[[0.3, 0.6]]) == [[0.05], [0.45], [0.8]]
    # The bins from 2 to 4 and from 4 were never seen: their middle and their edge.
    assert commands(fields=["/cmd.v"], edges=[[-1, 2, 4]]) == [[-1], [0.45], [3], [4]]
    assert commands(fields=["/cmd.v"], edges=[[]]) == [[0.45]]


def test_combinations_of_bins() -> None:
    found = commands(fields=list(FIELDS), edges=[[0.3], [-0.5, 0.2]])
    assert found == [
        # v is below 0.3 in (0, -1) and (0.1, -0.2), never with a w from 0.2. Its median is 0.05,
        # and that of the w from 0.2 is 0.4.
        [0.0, -1.0],
        [0.1, -0.2],
        [0.05, 0.4],
        # v is from 0.3 in four commands; its median is 0.6. It is never with a w below -0.5.
        [0.6, -1.0],
        [0.7, 0.0],
        [0.5, 0.4],
    ]


def test_discrete_fields_stand_for_their_values() -> None:
    assert commands(field="/cmd.number") == [[0], [1], [2]]
    assert commands(field="/cmd.number", names={"a": 0, "b": 1, "c": 2}) == [[0], [1], [2]]
    # Two texts have the same number: the first one is the command. Number 1 has no text.
    names = {"go": 2, "drive": 2, "stop": 0}
    data, report = read(field="/cmd.mode", names=names)
    assert data.action_commands == ActionCommands(("/cmd.mode",), (("stop",), None, ("go",)))
    assert ("commands", "0: stop; 1: unknown; 2: go") in report.rows()
    assert commands(field="/cmd.mode", names=names, representatives={"1": "walk"})[1] == ["walk"]
    # A mapping that was saved with the data of another bag may have more or fewer commands.
    for given in ([5, [6], 7], [5, 6, 7, 8]):
        assert commands(field="/cmd.number", representatives=given) == [[5], [6], [7]]
    assert commands(field="/cmd.number", representatives=[5]) == [[5], [1], [2]]


@pytest.mark.parametrize(
    ("action", "text"),
    [
        ({"representatives": {"fast": [1]}}, "no action is named 'fast'; nearest: "),
        ({"representatives": [[1], [2]]}, "has 2 commands, but there are 3 actions"),
        ({"representatives": {"v below 0.3": [1, 2]}}, r"\[1, 2\], which does not have one value"),
    ],
)
def test_wrong_representatives_are_clear_errors(action: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=f"action.representatives: .*{text}"):
        read(fields=["/cmd.v"], edges=[[0.3, 0.6]], **action)
    with pytest.raises(UsageError, match="should be a finite number"):
        read(fields=["/cmd.v"], edges=[[]], representatives=[[float("inf")]])
    with pytest.raises(UsageError, match="representatives are for discrete actions, not for box"):
        read(fields=["/cmd.v"], box={"low": [0], "high": [1]}, representatives=[[1]])


def test_continuous_actions_and_many_numbers_have_no_commands() -> None:
    assert read(fields=["/cmd.v"], box={"low": [0], "high": [1]}).dataset.action_commands is None


def test_commands_are_kept_in_logs_and_other_formats(tmp_path: Path) -> None:
    data = read(fields=list(FIELDS), actions={"stop": [0, 0], "go": [1, 0.1]}).dataset
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "table")]
    data.save(paths[0])
    part = read(fields=list(FIELDS), actions={"stop": [0, 0], "go": [2, 0.1]}).dataset
    part.save(paths[1])
    mcaprl.convert(paths[0], paths[2], to="parquet")
    lost = mcaprl.convert(paths[0], tmp_path / "a.npz").lost
    assert "names and commands of actions" in lost[0]
    mcaprl.filter("length > 0", paths[0], tmp_path / "filtered.mcap")
    mcaprl.slice(paths[0], tmp_path / "slice.mcap", steps=(1, 3))
    mcaprl.merge([paths[0], paths[1]], tmp_path / "merged.mcap", shift=True)
    mcaprl.split(paths[0], tmp_path / "parts", episodes=1)
    for name in (
        *("a.mcap", "table", "filtered.mcap", "slice.mcap", "merged.mcap"),
        "parts/a-00000.mcap",
    ):
        found = mcaprl.open(tmp_path / name)
        assert found.action_commands == data.action_commands, name
        assert found.filter(lambda episode: True).action_commands == data.action_commands
    # Commands of other fields have no common form.
    other = ActionCommands(("/other", "/fields"), ((0, 0), (1, 1)))
    parts = [data._description, LogMetadata(data.observation_space, data.action_space)]
    assert LogMetadata.common(parts).action_commands == data.action_commands
    parts[1] = LogMetadata(data.observation_space, data.action_space, action_commands=other)
    assert LogMetadata.common(parts).action_commands is None


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"fields": ["a"], "commands": [[1]]}',
        '{"fields": ["a"], "commands": [[1], [2, 3]]}',
        '{"fields": ["a"], "commands": [[1], [true]]}',
        '{"fields": ["a"], "commands": [[1], [{}]]}',
        '{"fields": ["a"], "commands": [[1], [1e999]]}',
        '{"fields": [1], "commands": [[1], [2]]}',
        '{"fields": "a", "commands": [[1], [2]]}',
    ],
)
def test_forged_commands_are_clear_errors(text: str) -> None:
    data = read(fields=["/cmd.v"], actions={"stop": [0], "go": [1]}).dataset
    with pytest.raises(LogError, match="cannot be parsed"):
        LogMetadata.from_strings({**data.metadata, "action_commands": text})


def test_a_trained_policy_has_the_commands(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra offline")
    from tests.support.bags import integers, numbers, write_channels

    values = [(k / 10, float(k % 3)) for k in range(60)]
    bag = write_channels(
        tmp_path / "bag.mcap",
        [numbers("/odom", values), numbers("/cmd", values), integers("/mode", [(0, 0), (1, 1)])],
    )
    mapping = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.data"}},
        "action": {"fields": ["/cmd.data"], "edges": [[0.5, 1.5]]},
        "episodes": {"max_steps": 10},
    }
    run = tmp_path / "run"
    mcaprl.train(mcaprl.open(bag, mapping=mapping), algo="bc", updates=2, seeds=1, out=run)
    policy = mcaprl.load_policy(run)
    assert policy.action_commands == ActionCommands(("/cmd.data",), ((0.0,), (1.0,), (2.0,)))
    saved = json.loads((run / "mapping.json").read_text())
    assert saved["action"]["representatives"] == [[0.0], [1.0], [2.0]]
    # The saved mapping is a mapping, and reads the same data.
    again = mcaprl.open(bag, mapping=saved)
    assert again.action_commands == policy.action_commands
    np.testing.assert_array_equal(again.actions, mcaprl.open(bag, mapping=mapping).actions)
