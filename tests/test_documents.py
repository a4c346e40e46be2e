"""JSON and YAML files with impossible values are one error, with the place."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest

from mcaprl.errors import TrainingError, UsageError
from mcaprl.files import as_type, read_json, read_yaml
from mcaprl.offline.selection.choice import Rating

BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [1\nb: 2", "settings.yaml:2: not YAML: "),
        ("a: !!int abc", "a value cannot be read: invalid literal"),
        ("a: !!bool x", "a value cannot be read: 'x'"),
        ("a: 2024-13-45", "a value cannot be read: month must be in 1..12"),
        (f"a: {'9' * 5000}", "a value cannot be read: Exceeds the limit"),
        ("a: &a [*a]", "nested more than 100 levels deep"),
        (f"a: {'[' * 150}{']' * 150}", "nested more than 100 levels deep"),
        (f"a: {'[' * 5000}", "nested more than 100 levels deep"),
        (BOMB, "more than 100,000 values, with all aliases"),
        ("#" * (2**21 + 1), "has more than 2097152 bytes"),
        ("a: \x01", "special characters are not allowed"),
    ],
)
def test_yaml_files_that_cannot_be_read(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(UsageError) as raised:
        read_yaml(path, "bags")
    assert reason in str(raised.value)
    assert str(raised.value).startswith(str(path))


@pytest.mark.parametrize("text", ["{[[a]]: b}", "? [{a: b}]\n: c", "{a: &b {<<: *b}}"])
def test_impossible_keys_of_mappings(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"mapping\.yaml"):
        read_yaml(path, "bags", with_lines=True)


def test_yaml_files_have_aliases_and_lines(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text("a: &a {x: 1}\nb: *a\n")
    assert read_yaml(path, "bags") == {"a": {"x": 1}, "b": {"x": 1}}
    assert read_yaml(path, "bags", with_lines=True).lc.key("b") == (1, 0)


class Row(NamedTuple):
    """A record with a value of each kind."""

    steps: int
    share: float = 0.5
    name: str | None = None
    sizes: tuple[int, ...] = ()
    mode: Literal["a", "b"] = "a"
    flag: bool = False


def test_records_have_the_types_of_their_fields() -> None:
    found = as_type(Row, {"steps": 2, "share": 1, "sizes": [3], "mode": "b", "more": {}})
    assert found == Row(2, 1.0, None, (3,), "b")
    assert type(found.share) is float
    # NaN is null in JSON.
    assert math.isnan(as_type(Row, {"steps": 2, "share": None}).share)
    assert as_type(Row, {"steps": 2, "name": "\ud800"}).name == "\\ud800"
    rating = {"value": 1, "interval": [0, 2], "agreement": 1, "score": 1, "best_chance": None}
    assert as_type(dict[str, Rating], {"cql": rating})["cql"].interval == (0.0, 2.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"steps": "2"}, "steps must be a whole number, got '2'"),
        ({"steps": True}, "steps must be a whole number, got 'True'"),
        ({"steps": 2.0}, "steps must be a whole number"),
        ({"steps": None}, "steps must be a whole number"),
        ({"steps": 10**30}, "steps must be a whole number"),
        ({"share": 10**30}, "share must be a number"),
        ({"share": True}, "share must be a number"),
        ({"name": 3}, "name must be a text, got '3'"),
        ({"sizes": 3}, "sizes must be a list, got '3'"),
        ({"sizes": ["3"]}, "sizes must be a whole number"),
        ({"mode": []}, "mode must be one of a, b"),
        ({"flag": 1}, "flag must be true or false"),
    ],
)
def test_wrong_types_are_named(change: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        as_type(Row, {"steps": 1, **change})


def test_missing_parts_are_named(tmp_path: Path) -> None:
    path = tmp_path / "row.json"
    for text, reason in (
        ("{}", "it has no steps"),
        ("[]", "it must be an object"),
        ("{", "Expecting property name"),
        ("\ufeff", "Expecting value"),
        ("[" * 100_000, "nested more than 100 levels deep"),
        (f'{{"steps": {"9" * 5000}}}', "Exceeds the limit"),
    ):
        path.write_text(text)
        with pytest.raises(TrainingError, match=reason) as raised:
            read_json(path, TrainingError, Row)
        assert str(raised.value).startswith(f"{path} cannot be read")
    path.write_bytes(b"\xff\xfe{")
    with pytest.raises(TrainingError, match="cannot be read"):
        read_json(path, TrainingError)
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none", TrainingError)
