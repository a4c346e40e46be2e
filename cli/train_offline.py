"""`mcaprl train-offline`: logs in, a policy out."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click

from mcaprl.errors import UsageError
from mcaprl.recorder.reader import open_logs


class _TrainCommand(click.Command):
    """Has an option for each setting of the algorithms; loads them when it is asked for options."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        return [*super().get_params(ctx), *_setting_options()]


@click.command(cls=_TrainCommand)
@click.argument("data", nargs=-1, required=True, metavar="DATA...")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Run folder to make.")
@click.option("--algo", help="dqn, double-dqn, cql or bc.  [default: cql]")
@click.option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="How many networks to train.",
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="Of the first one."
)
@click.option(
    "--threads",
    default=1,
    show_default=True,
    type=click.IntRange(1),
    help="Of torch; more than one pays only with big batches on an idle machine.",
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoints in OUT.")
def train_offline(
    data: tuple[str, ...],
    out: Path,
    algo: str | None,
    seeds: int,
    seed: int,
    threads: int,
    resume: bool,
    **settings: Any,
) -> None:
    """Learn a policy from DATA: files, folders or globs of logs, which all count the same.

    Settings that are not given have the algorithm's own defaults; with --resume, the run's.
    """
    import torch

    from mcaprl.offline.algorithms import choose_algorithm
    from mcaprl.offline.train import CONFIG_NAME, read_config, train

    torch.set_num_threads(threads)
    given = {name: value for name, value in settings.items() if value is not None}
    if resume and (out / CONFIG_NAME).exists():
        earlier = read_config(out / CONFIG_NAME)
        algo = algo or earlier.get("algo")
        given = {**_plain_settings(earlier.get("config")), **given}
    algo = algo or "cql"
    _, defaults = choose_algorithm(algo)
    known = [field.name for field in fields(defaults)]
    for name in given:
        if name not in known:
            options = ", ".join(_flag(field) for field in known)
            raise UsageError(f"{algo} has no setting {_flag(name)}; it has {options}")
    config = type(defaults)(**given)
    dataset = open_logs(list(data))
    click.echo(
        f"{algo} learns from {len(dataset.episodes)} episodes, {len(dataset)} transitions,"
        f" mean return {dataset.statistics.mean_return:.2f}"
    )
    for summary in train(dataset, config, out, seeds=seeds, seed=seed, resume=resume):
        done = summary.updates - summary.resumed_at
        rate = done / summary.seconds if summary.seconds else 0.0
        terms = ", ".join(f"{name} {value:.4g}" for name, value in summary.terms.items())
        click.echo(f"{summary.folder}: {done} updates, {rate:.0f} a second; {terms}")
    click.echo(f"curves: tensorboard --logdir {out}")


def _plain_settings(found: object) -> dict[str, Any]:
    """The settings of an earlier session, as its config.json has them."""
    settings = found if isinstance(found, dict) else {}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}


def _setting_options() -> list[click.Option]:
    """An option for each field of the algorithms' configs, its doc line as help."""
    from mcaprl.offline.algorithms import ALGORITHMS
    from mcaprl.offline.config import field_help

    options: dict[str, click.Option] = {}
    for learner in ALGORITHMS.values():
        config = learner.config_type()
        for name, line in field_help(type(config)).items():
            default = getattr(config, name)
            if name in options:
                continue
            options[name] = click.Option(
                [_flag(name), name],
                type=_Widths() if isinstance(default, tuple) else type(default),
                help=f"{line}  [default: {_shown(default)}]",
            )
    return list(options.values())


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


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _shown(default: Any) -> str:
    return ",".join(map(str, default)) if isinstance(default, tuple) else f"{default}"
