"""Tests of the start of the commands: imported modules, pipes, and `--quiet`."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from mcaprl.cli import cli
from mcaprl.cli.help import OPTION_GROUPS
from tests.cli.extras import packages_of_extras
from tests.support.paths import GOLDEN

LANE_LOG = GOLDEN / "lane-1.mcap"
ENGINES = {"torch", "numba", "stable_baselines3", "pygame", "matplotlib", "pandas", "pyarrow"}
ENGINES |= {"ray", "scipy", "jinja2", "pydantic", "h5py", "fsspec", "foxglove", "tensorboard"}
READING = {"mcap", "rosbags", "zstandard", "lz4", "rich"}
RUN = "from mcaprl.cli import run\nimport sys\n"
LOADED = "print(*sorted({name.split('.')[0] for name in sys.modules}), file=sys.stderr)\n"


def loaded_by(*code: str, run: str = RUN) -> set[str]:
    """Run code in a new interpreter; return the names of the packages that it has imported."""
    done = subprocess.run(
        [sys.executable, "-c", run + "\n".join(code) + "\n" + LOADED],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stderr.split())


def test_no_help_imports_an_engine_or_reads_logs() -> None:
    loaded = loaded_by(*(f"assert run([{name!r}, '--help']) == 0" for name in cli.commands))
    assert not loaded & (ENGINES | READING)


def test_help_needs_no_extra() -> None:
    """Packages that only extras install are not found, as after an installation without any."""
    code = f"""import sys
from importlib.machinery import PathFinder
class Installed(PathFinder):
    def find_spec(name, *others):
        is_missing = name.partition(".")[0] in {sorted(packages_of_extras())!r}
        return None if is_missing else PathFinder.find_spec(name, *others)
sys.meta_path = [Installed if one is PathFinder else one for one in sys.meta_path]
sys.argv = ["mcaprl"]
from mcaprl.cli import cli, run
for name in cli.commands:
    assert run([name, "--help"]) == 0, name
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stderr
    for name in ("train-online", "train-offline"):
        assert f"mcaprl {name} " in done.stdout
        assert "--gamma" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["--version"], ["train-offline", "--help"], ["train-online", "--help"]],
)
def test_help_imports_no_numpy_and_registers_no_environment(arguments: list[str]) -> None:
    code = f"sys.argv = ['mcaprl']\nfrom mcaprl.cli import run\nassert run({arguments}) == 0"
    assert not loaded_by(code, run="import sys\n") & {"numpy", "gymnasium"}


def test_a_command_registers_the_environments() -> None:
    code = f"""sys.argv = ["mcaprl"]
from mcaprl.cli import run
assert run(["info", {str(LANE_LOG)!r}, "--json"]) == 0
import gymnasium
assert "mcaprl/LaneKeeping-v0" in gymnasium.registry
"""
    assert "gymnasium" in loaded_by(code, run="import sys\n")


WAITING = {
    "record": ("record", "lane", "--episodes", "1", "--out", "OUT.mcap"),
    "train-online": ("train-online", "lane", "--out", "OUT"),
    "train-offline": ("train-offline", "LOG", "--out", "OUT"),
    "evaluate": ("evaluate", "pilot", "--sim", "lane"),
    "evaluate --data": ("evaluate", "pilot", "--data", "LOG"),
    "export": ("export", "LOG", "--out", "OUT.onnx"),
    "info": ("info", "LOG"),
    "replay": ("replay", "LOG"),
    "replay --browser": ("replay", "LOG", "--browser"),
    "replay --save": ("replay", "LOG", "--save", "OUT.html"),
    "replay --verify": ("replay", "LOG", "--verify"),
    "layout": ("layout", "LOG", "--out", "-"),
    "drive": ("drive", "LOG", "--bag", "LOG"),
    "annotate": ("annotate", "LOG", "--scene", "--out", "OUT.mcap"),
    "check": ("check", "LOG"),
    "recover": ("recover", "LOG", "OUT.mcap"),
    "convert": ("convert", "LOG", "OUT.npz", "--to", "npz"),
    "convert --suggest": ("convert", "--suggest", "LOG"),
    "merge": ("merge", "LOG", "LOG", "OUT.mcap"),
    "split": ("split", "LOG", "OUT", "--ratio", "1:1"),
    "filter": ("filter", "length > 1", "LOG", "OUT.mcap"),
    "slice": ("slice", "LOG", "OUT.mcap", "--steps", "0:9"),
    "label": ("label", "LOG"),
    "relabel": ("relabel", "LOG", "OUT.mcap", "--reward", "reward"),
}
"""Arguments of each command that works; its name is the key's first word."""


def test_every_command_is_checked_for_its_first_output() -> None:
    assert {key.split()[0] for key in WAITING} == set(cli.commands) - {"completion"}


@pytest.mark.parametrize("name", WAITING)
def test_a_terminal_shows_what_a_command_does_before_the_long_imports(
    name: str, tmp_path: Path
) -> None:
    code = """
import os, sys
class StopAtNumPy:
    def find_spec(self, name, *_):
        if name == "numpy":
            os._exit(3)
sys.meta_path.insert(0, StopAtNumPy())
from mcaprl.cli import main
main()
"""
    program = tmp_path / "mcaprl"
    program.write_text(code)
    arguments = [
        word.replace("OUT", str(tmp_path / "out")).replace("LOG", str(LANE_LOG))
        for word in WAITING[name]
    ]
    shown, _ = on_a_terminal(str(program), *arguments, module=(), code=3)
    assert shown.strip()


def test_commands_on_logs_import_no_engine_and_no_writer() -> None:
    code = [f"assert run(['info', {str(LANE_LOG)!r}, '--json']) == 0"]
    code += ["assert 'mcaprl.recorder.columns.writer' not in sys.modules"]
    loaded = loaded_by(*code)
    assert not loaded & ENGINES
    assert "mcap" in loaded


def on_a_terminal(
    *arguments: str,
    stdout: int | None = None,
    module: tuple[str, ...] = ("-m", "mcaprl"),
    code: int = 0,
    **env: str,
) -> tuple[bytes, bytes]:
    """Run a command with a terminal as its stderr, and as its stdout if `stdout` is None.

    Args:
        *arguments: Arguments of the command.
        stdout: Standard output, if it is not the terminal.
        module: Arguments of Python before those of the command.
        code: Expected exit code.
        **env: Environment variables.

    Returns:
        Output on the terminal, and output on stdout if stdout is a pipe.
    """
    terminal, inner = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, *module, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=inner if stdout is None else stdout,
        stderr=inner,
        env={**os.environ, "TERM": "xterm-256color", **env},
    )
    os.close(inner)
    shown = b""
    while True:
        try:
            part = os.read(terminal, 65_536)
        except OSError:  # The command has closed the terminal.
            break
        if not part:
            break
        shown += part
    piped = process.communicate()[0] or b""
    os.close(terminal)
    assert process.returncode == code, shown
    return shown, piped


def test_a_terminal_shows_progress_and_a_pipe_gets_results_only(tmp_path: Path) -> None:
    data = tmp_path / "log.mcap"
    shown, piped = on_a_terminal(
        *("record", "CartPole-v1", "--policy", "random", "--episodes", "2", "--out", str(data)),
        stdout=subprocess.PIPE,
    )
    assert b"loading the sim and the policy" in shown
    assert piped.startswith(f"{data}: 2 episodes".encode())
    assert b"\x1b" not in piped


def test_quiet_shows_no_progress() -> None:
    shown, _ = on_a_terminal("check", str(LANE_LOG), "--quiet")
    assert shown.strip() == b"1 file checked, no problems"


def test_no_color_is_honored() -> None:
    shown, _ = on_a_terminal("info", str(LANE_LOG), NO_COLOR="1")
    codes = {code for part in shown.split(b"\x1b[")[1:] for code in part.split(b"m")[0].split(b";")}
    assert not codes & {str(color).encode() for color in range(30, 50)}


def test_quiet_omits_hints(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mcaprl", "layout", str(LANE_LOG), "--overwrite", "--out"]
    command += [str(tmp_path / "layout.json")]
    usual = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    quiet = subprocess.run([*command, "-q"], capture_output=True, text=True, check=True).stdout
    assert "Foxglove" in usual
    assert quiet == f"{tmp_path / 'layout.json'}: written\n"


def test_a_closed_pipe_ends_a_command_silently() -> None:
    command = f"{sys.executable} -m mcaprl info {LANE_LOG} | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stderr == ""


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_options_are_grouped(name: str) -> None:
    command = cli.commands[name]
    own = {param.name for param in command.params if param.param_type_name == "option"}
    groups = OPTION_GROUPS.get(name, {})
    grouped = [option for options in groups.values() for option in options]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) <= own
    assert max([len(own - set(grouped)), *map(len, groups.values())]) <= 9


@pytest.mark.parametrize(
    ("program", "module"),
    [("/usr/bin/mcaprl", ""), ("-m", "mcaprl"), ("-m", "robot.train"), ("train.py", "")],
)
def test_ctrl_c_during_the_imports_is_one_line(program: str, module: str) -> None:
    code = f"""
import os, signal, sys
class StopAtClick:
    def find_spec(self, name, *_):
        if name == "click":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, StopAtClick())
sys.argv, sys.orig_argv = [{program!r}, "--help"], ["python", "-m", {module!r}, "--help"]
signal.signal(signal.SIGINT, signal.default_int_handler)
from mcaprl.cli import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == ""
    if program == "train.py" or module == "robot.train":
        assert "Traceback" in done.stderr, "other programs handle the signal themselves"
    else:
        assert (done.returncode, done.stderr) == (130, "mcaprl: interrupted\n")
