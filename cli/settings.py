"""Command-line options from the fields of the settings of algorithms."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import click

from mcaprl.settings import Settings, field_help, flag


class SettingsCommand(click.Command):
    """Command with an option for each setting of the algorithms, which are loaded when needed."""

    def __init__(
        self, *arguments: Any, configs: Callable[[], Iterable[Settings]], **others: Any
    ) -> None:
        """Create the command; `configs` loads the algorithms and returns their settings."""
        super().__init__(*arguments, **others)
        self._configs = configs

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the options of the command and of the algorithms."""
        return [*super().get_params(ctx), *setting_options(self._configs())]


def setting_options(configs: Iterable[Settings]) -> list[click.Option]:
    """Return an option for each field of several algorithms' settings.

    Help and default come from the first algorithm that has the field. An omitted option is None,
    so that the algorithm's default is used.
    """
    options: dict[str, click.Option] = {}
    for config in configs:
        for name, line in field_help(type(config)).items():
            if name not in options:
                options[name] = _option(name, line, getattr(config, name))
    return list(options.values())


def _option(name: str, line: str, default: Any) -> click.Option:
    if isinstance(default, bool):
        both = f"{flag(name)}/--no-{name.replace('_', '-')}"
        return click.Option([both, name], default=None, help=line)
    is_tuple = isinstance(default, tuple)
    shown = ",".join(map(str, default)) if is_tuple else default
    kind = _Widths() if is_tuple else type(default)
    return click.Option([flag(name), name], type=kind, help=f"{line}  [default: {shown}]")


class _Widths(click.ParamType[tuple[int, ...]]):
    """Layer widths, such as `256,256`."""

    name = "widths"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        try:
            return tuple(int(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of widths such as 256,256", param, ctx)
