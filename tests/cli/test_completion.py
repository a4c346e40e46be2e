"""Completion in the shells themselves: each loads its script and completes a command line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from mcaprl.cli import cli
from mcaprl.cli.completion import SHELLS
from tests.support.paths import GOLDEN

BASH = """
source ./script
COMP_WORDS=({words} ''); COMP_CWORD={count}
_mcaprl_completion mcaprl
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
ZSH = """
autoload -Uz compinit; compinit -u -D
source ./script
words=({words} ''); CURRENT={count}+1
compadd() {{ print -l $completions }}
_describe() {{ print -l $completions_with_descriptions }}
_mcaprl_completion
"""
FISH = """
source ./script
complete --do-complete '{words} '
"""
PROGRAMS = {"bash": BASH, "zsh": ZSH, "fish": FISH}


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("mcaprl", {"record", "train-offline", "info"}),
        ("mcaprl record", {"lane", "racer"}),
        ("mcaprl record lane --policy", {"pilot", "random"}),
        ("mcaprl train-offline data --algo", {"cql", "iql"}),
        ("mcaprl train-online --preset", {"ddqn-racer"}),
    ],
)
def test_a_shell_completes(shell: str, words: str, expected: set[str], tmp_path: Path) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    script = CliRunner().invoke(cli, ["completion", shell])
    assert script.exit_code == 0
    (tmp_path / "script").write_text(script.output)
    command = tmp_path / "bin" / "mcaprl"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m mcaprl "$@"\n')
    command.chmod(0o755)
    code = PROGRAMS[shell].format(words=words, count=len(words.split()))
    done = subprocess.run(
        [program, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "HOME": str(tmp_path), "PATH": f"{command.parent}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    found = {line.split("\t")[0].split(":")[0] for line in done.stdout.splitlines()}
    assert expected <= found, done


def test_paths_are_completed_where_no_name_fits() -> None:
    env = {"COMP_WORDS": f"mcaprl info {GOLDEN}", "COMP_CWORD": "2"}
    env["_MCAPRL_COMPLETE"] = "bash_complete"
    done = CliRunner().invoke(cli, prog_name="mcaprl", env=env)
    assert done.output == f"file,{GOLDEN}\n"
