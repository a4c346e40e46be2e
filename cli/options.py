"""Options shared by several commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from mcaprl.cli.completion import Name

PATH: Final = Name(tuple, is_path=True)
"""Type of a path, a glob or a URL."""
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
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def mapping_options(command: F) -> F:
    """Add the options for bags of other robots."""
    code = click.option(
        "--trust-code",
        is_flag=True,
        help="Trust the mapping: import the Python function that it names.",
    )
    return click.option(
        "--mapping",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Mapping that describes a bag; see docs/bags.md.",
    )(code(command))


def sim_options(command: F) -> F:
    """Add the options that select the variant of a sim."""
    text = "Observation that the sim returns: state, depth, ..."
    rules = click.option("--rules", help="Rules of the sim: default, classic, ...")
    return click.option("--observation", help=text)(rules(command))


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
