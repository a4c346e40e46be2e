"""Options shared by several commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click


def sim_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that select the variant of a sim."""
    observation = click.option(
        "--observation", help="Observation that the sim returns: state, depth, ..."
    )
    rules = click.option("--rules", help="Rules of the sim: default, classic, ...")
    return observation(rules(command))


def trust_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the option that trusts the environment of a log."""
    return click.option(
        "--trust-env",
        is_flag=True,
        help="Trust in FILE: import the module in its environment's id, and pass on all arguments.",
    )(command)


def origin_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the option that lets a web page connect to the live server."""
    return click.option(
        "--allow-origin",
        multiple=True,
        metavar="ORIGIN",
        help="Another web page that may connect, such as https://viewer.example; may be given"
        " repeatedly.",
    )(command)
