"""Tests of the public API: names, import paths, and a function for each command."""

from __future__ import annotations

import ast
import importlib
import inspect
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import mcaprl
from mcaprl.cli import cli
from mcaprl.errors import UsageError
from tests.support.paths import GOLDEN

ROOT = Path(__file__).parent.parent.parent
PACKAGES = ("api", "device", "offline", "online", "recorder", "sims")
CLASSES = (
    "ClusterOptions",
    "Dataset",
    "Episode",
    "Format",
    "OpenBag",
    "RecordMcap",
    "RecordVecMcap",
)
FUNCTIONS = {
    "train-offline": ("train", "sweep", "open", "ClusterOptions"),
    "annotate": ("annotate", "open"),
    "train-online": ("train_online",),
    "convert": ("convert", "suggest_mapping", "open"),
    "info": ("info", "open", "select"),
    "check": ("check", "open"),
    "evaluate": ("evaluate", "estimate", "open", "select"),
    "replay": ("replay", "verify", "render", "browse", "save_page"),
    "drive": ("drive_robot",),
    "completion": (),
}
"""Functions of commands that have several functions, a function with another name, or none, since
only a shell needs them."""
ONLY_OPTIONS = {
    "keep-topic": "`keep_topics` takes the patterns",
    "help": "click adds it",
    "quiet": "a function prints nothing unless the caller passes `progress`",
    "json": "a function returns a dataclass, whose to_json the command prints",
    "env-arg": "an entry of sim_options",
    "convert --dry-run": "out=None",
    "convert --from": "`from` is a keyword of Python: source_format",
    "convert --suggest": "it selects the function suggest_mapping",
    "info --strict": "an exit code",
    "strict": "a key of a mapping",
    "replay --browser": "it selects the function browse",
    "replay --save": "it selects the function save_page",
    "replay --verify": "it selects the function verify",
    "record --no-scene": "scene=False",
    "evaluate --all": "the function returns all estimates",
    "drive --dds": "transport='dds'",
    "drive --ros1": "transport='ros1'",
    "drive --ros2": "transport='ros2'",
    "drive --duration": "duration_s",
    "drive --deadline": "deadline_s",
    "train-offline --sweep": "it selects the function sweep",
    "train-online --from": "`from` is a keyword of Python: sources",
}
"""Options that are not arguments of the function, with the reason."""


def _functions(command: str) -> list[str]:
    return list(FUNCTIONS.get(command, (command,)))


def _options() -> Iterator[tuple[str, click.Option, bool]]:
    """Yield each option of each command, and whether it is a setting of an algorithm."""
    with click.Context(cli, info_name="mcaprl", **cli.context_settings) as top:
        for name, command in cli.commands.items():
            with click.Context(command, info_name=name, parent=top) as context:
                for parameter in command.get_params(context):
                    if isinstance(parameter, click.Option):
                        is_own = parameter in command.params or parameter.name == "help"
                        yield name, parameter, not is_own


@pytest.mark.parametrize("command", cli.commands)
def test_each_command_has_a_documented_function(command: str) -> None:
    for name in _functions(command):
        assert name in dir(mcaprl)
        documentation = inspect.getdoc(getattr(mcaprl, name)) or ""
        for argument in inspect.signature(getattr(mcaprl, name)).parameters:
            assert re.search(rf"^    \**{argument}: ", documentation, re.MULTILINE), argument


def test_each_option_is_an_argument() -> None:
    used = set()
    for command, option, is_setting in _options():
        (flag, *_) = sorted(option.opts, key=len, reverse=True)
        name = flag.lstrip("-")
        signatures = [inspect.signature(getattr(mcaprl, one)) for one in _functions(command)]
        arguments = {one for signature in signatures for one in signature.parameters}
        excuse = {name, f"{command} {flag}"} & set(ONLY_OPTIONS)
        used |= excuse
        argument = "settings" if is_setting else name.replace("-", "_")
        assert argument in arguments or excuse, f"{command} {flag}"
    # Click adds --help through the context.
    assert used == set(ONLY_OPTIONS), "a reason without its option"


def test_defaults_of_options_are_those_of_the_arguments() -> None:
    for command, option, is_setting in _options():
        # A missing default is a marker of Click, which is not a str, an int or a float.
        if is_setting or option.is_flag or not isinstance(option.default, str | int | float):
            continue
        name = max(option.opts, key=len).lstrip("-").replace("-", "_")
        for function in (getattr(mcaprl, one) for one in _functions(command)):
            argument = inspect.signature(function).parameters.get(name)
            assert argument is None or argument.default == option.default, f"{command} {name}"


def test_a_star_import_replaces_nothing_of_others() -> None:
    code = (
        "import builtins, mcaprl; from mcaprl import *\n"
        "public = {name for name in dir() if not name.startswith('__')} - {'builtins', 'mcaprl'}\n"
        "print(sorted(public & {*dir(builtins), 'torch', 'ray'}), open is builtins.open,"
        " sorted({*dir(mcaprl)} - public))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    left_out = ["__version__", "filter", "open", "ray", "slice", "torch"]
    assert done.stdout.strip() == f"[] True {left_out}"


@pytest.mark.parametrize("name", dir(mcaprl))
def test_public_names_have_docstrings(name: str) -> None:
    assert name == "__version__" or inspect.getdoc(getattr(mcaprl, name))


def test_errors_show_their_public_path() -> None:
    assert repr(UsageError) == "<class 'mcaprl.errors.UsageError'>"
    assert mcaprl.McaprlError.__module__ == "mcaprl.errors"


@pytest.mark.parametrize("name", CLASSES)
def test_classes_show_their_public_path(name: str) -> None:
    found = getattr(mcaprl, name)
    assert repr(found) == f"<class 'mcaprl.{name}'>"
    assert pickle.loads(pickle.dumps(found)) is found


def test_datasets_are_pickled_by_the_public_path() -> None:
    data = mcaprl.open(GOLDEN / "discrete.mcap")
    content = pickle.dumps(data)
    assert b"mcaprl.recorder.dataset.dataset" not in content
    assert (pickle.loads(content).rewards == data.rewards).all()


@pytest.mark.parametrize("name", PACKAGES)
def test_names_of_a_package_are_not_those_of_its_modules(name: str) -> None:
    """An imported module would replace a lazy name that equals the module's name."""
    package = importlib.import_module(f"mcaprl.{name}")
    modules = {path.stem for path in Path(package.__path__[0]).iterdir()}
    for public in package.__all__:
        assert public not in modules
        assert getattr(package, public) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = package.nothing


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "examples"])
def test_imports_are_at_most_one_level_deep(folder: str) -> None:
    sources = {path: path.read_text() for path in (ROOT / folder).rglob("*.py")}
    for page in (ROOT / folder).rglob("*.md"):
        blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
        sources[page] = "\n".join(blocks)
    for path, source in sources.items():
        for module in _imported(source):
            assert module.count(".") <= 1, f"{path} imports {module}"


def _imported(source: str) -> Iterator[str]:
    """Yield the modules of mcaprl that Python code imports, also in code within strings."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names if one.name.startswith("mcaprl"))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mcaprl"):
            yield str(node.module)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from re.findall(r"^(?:from|import) (mcaprl[\w.]*)", node.value, re.MULTILINE)


def test_functions_print_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    recording = mcaprl.record("CartPole-v1", "a.mcap", policy="random", episodes=4, seed=1)
    assert (recording.episodes, len(recording.results)) == (4, 4)
    data = mcaprl.open("a.mcap")
    assert recording.steps == len(data)
    assert mcaprl.info("a.mcap").episodes == 4
    assert mcaprl.check(["a.mcap", "b.mcap"]).missing[0].file == "b.mcap"
    assert mcaprl.check("a.mcap").ok
    assert mcaprl.recover("a.mcap", "c.mcap").episodes == 4
    assert mcaprl.verify("a.mcap").difference is None
    (run,) = mcaprl.train(data, "run", algo="bc", updates=5, batch_size=8, hidden=(4,))
    assert run.steps == 5
    found = mcaprl.estimate(["random", "run"], data, updates=3)
    assert set(found.coverage) == {"random", "run"}
    assert found.ranking is not None
    scores = mcaprl.evaluate("run", "CartPole-v1", episodes=2).policies
    assert [score.policy for score in scores] == ["run", "random"]
    assert mcaprl.annotate("a.mcap", "d.mcap", policy="run").steps == len(data)
    assert mcaprl.layout("a.mcap") == mcaprl.layout("a.mcap", "layout.json")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        ("record", {"sim": "CartPole-v1", "episodes": 0}, "`episodes=0`: give"),
        ("record", {"sim": "CartPole-v1", "steps": 0}, "`steps=0`: give"),
        ("record", {"sim": "CartPole-v1", "steps": 9, "envs": 0}, "`envs=0`: give"),
        ("record", {"sim": "CartPole-v1", "steps": 9, "seed": -1}, "`seed=-1`: give"),
        ("record", {"sim": "CartPole-v1", "steps": 9, "epsilon": 1.5}, "`epsilon=1.5`: give"),
        ("evaluate", {"sim": "CartPole-v1", "policies": "random", "episodes": 0}, "`episodes=0`"),
        ("evaluate", {"sim": "CartPole-v1", "policies": "random", "seed": -1}, "`seed=-1`"),
        ("estimate", {"policies": "random", "gamma": float("nan")}, "`gamma=nan`: give"),
        ("estimate", {"policies": "random", "epsilon": 2}, "`epsilon=2`: give"),
        ("estimate", {"policies": "random", "updates": 0}, "`updates=0`: give"),
        ("estimate", {"policies": "random", "seed": -1}, "`seed=-1`: give"),
        ("annotate", {"policy": "run", "gamma": 2}, "`gamma=2`: give"),
        ("render", {"video": "a.gif", "speed": 0}, "`speed=0`: give"),
        ("render", {}, "render needs"),
        ("replay", {"speed": 0}, "`speed=0`: give"),
        ("replay", {"port": 70_000}, "`port=70000`: give"),
        ("check", {"threads": 0}, "`threads=0`: give"),
        ("check", {"data": []}, "the list of files is empty"),
        ("train", {"seeds": 0}, "`seeds=0`: give"),
        ("train", {"threads": 0}, "`threads=0`: give"),
        ("train", {"seed": -1}, "`seed=-1`: give"),
        ("train_online", {"sim": "CartPole-v1", "threads": 0}, "`threads=0`: give"),
        ("train_online", {"sim": "CartPole-v1", "port": -1}, "`port=-1`: give"),
    ],
)
def test_numbers_out_of_range_are_refused_before_anything_is_written(
    function: str, arguments: dict[str, object], message: str, tmp_path: Path
) -> None:
    """Commands check ranges with click. This test shows that the functions check them, too."""
    call, out = getattr(mcaprl, function), tmp_path / "out.mcap"
    log = GOLDEN / "discrete.mcap"
    places = {"data": log, "file": log, "files": log, "out": out}
    known = inspect.signature(call).parameters
    given = {name: place for name, place in places.items() if name in known} | arguments
    with pytest.raises(UsageError, match=message):
        call(**given)
    assert list(tmp_path.iterdir()) == []
