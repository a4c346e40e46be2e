"""Tests of help texts: each command is listed, its examples parse, and settings are grouped."""

from __future__ import annotations

import itertools
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import mcaprl
from mcaprl.cli import cli
from mcaprl.cli.help import EXAMPLES, SECTIONS
from mcaprl.cli.settings import SettingsCommand
from mcaprl.offline.algorithms.config import BCConfig
from tests.support.paths import GOLDEN

TOP = click.Context(cli, info_name="mcaprl", **cli.context_settings)
LINES = [(name, line) for name, lines in EXAMPLES.items() for line in lines]


def help_of(*arguments: str) -> str:
    """Return a command's help, 80 columns wide."""
    result = CliRunner().invoke(cli, [*arguments, "--help"], terminal_width=80)
    assert result.exit_code == 0
    return result.output


def test_every_command_is_in_one_section_and_has_examples() -> None:
    listed = [name for names in SECTIONS.values() for name in names]
    assert sorted(listed) == sorted(cli.commands) == sorted(EXAMPLES)


@pytest.mark.parametrize(("name", "line"), LINES)
def test_an_example_is_a_valid_command_line(name: str, line: str) -> None:
    words = shlex.split(line)
    program, command, *arguments = itertools.takewhile(lambda word: word not in (">", ">>"), words)
    assert (program, command) == ("mcaprl", name)
    found = cli.get_command(TOP, name)
    assert found is not None
    found.make_context(name, arguments, parent=TOP)
    assert line in help_of(name)


def test_summaries_are_not_cut_and_lines_fit() -> None:
    text = help_of()
    for name, command in cli.commands.items():
        summary = " ".join((command.help or "").split("\n\n")[0].split())
        assert summary.split(". ")[0].removesuffix(".") in " ".join(text.split()), name
    for output in (text, *(help_of(name) for name in cli.commands)):
        shown = output.split("Examples:")[0]
        assert max(map(len, shown.splitlines())) <= 80


def test_settings_are_listed_with_the_algorithms_that_have_them() -> None:
    text = help_of("train-offline")
    sections = {part.split(":")[0]: part for part in text.split("\nSettings of ")[1:]}
    assert "--updates" in sections["all algorithms"]
    assert "--expectile" in sections["iql, iql (Box)"]
    learners = " ".join(text.split())
    assert "of dqn, double-dqn, cql, bcq, iql, td3-bc, rebrac, iql (Box), auto: --gamma" in learners
    assert "--dueling" in sections["dqn, double-dqn, cql, bcq"]
    assert "--gamma" not in sections["all algorithms"]
    online = help_of("train-online")
    assert "Settings of dqn, double-dqn:" in online
    assert "Settings of ppo:" in online


def test_defaults_that_differ_between_algorithms_and_sims_are_all_shown() -> None:
    offline, online = (
        " ".join(help_of(command).split()) for command in ("train-offline", "train-online")
    )
    assert "[default: 500; iql: 50; td3-bc, rebrac: 2; iql (Box): 1; auto: 150]" in offline
    assert "[default: 10.0; ppo, a2c: 0.5]" in online
    sizes = (
        "[default: 32; sac, td3, tqc, lane (continuous), powerline (continuous): 256; ppo: 64;"
        " lane, racer, powerline, highway-lane, racer (continuous), highway-lane (continuous): 128]"
    )
    assert sizes in online.replace("highway- lane", "highway-lane")
    switch = SettingsCommand(
        "switch", configs=lambda: {"one": BCConfig(), "two": BCConfig(normalize=True)}
    )
    (option,) = [each for each in switch.get_params(TOP) if each.name == "normalize"]
    assert isinstance(option, click.Option)
    assert (option.help or "").endswith("[default: no; two: yes]")


def test_the_condition_of_the_filter_example_is_valid(tmp_path: Path) -> None:
    ((line,), out) = EXAMPLES["filter"], tmp_path / "out.mcap"
    condition = shlex.split(line)[2].replace("100", "5")
    arguments = ["filter", condition, str(GOLDEN / "lane-1.mcap"), str(out)]
    assert CliRunner().invoke(cli, arguments).exit_code == 0
    assert len(mcaprl.open(out).episodes) == 1
