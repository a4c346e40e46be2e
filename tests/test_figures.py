"""Tests that figures show texts from data unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaprl.page import new_figure, save_png, tick_labels, to_svg

BAD = r"$\bad$"


@pytest.mark.parametrize("name", [BAD, "$", "x$_$", "a\x00\x1bb", "\udcff.mcap", "w" * 10**6])
def test_any_text_can_be_drawn(tmp_path: Path, name: str) -> None:
    figure, axes = new_figure((9, 6))
    axes.plot([0, 1], label=f"a {name}")
    axes.set_title(name).set_in_layout(False)
    axes.annotate(name, (0.5, 0.5)).set_in_layout(False)
    axes.set_yticks([0, 1], tick_labels([name, "b"]))
    axes.legend().set_in_layout(False)
    figure.suptitle(name)
    save_png(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size < 10**7
    assert len(to_svg(figure)) < 10**5


def test_formulas_are_not_interpreted() -> None:
    figure, axes = new_figure((4, 3))
    axes.set_title("$x^2$")
    assert "$x^2$" in to_svg(figure)
