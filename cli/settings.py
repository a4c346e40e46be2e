"""Options from the settings of algorithms: each field is one, and its doc line the help."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import click

from mcaprl.settings import Settings, field_help, flag


def setting_options(configs: Iterable[Settings]) -> list[click.Option]:
    """An option for each field of several algorithms' settings; the first that has it explains it.

    What is not given on the command line is None, so that the algorithm's own default holds.
    """
    options: dict[str, click.Option] = {}
    for config in configs:
        for name, line in field_help(type(config)).items():
            default = getattr(config, name)
            if name in options:
                continue
            options[name] = _option(name, line, default)
    return list(options.values())


def _option(name: str, line: str, default: Any) -> click.Option:
    if isinstance(default, bool):
        both = f"{flag(name)}/--no-{name.replace('_', '-')}"
        return click.Option([both, name], default=None, help=line)
    return click.Option(
        [flag(name), name],
        type=_Widths() if isinstance(default, tuple) else type(default),
        help=f"{line}  [default: {_shown(default)}]",
    )


class _Widths(click.ParamType[tuple[int, ...]]):
    """Layer widths, such as `256,256`."""

    name = "widths"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        try:
            return tuple(int(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is no list of widths such as 256,256", param, ctx)


def _shown(default: Any) -> str:
    return ",".join(map(str, default)) if isinstance(default, tuple) else f"{default}"
