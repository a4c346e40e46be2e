"""Lines and tables fit a narrow terminal without broken words."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import click
import pytest

import mcaprl
from mcaprl.cli import cli, run
from mcaprl.cli.show import as_options, echo, print_table
from mcaprl.errors import LogError, OutputExistsError

COLUMNS = ["policy", "mean return", "95 % interval", "IQM", "random 0, pilot 1", "success", "ends"]
ROWS = [
    ["behavior, as logged", "26.42", "20.62 to 32.63", "", "0.190", "", "200 episodes"],
    ["double-dqn", "5.31", "4.50 to 6.00", "4.90", "0.055", "1%", "119 off_lane, 1 time_limit"],
]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")


def shown_in_terminal(show: Callable[[], None]) -> str:
    with redirect_stdout(Terminal()) as terminal:
        show()
    return terminal.getvalue()


def test_a_table_breaks_no_word_at_80_columns() -> None:
    shown = shown_in_terminal(lambda: print_table("scores", COLUMNS, ROWS))
    assert max(map(len, shown.splitlines())) <= 80
    words = {word for row in [COLUMNS, *ROWS] for cell in row for word in cell.split()}
    assert words <= set(shown.split())


def test_a_table_uses_the_width_that_it_needs() -> None:
    shown = shown_in_terminal(lambda: print_table("scores", ["a", "b"], [["one two", "three"]]))
    assert "│ one two │ three │" in shown


def test_words_that_cannot_fit_are_broken() -> None:
    shown = shown_in_terminal(lambda: print_table("names", ["a", "b"], [["x" * 100, "y" * 100]]))
    assert max(map(len, shown.splitlines())) <= 80
    assert (shown.count("x"), shown.count("y")) == (100, 100)


def test_a_long_line_is_wrapped_between_words() -> None:
    line = " ".join(f"runs/double-dqn/seed-{number}" for number in range(9))
    lines = shown_in_terminal(lambda: echo(line)).splitlines()
    assert max(map(len, lines)) <= 80
    assert " ".join(" ".join(lines).split()) == line


def test_a_line_in_a_pipe_is_not_wrapped(capsys: pytest.CaptureFixture[str]) -> None:
    echo("word " * 100)
    assert capsys.readouterr().out == "word " * 100 + "\n"


def test_a_function_names_its_argument_and_a_command_its_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.json"
    path.touch()
    with pytest.raises(OutputExistsError, match=r"choose another path, or pass `overwrite=True`$"):
        mcaprl.layout("lane", path)
    assert run(["layout", "lane", "--out", str(path)]) == 2
    assert capsys.readouterr().err.endswith("choose another path, or pass --overwrite\n")


def test_an_argument_in_a_quoted_message_or_a_table_becomes_an_option() -> None:
    error = LogError(f"a: {LogError('pass `one_episode=True` or `dones=`')}")
    assert as_options(str(error)) == "a: pass --one-episode or --dones"
    shown = shown_in_terminal(lambda: print_table("", ["a"], [["pass `shift=True`"]]))
    assert "│ pass --shift │" in " ".join(shown.split())


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("`algo='auto'` or `speed=0.5`", "--algo auto or --speed 0.5"),
        ("`behavior='a`b'` is odd", "--behavior a`b is odd"),
        ("`sources=`, `sim_options={'map_name': 'a b'}`", "--from, --env-arg 'map_name=\"a b\"'"),
        ("`sim_options={'actions': 'continuous'}`", "--actions continuous"),
        ("`sim_options={'config': {'a b'…`", "--env-arg {'config': {'a b'…"),
        ("set `missing`, or `x: 1`; `/rl/step`", "set `missing`, or `x: 1`; `/rl/step`"),
    ],
)
def test_forms_of_arguments(message: str, expected: str) -> None:
    assert as_options(message) == expected


def test_every_argument_becomes_the_option_of_its_command() -> None:
    options = [
        option
        for command in cli.commands.values()
        for option in command.params
        if isinstance(option, click.Option)
    ]
    others = {one.name for one in options if as_options(f"`{one.name}=`") not in one.opts}
    # These options are not arguments of functions.
    only_options = {"as_json", "keep_all", "shows_all", "source_format"}
    assert others == {*only_options, "strict_mapping", "verifies"}
