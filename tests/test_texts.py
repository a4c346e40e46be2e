"""Tests of the escaping of texts from data before they are shown or written."""

from __future__ import annotations

import pytest

from mcaprl.texts import encodable, printable, shortened


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\rb\x08\x7f", r"a\rb\x08\x7f"),
        ("\x9b2J\x85", r"\x9b2J\x85"),
        ("\u202eabc\u2066\u200f", r"\u202eabc\u2066\u200f"),
        ("\udcff", r"\udcff"),
        ("two\nlines\tö 日本 🚗", "two\nlines\tö 日本 🚗"),
    ],
)
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_texts_that_utf_8_cannot_encode_are_escaped() -> None:
    assert encodable("crash\ud800 ö") == r"crash\ud800 ö"


def test_long_texts_are_shortened() -> None:
    assert shortened("abcdef", 6) == "abcdef"
    assert shortened("abcdefg", 6) == "abc..."
