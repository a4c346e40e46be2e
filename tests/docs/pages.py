"""Runner of the code in Markdown pages, in order, in one folder for each page.

`python`, `sql` and `js` blocks are run as a whole, and `sh` blocks command by command. A block with
the language `output` shows the output of the block before it; `...` matches any text. Hidden
comments in the page describe the next block:

    <!-- file: NAME -->                      content of a file
    <!-- skip: next "REASON" -->             not run
    <!-- skip: next if(quick, "REASON") -->  not run in a quick run

Commands that a reader does not need to see are also in a comment:

    <!-- invisible-code-block: sh
    mcaprl record lane --out lane.mcap
    -->

A page runs as it is written, or quickly with smaller numbers of episodes, steps and updates. If a
number was made smaller, the output is not compared.
"""

from __future__ import annotations

import contextlib
import doctest
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import tomllib
from importlib.util import find_spec
from pathlib import Path
from unittest import SkipTest

from sybil import Document, Example
from sybil.example import NotEvaluated
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser
from sybil.parsers.markdown.lexers import DirectiveInHTMLCommentLexer, FencedCodeBlockLexer
from sybil.region import Region

from mcaprl.cli import run

ROOT = Path(__file__).parent.parent.parent
NODE_MODULES = ROOT / "tests" / "node" / "node_modules"
# Languages of blocks that are not run.
PROSE = {"text", "{toctree}"}
# Largest values of options in a quick run, and options that are added to a command.
LARGEST = {"--episodes": 10, "--steps": 200, "--updates": 30, "--seeds": 2}
ADDED = {
    "train-offline": "--updates 30 --hidden 16,16 --gamma 0.5 --target-interval 3",
    "train-offline --sweep": "",
    "train-offline bc": "--updates 30 --hidden 16,16",
    "train-online": "--steps 200 --envs 2 --eval-episodes 1 --final-episodes 1 --hidden 16,16",
    "train-online --device": "--steps 800 --envs 2 --final-episodes 1 --hidden 16,16",
    "evaluate": "--episodes 2",
    "evaluate --data": "--updates 10",
    "replay --video": "--speed 60",
}
# Without one of these options, `replay` runs until Ctrl-C.
REPLAY_ENDS = {"--verify", "--video", "--contact-sheet", "--save"}
SERVER_STARTS = "press Ctrl-C"
# CPU time from which on a block of commands is slow, and distance of the words that announce it.
SLOW_S, NEAR = 90.0, 500
LONGEST_SERVICE_S = 120.0
# A command that ends before it serves ends like other commands.
INTERRUPTED = "interrupted"


class Run:
    """One run of a page.

    Attributes:
        quick: Whether numbers of episodes, steps and updates are made smaller.
        changed: Whether a command was made smaller, so that its output differs from the page's.
        printed: Output of the last block; None if it was not run.
        absent: Folders that are missing in a quick run, because it does not run the examples.
    """

    def __init__(self, *, quick: bool) -> None:
        """Prepare a run."""
        self.quick = quick
        self.changed = False
        self.printed: str | None = None
        self.absent: set[str] = set()

    def page(self, path: Path) -> None:
        """Run the code of a page in the current folder."""
        document = self.parse(path)
        document.namespace.update(quick=self.quick, __name__="__main__")
        for example in document.examples():
            printed = io.StringIO()
            try:
                with contextlib.redirect_stdout(printed):
                    example.evaluate()
            except SkipTest:
                self.printed = None
            else:
                if example.region.evaluator != self.compare:
                    self.printed = printed.getvalue()

    def parse(self, path: Path) -> Document:
        """Return the blocks of a page."""
        return Document.parse(
            str(path),
            PythonCodeBlockParser(),
            CodeBlockParser("sh", self.shell),
            CodeBlockParser("sql", _query),
            CodeBlockParser("js", _node),
            CodeBlockParser("output", self.compare),
            CodeBlockParser("yaml", _refuse),
            CodeBlockParser("toml", _check_toml),
            _file_comments,
            SkipParser(),
        )

    def shell(self, example: Example) -> None:
        """Run the commands of an `sh` block in one shell.

        In a quick run, run them in this process.
        """
        script: list[str] = []
        began_s = _cpu_s()
        for line in commands(example.parsed):
            words = shlex.split(line)
            if self._other_program(words):
                continue
            is_plain = words[0] == "mcaprl" and "||" not in words
            if _serves(words) or (self.quick and is_plain):
                _sh(script)
                status = _serve(words) if _serves(words) else self._smaller(words)
                assert status == 0, f"{example.path}:{example.line}: `{line}` exits with {status}"
            else:
                script.append(line)
        _sh(script)
        spent_s, region = _cpu_s() - began_s, example.region
        near = example.document.text[max(region.start - NEAR, 0) : region.end + NEAR]
        assert self.quick or spent_s < SLOW_S or re.search(r"\b(minute|hour)s?\b", near), (
            f"{example.path}:{example.line}: {spent_s:.0f} s of CPU time are not announced"
        )

    def compare(self, example: Example) -> None:
        """Compare an `output` block with the output of the last block."""
        if self.changed or self.printed is None:
            return
        wanted, got = _lines(example.parsed), _lines(self.printed)
        same = doctest.OutputChecker().check_output(wanted, got, doctest.ELLIPSIS)
        assert same, f"{example.path}:{example.line}: the output is\n{got}"

    def _other_program(self, words: list[str]) -> bool:
        """Return whether a command is not run, and check that the files in it exist.

        Installations, targets of the Makefile and benchmarks need other environments and up to
        hours. Examples take minutes, so a quick run omits them.
        """
        match words:
            case ["make", *targets]:
                rules = (ROOT / "Makefile").read_text()
                paths = [target.replace(".venv", "$(VENV)") for target in targets]
                assert all(f"\n{path}:" in rules for path in paths), targets
            case ["pip", "install", *_]:
                extras = re.findall(r"\[(.*?)\]", " ".join(words))
                settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
                known = settings["project"]["optional-dependencies"]
                assert set(",".join(extras).split(",")) <= {*known, ""}, extras
            case ["python", "-m", module, *_] if module.startswith(("benchmarks", "tests")):
                assert find_spec(module), module
            case ["sh" | "python", path, *_] if path.startswith(("examples/", "benchmarks/")):
                assert (ROOT / path).is_file(), path
                self.absent |= {words[-1]}
                return self.quick or path.startswith("benchmarks/")
            case _:
                folders = {word.split("/")[0] for word in words}
                return self.quick and bool(folders & self.absent)
        return True

    def _smaller(self, words: list[str]) -> int:
        """Run a command of mcaprl in this process, with smaller numbers."""
        words = [word for word in words if word != "&"]
        place = words.index(">") if ">" in words else len(words)
        smaller = _smaller(words[1:place])
        self.changed |= smaller != words[1:place]
        with contextlib.ExitStack() as stack:
            if place < len(words):
                file = stack.enter_context(Path(words[place + 1]).open("w"))
                stack.enter_context(contextlib.redirect_stdout(file))
            return run(smaller)


def commands(block: str) -> list[str]:
    """Return the commands of an `sh` block: without comments, each on one line."""
    lines = re.sub(r"\\\n\s*", "", block)
    quoted = re.split(r"""((?:[^"'\n]|"[^"]*"|'[^']*')+)""", lines)
    found = (re.sub(r"(^|\s)#[^'\"\n]*$", "", one).strip() for one in quoted)
    return [one for one in found if one]


def _smaller(arguments: list[str]) -> list[str]:
    """Return the arguments of a command with smaller numbers."""
    words = list(arguments)
    for option, most in LARGEST.items():
        if option in words and words[words.index(option) + 1].isdigit():
            place = words.index(option) + 1
            words[place] = str(min(int(words[place]), most))
    kinds = [f"{words[0]} {word}" for word in words if f"{words[0]} {word}" in ADDED]
    options = shlex.split(ADDED.get((kinds or words)[0], ""))
    pairs = zip(options[::2], options[1::2], strict=True)
    # The offline and online networks of a page must have the same architecture.
    added = [word for pair in pairs if pair[0] not in {*words} & {"--hidden"} for word in pair]
    return words + added


def _serves(words: list[str]) -> bool:
    return words[:2] == ["mcaprl", "replay"] and not REPLAY_ENDS & set(words)


def _environment() -> dict[str, str]:
    folder = Path(sys.executable).parent
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}


def _sh(script: list[str]) -> None:
    """Run the commands of a list in one shell, up to the first failure. Then clear the list."""
    if script:
        command = ["sh", "-e", "-c", "\n".join(script)]
        done = subprocess.run(command, env=_environment(), stdout=-1, text=True, check=False)
        print(done.stdout, end="")
        assert done.returncode == 0, f"exits with {done.returncode}: {script}"
    script.clear()


def _serve(words: list[str]) -> int:
    """Start a server, and interrupt it when it prints that Ctrl-C stops it."""
    command = [sys.executable, "-m", "mcaprl.cli", *words[1:], "--port", "0"]
    with subprocess.Popen(
        command, stdout=-1, stderr=-2, text=True, preexec_fn=_allow_interrupts
    ) as server:
        assert server.stdout is not None
        watchdog = threading.Timer(LONGEST_SERVICE_S, server.kill)
        watchdog.start()
        said = ""
        for line in server.stdout:
            said += line
            if SERVER_STARTS in line:
                server.send_signal(signal.SIGINT)
        status = server.wait()
        watchdog.cancel()
    assert SERVER_STARTS in said, said
    return 0 if status == 0 or INTERRUPTED in said else status


def _allow_interrupts() -> None:
    """Restore Ctrl-C, which shells disable for programs in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _cpu_s() -> float:
    """Return the CPU time of all processes that this one has started and that have ended."""
    spent = os.times()
    return spent.children_user + spent.children_system


def _query(example: Example) -> None:
    import duckdb

    print(duckdb.sql(example.parsed))


def _node(example: Example) -> None:
    """Run a module of JavaScript with the packages of tests/node."""
    modules = Path("node_modules")
    if not modules.exists():
        modules.symlink_to(NODE_MODULES)
    Path("block.mjs").write_text(example.parsed)
    done = subprocess.run(["node", "block.mjs"], stdout=-1, text=True, check=True)
    print(done.stdout, end="")


def _refuse(example: Example) -> None:
    raise AssertionError(f"{example.path}:{example.line}: yaml needs <!-- file: NAME -->")


def _check_toml(example: Example) -> None:
    tomllib.loads(example.parsed)


def _file_comments(document: Document) -> list[Region]:
    return [
        Region(region.start, region.end, region.lexemes["arguments"].strip(), _next_is_file)
        for region in DirectiveInHTMLCommentLexer("file")(document)
    ]


def _next_is_file(example: Example) -> None:
    """Let the next block be written to a file instead of being run."""
    document = example.document
    path = Path(example.parsed)

    def write(block: Example) -> None:
        if block.region.evaluator is _next_is_file:
            raise NotEvaluated
        document.pop_evaluator(write)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.parsed)

    document.push_evaluator(write)


def _lines(text: str) -> str:
    """Return the text without spaces at line ends, and without empty first and last lines."""
    return "\n".join(line.rstrip() for line in text.strip().splitlines()) + "\n"


def languages(path: Path) -> list[str]:
    """Return the language of each block of a page."""
    document = Document(path.read_text(), str(path))
    return [region.lexemes["language"] for region in FencedCodeBlockLexer(".*")(document)]


def link_examples(folder: Path) -> None:
    """Link files into the folder, so that a page's commands run as in a clone of the repository."""
    for name in ("examples", "benchmarks"):
        (folder / name).symlink_to(ROOT / name)


def has_node() -> bool:
    """Return whether Node and the packages of tests/node are installed."""
    return bool(shutil.which("node")) and NODE_MODULES.is_dir()
