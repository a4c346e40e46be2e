"""Options that several commands have."""

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
