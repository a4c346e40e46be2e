"""Command-line options for the settings of algorithms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from mcaprl.cli.help import Command
from mcaprl.errors import is_help
from mcaprl.settings import Settings, field_help, flag


class SettingsCommand(Command):
    """Command with an option for each algorithm setting; algorithms are loaded when needed."""

    def __init__(
        self,
        *arguments: Any,
        configs: Callable[[], Mapping[str, Settings]],
        tuned: Callable[[], Mapping[str, Mapping[str, Any]]] = dict,
        **others: Any,
    ) -> None:
        """Create the command."""
        super().__init__(*arguments, **others)
        self._configs, self._tuned = configs, tuned

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options, or print the help, which also lists the settings without the extra."""
        token = is_help.set(not {"-h", "--help"}.isdisjoint(args))
        try:
            return super().parse_args(ctx, args)
        finally:
            is_help.reset(token)

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the options of the command and of the algorithms."""
        return [*super().get_params(ctx), *self._load(ctx)[1]]

    def _load(self, ctx: click.Context) -> tuple[Mapping[str, Settings], list[click.Option]]:
        """Return the algorithms' default settings and their options; click asks several times."""
        key = f"mcaprl.settings.{self.name}"
        if key not in ctx.meta:
            configs = self._configs()
            ctx.meta[key] = configs, setting_options(configs, self._tuned())
        loaded: tuple[Mapping[str, Settings], list[click.Option]] = ctx.meta[key]
        return loaded

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of the command, then the settings in groups for their algorithms."""
        configs, options = self._load(ctx)
        settings = {option.name: option for option in options}
        own = [param for param in super().get_params(ctx) if param.name not in settings]
        self.write_options(ctx, formatter, own)
        sections: dict[str, list[click.Option]] = {}
        for name, option in settings.items():
            algos = [algo for algo, config in configs.items() if hasattr(config, name)]
            whose = "all algorithms" if len(algos) == len(configs) else ", ".join(algos)
            sections.setdefault(f"Settings of {whose}", []).append(option)
        for title, params in sections.items():
            self.write_group(ctx, formatter, title, params)


def setting_options(
    configs: Mapping[str, Settings], tuned: Mapping[str, Mapping[str, Any]]
) -> list[click.Option]:
    """Return one option for each field of the given settings; an omitted one is None."""
    # The help is that of the first algorithm with the field, and shows the defaults that differ.
    lines: dict[str, str] = {}
    defaults: dict[str, dict[str, Any]] = {}
    for algo, config in configs.items():
        for name, line in field_help(type(config)).items():
            lines.setdefault(name, line)
            defaults.setdefault(name, {})[algo] = getattr(config, name)
    return [_option(name, line, defaults[name], tuned) for name, line in lines.items()]


def _option(
    name: str, line: str, defaults: Mapping[str, Any], tuned: Mapping[str, Mapping[str, Any]]
) -> click.Option:
    default = next(iter(defaults.values()))
    help_text = f"{line}  [default: {_all_defaults(name, default, defaults, tuned)}]"
    if isinstance(default, bool):
        both = f"{flag(name)}/--no-{name.replace('_', '-')}"
        return click.Option([both, name], default=None, help=help_text)
    kind = _Widths() if isinstance(default, tuple) else type(default)
    return click.Option([flag(name), name], type=kind, help=help_text)


def _all_defaults(
    name: str, default: Any, defaults: Mapping[str, Any], tuned: Mapping[str, Mapping[str, Any]]
) -> str:
    """Return the default, then each other value with the algorithms and sims that use it."""
    others: dict[Any, list[str]] = {}
    of_sims = {sim: settings[name] for sim, settings in tuned.items() if name in settings}
    for where, value in (*defaults.items(), *of_sims.items()):
        if value != default:
            others.setdefault(value, []).append(where)
    differing = [f"{', '.join(where)}: {_shown(value)}" for value, where in others.items()]
    return "; ".join([_shown(default), *differing])


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return (",".join(map(str, value)) if isinstance(value, tuple) else f"{value}") or "none"


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
