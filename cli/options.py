"""Options shared by several commands."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import click

from mcaprl.cli.completion import Name
from mcaprl.errors import UsageError
from mcaprl.files import parse_json

PATH: Final = Name(tuple, is_path=True)  # Type of a path, a glob or a URL
_CONSTANTS: Final = {"True": True, "False": False, "None": None}
F = TypeVar("F", bound=Callable[..., Any])

trust_option = click.option(
    "--trust-env",
    is_flag=True,
    help="Trust LOG: import the module in the logged environment id, and use logged arguments.",
)
origin_option = click.option(
    "--allow-origin",
    multiple=True,
    metavar="ORIGIN",
    help="Allow another web page to connect, such as https://viewer.example; may be repeated.",
)


def camera_option(text: str) -> Callable[[F], F]:
    """Return the option `--camera`, whose parameter is True, `h264` or False."""
    return click.option(
        "--camera",
        is_flag=False,
        flag_value="depth",
        type=click.Choice(["depth", "h264"]),
        callback=lambda _, __, given: given if given == "h264" else given is not None,
        help=text,
    )


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def mapping_options(command: F, *, has_strict: bool = True) -> F:
    """Add the options for bags of other robots; `has_strict` adds `--strict`."""

    @functools.wraps(command)
    def with_mapping(*args: Any, strict_mapping: bool = False, **request: Any) -> Any:
        if strict_mapping:
            from mcaprl.recorder.source import changed_mapping

            request["mapping"] = changed_mapping(request["mapping"], {"strict": True})
        return command(*args, **request)

    strict = click.option(
        "--strict",
        "strict_mapping",
        is_flag=True,
        help="Refuse a bag with a message that cannot be decoded, instead of leaving it out.",
    )
    code = click.option(
        "--trust-code",
        is_flag=True,
        help="Import the Python functions that the mapping or a policy's name names.",
    )
    definitions = click.option(
        "--definitions",
        multiple=True,
        type=click.Path(path_type=Path),
        metavar="DIR",
        help="Folder or file with definitions of ROS types that the bag lacks; may be repeated.",
    )
    mapping = click.option(
        "--mapping",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Mapping that describes a bag; see docs/bags.md.",
    )
    found = definitions(code(cast(F, with_mapping)))
    return mapping(strict(found) if has_strict else found)


def selection_options(command: F) -> F:
    """Add the options of `mcaprl.select`."""
    mask = click.option(
        "--mask",
        multiple=True,
        metavar="NAME",
        help="Leave out the steps in intervals of this name (see `mcaprl label`); repeatable.",
    )
    return click.option(
        "--only",
        metavar="EXPR",
        help="Use only the episodes for which EXPR is true, such as 'success == 1'; see `mcaprl"
        " filter`.",
    )(mask(command))


def bag_options(request: dict[str, Any]) -> dict[str, Any]:
    """Remove the options of `mapping_options` from a request, and return them."""
    return {name: request.pop(name) for name in ("mapping", "trust_code", "definitions")}


def keep_options(command: F) -> F:
    """Add the options for the topics of a bag that are kept, as the parameter `keep_topics`."""

    @functools.wraps(command)
    def with_topics(
        *args: Any, keep_all: bool | None, keep_topic: tuple[str, ...], **given: Any
    ) -> Any:
        return command(*args, keep_topics=keep_all or keep_topic or keep_all, **given)

    every = click.option(
        "--keep-topics/--no-keep-topics",
        "keep_all",
        default=None,
        help="Keep all topics of the bag beside /rl/*, or none. Default: those of `keep` in the"
        " mapping.",
    )
    some = click.option(
        "--keep-topic",
        multiple=True,
        metavar="PATTERN",
        help="Keep these topics, such as '/camera/*'; may be repeated.",
    )
    return every(some(cast(F, with_topics)))


def bag_reader(data: tuple[str, ...], bag: dict[str, Any]) -> Any:
    """Return a function that reads a bag by these options; without a mapping, return `data`."""
    # Functions that report what a mapping leaves out need no warnings of it.

    def read() -> Any:
        from mcaprl.recorder.source import read_mapped

        return read_mapped(data, **bag)

    return data if bag["mapping"] is None else read


def sim_options(command: F) -> F:
    """Add the options that select the variant of a sim."""
    text = "Observation that the sim returns: state, depth, ..."
    rules = click.option("--rules", help="Rules of the sim: default, classic, ...")
    found = rules(actions_option(env_arg_option(command)))
    return click.option("--observation", help=text)(found)


def _kind(_: click.Context, __: click.Parameter, text: str | None) -> str | int | None:
    return int(text) if text is not None and text.isdecimal() else text


actions_option = click.option(
    "--actions",
    metavar="KIND",
    callback=_kind,
    help="Actions of the sim: discrete, continuous, ...",
)


def env_arguments(texts: Iterable[str]) -> dict[str, Any] | None:
    """Parse KEY=VALUE texts; VALUE is JSON, or else a text. Return None if there are no texts.

    >>> env_arguments(["continuous=false", "map_name=8x8", 'config={"lanes": 2}'])
    {'continuous': False, 'map_name': '8x8', 'config': {'lanes': 2}}
    """
    found: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise UsageError(f"--env-arg {text}: expected KEY=VALUE, such as continuous=false")
        if key in found:
            raise UsageError(f"--env-arg {key} is given twice: pass it once")
        try:
            # Python's names of constants would be true texts.
            found[key] = _CONSTANTS[value] if value in _CONSTANTS else parse_json(value)
        except ValueError as error:
            if value.startswith(("{", "[", '"')):
                raise UsageError(f"--env-arg {key}: {value!r:.60} is not JSON: {error}") from error
            found[key] = value
    return found or None


def _parsed(_: click.Context, __: click.Parameter, texts: Iterable[str]) -> dict[str, Any] | None:
    return env_arguments(texts)


env_arg_option = click.option(
    "--env-arg",
    "sim_options",
    multiple=True,
    metavar="KEY=VALUE",
    callback=_parsed,
    help="Argument of the environment, such as continuous=false; VALUE is JSON or a text. May be"
    " repeated.",
)
trust_run_option = click.option(
    "--trust-env",
    is_flag=True,
    help="Trust the run: use the arguments of its training in environments other than the sims.",
)


def _keys(_: click.Context, __: click.Parameter, text: str | None) -> list[str] | None:
    return None if text is None else text.split(",")


keys_option = click.option(
    "--keys",
    metavar="KEY,...",
    callback=_keys,
    help="Keys of a Dict or Tuple observation to record, such as image,direction.  [default: all]",
)


max_steps_option = click.option(
    "--max-steps",
    type=click.IntRange(1),
    help="Steps after which an episode is truncated.  [default: 27000 if SIM has no time limit]",
)


def integer_option(
    name: str, help: str, *, least: int, most: int | None = None, default: int | None = None
) -> Callable[[F], F]:
    """Return an option for an integer from `least` to `most`; a `default` of None means `least`."""
    default, kind = least if default is None else default, click.IntRange(least, most)
    return click.option(name, default=default, show_default=True, type=kind, help=help)


def seed_options(learner: str) -> Callable[[F], F]:
    """Return the options for the seeds of a training; `learner` is what each seed trains."""
    default = "; with --resume: that of the run]"
    seeds = f"Number of {learner}s to train.  [default: 1{default}"
    seed = f"Seed of the first {learner}; {learner} k uses seed + k.  [default: 0{default}"

    def add(command: F) -> F:
        first = click.option("--seed", type=click.IntRange(0), help=seed)
        return click.option("--seeds", type=click.IntRange(1), help=seeds)(first(command))

    return add


def ray_options(command: F) -> F:
    """Add the options that run a command on a Ray cluster."""
    flag = click.option("--ray", is_flag=True, help="Run on Ray workers; see docs/ray.md.")
    workers = click.option(
        "--workers",
        type=click.IntRange(1),
        help="With --ray: number of workers.  [default: CPUs of the cluster]",
    )
    address = click.option(
        "--address",
        metavar="HOST:PORT",
        help="With --ray: address of the cluster.  [default: RAY_ADDRESS, or a local cluster]",
    )
    return flag(workers(address(command)))
