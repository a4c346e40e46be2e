"""Options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click


def sim_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that choose how a sim is made; the command gets them as `sim_arguments`."""

    @click.option("--observation", help="What the agent sees: state, depth, ... as the sim offers.")
    @click.option("--rules", help="Of the sim: default, ... as the sim offers.")
    @functools.wraps(command)
    def with_arguments(*, observation: str | None, rules: str | None, **others: Any) -> None:
        chosen = {"observation": observation, "rules": rules}
        given = {name: value for name, value in chosen.items() if value is not None}
        command(sim_arguments=given, **others)

    return with_arguments
