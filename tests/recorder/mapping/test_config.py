"""Mapping files: errors name file, line and key."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaprl.errors import UsageError
from mcaprl.recorder.mapping.config import Mapping, load_mapping, parse_mapping

GOOD = """\
clock: {rate_hz: 10}
observation:
  speed:
    field: /odom.speed
    clip: [0, 1]
action: {field: /mode.data}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_good_mapping_has_defaults(tmp_path: Path) -> None:
    found, place = load_mapping(written(tmp_path, GOOD))
    assert found.time == "log_time"
    assert found.observation["speed"].clip == (0, 1)
    assert found.episodes.gap_s == 2
    assert place.of("observation", "speed", "clip").endswith(":5: observation.speed.clip")


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("clip:", "clap:", ":5: observation.speed.clap: unknown key; nearest: clip"),
        ("clip: [0, 1]", "clip: [1, 0]", ":3: observation.speed: clip must be the lowest value"),
        (
            "clip: [0, 1]",
            "clip: [a, 1]",
            ":5: observation.speed.clip.0: Input should be",
        ),
        ("action: {field: /mode.data}", "", ": action: this key is missing"),
        ("rate_hz: 10", "rate_hz: -1", ":1: clock.rate_hz: Input should be greater than 0"),
        ("rate_hz: 10", "rate_hz: 10, topic: /a", ":1: clock: give either rate_hz or topic"),
        ("{field: /mode.data}", "{fields: [/a.b]}", "action: fields need one of actions, edges"),
        ("{field: /mode.data}", "{fields: [/a.b, /a.c], edges: [[1]]}", "needs 2 entries, one"),
        ("{field: /mode.data}", "{fields: [/a.b], edges: [[2, 1]]}", "action: edges must rise"),
        (
            "{field: /mode.data}",
            "{fields: [/a.b], edges: [[1, 2]], bins: [[slow, fast]]}",
            "action: bins need one name more than edges, for each element of the command",
        ),
        (
            "{field: /mode.data}",
            "{fields: [/a.b], edges: [[1]], bins: [[slow, slow]]}",
            "action: bins of an element need different names",
        ),
        ("  speed:", "  a-b:", "observation has"),
        ("speed:", "action:", "'action' has another meaning in expressions: use another name"),
        ("speed:", "truncated:", "'truncated' has another meaning in expressions"),
        ("speed:", "if:", "'if' has another meaning in expressions"),
        ("clock:", "clocks:", ":1: clocks: unknown key; nearest: clock"),
        ("clip: [0, 1]", "resize: [4, 4]", "observation.speed: resize is for images only"),
        ("{rate_hz: 10}", "{rate_hz: 10", "not YAML"),
        ("rate_hz: 10", "rate_hz: .inf", ":1: clock.rate_hz: Input should be less than or equal"),
        ("rate_hz: 10", "rate_hz: 1e300", ":1: clock.rate_hz: Input should be less than or equal"),
        ("clock:", f"stack: {10**9}\nclock:", ":1: stack: Input should be less than or equal to 1"),
        ("clock:", f"stack: {2**63}\nclock:", ":1: stack: Input should be less than or equal to 1"),
        ("clip: [0, 1]", "missing: .nan", ":5: observation.speed.missing: Input should be a fin"),
        ("clip: [0, 1]", "clip: [.nan, 1]", "clip must be the lowest value"),
        ("clip: [0, 1]", "clip: [0, 1e300]", "clip must be the lowest value"),
        ("{field: /mode.data}", "{}", "action: give either field or fields, or expressions"),
        ("{field: /mode.data}", "{field: /a.b, expressions: [x]}", "action: give either field or"),
        ("{field: /mode.data}", "{expressions: [x]}", "expressions need one of actions, edges"),
        ("{field: /mode.data}", "{field: /a.b, names: [x]}", "a list of names is for `fields`"),
        (
            "{field: /mode.data}",
            "{expressions: [x], edges: [[1], [2]]}",
            "edges needs 1 entries, one for each of expressions",
        ),
        (
            "{field: /mode.data}",
            f"{{fields: [/a.b], edges: {[[*range(10)]] * 8}}}",
            "action: edges have 214358881 combinations; at most 1048576 are possible",
        ),
        ("{field: /mode.data}", "{fields: [/a.b], edges: [[.nan]]}", "Input should be a finite"),
        (
            "{field: /mode.data}",
            "{fields: [/a.b], box: {low: 1, high: 0}}",
            ":6: action.box: low must not be above high: entry 0 is 1, 0",
        ),
        (
            "{field: /mode.data}",
            "{fields: [/a.b, /a.c], box: {low: [0, .nan], high: 1}}",
            "low must not be above high: entry 1 is nan, 1",
        ),
        (
            "{field: /mode.data}",
            "{fields: [/a.b], box: {low: [0, 0], high: [1, 1, 1]}}",
            "low has 2 entries, but high has 3",
        ),
        (
            "{field: /mode.data}",
            "{fields: [/a.b], box: {low: [], high: 1}}",
            "low has 0 entries, but high has 1",
        ),
        ("{field: /mode.data}", "{fields: [/a.b], box: {low: .inf, high: .inf}}", "entry 0 is inf"),
    ],
)
def test_errors_name_file_line_and_key(tmp_path: Path, old: str, new: str, expected: str) -> None:
    path = written(tmp_path, GOOD.replace(old, new))
    if expected == "observation has":
        expected = "'a-b' cannot be used in expressions"
    with pytest.raises(UsageError) as error:
        load_mapping(path)
    assert str(path) in str(error.value)
    assert expected in str(error.value)


def test_all_errors_are_in_one_line(tmp_path: Path) -> None:
    path = written(tmp_path, "stack: 0")
    with pytest.raises(UsageError) as error:
        load_mapping(path)
    assert str(error.value) == (
        f"{path}: clock: this key is missing; {path}: observation: this key is missing;"
        f" {path}:1: stack: Input should be greater than or equal to 1;"
        f" {path}: action: this key is missing"
    )


def test_files_that_are_not_mappings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        load_mapping(tmp_path / "none.yaml")
    with pytest.raises(UsageError, match="a mapping has keys and values"):
        load_mapping(written(tmp_path, "- a\n- b\n"))
    (tmp_path / "robot.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="is not UTF-8 text"):
        load_mapping(tmp_path / "robot.yaml")


@pytest.mark.parametrize(
    "value",
    ["2024-13-45", "!!int abc", "!!float abc", "9" * 5000, "[" * 900, "{a: " * 900],
)
def test_values_that_yaml_cannot_convert_are_one_line(tmp_path: Path, value: str) -> None:
    path = written(tmp_path, GOOD.replace("rate_hz: 10", f"rate_hz: {value}"))
    with pytest.raises(UsageError) as error:
        load_mapping(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_yaml_tags_make_no_objects(tmp_path: Path) -> None:
    tagged = GOOD.replace("{rate_hz: 10}", "!!python/object/apply:os.system ['true']")
    with pytest.raises(UsageError, match="clock"):
        load_mapping(written(tmp_path, tagged))


def test_a_mapping_without_a_file_is_named_mapping() -> None:
    with pytest.raises(UsageError, match=r"^mapping: clock: this key is missing"):
        parse_mapping({})


def test_every_key_has_a_description() -> None:
    pending = [Mapping.model_json_schema()]
    for definition in (*pending, *pending[0]["$defs"].values()):
        for name, key in definition.get("properties", {}).items():
            assert key.get("description"), name
