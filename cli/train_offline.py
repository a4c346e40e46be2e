"""`mcaprl train-offline` and `export`: train a policy on logs, and export it for a robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

import mcaprl
from mcaprl.cli.completion import Name
from mcaprl.cli.help import Command
from mcaprl.cli.options import (
    PATH,
    bag_options,
    integer_option,
    mapping_options,
    ray_options,
    seed_options,
    selection_options,
)
from mcaprl.cli.progress import checkpoints_kept, hint, training_progress, working
from mcaprl.cli.settings import SettingsCommand
from mcaprl.cli.show import echo, print_table
from mcaprl.errors import UsageError
from mcaprl.page import PAGE_NAME
from mcaprl.progress import TrainingProgress
from mcaprl.settings import Settings, flag
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.offline.selection.choice import Choice


def _configs() -> Mapping[str, Settings]:
    from mcaprl.offline.selection.config import default_configs

    return default_configs()


def _names() -> list[str]:
    """Return the names of the algorithms, without the kind of actions of some settings."""
    return list(dict.fromkeys(name.partition(" (")[0] for name in _configs()))


@click.command(cls=SettingsCommand, configs=_configs)
@click.argument("data", nargs=-1, required=True, metavar="DATA...", type=PATH)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Run folder to create.")
@click.option(
    "--algo",
    type=Name(_names),
    help="dqn, double-dqn, cql, bc, bcq, iql; for the actions of a Box bc, td3-bc, rebrac, iql; one"
    " from another package; or auto, which chooses by the log.  [default: cql; for a Box iql]",
)
@seed_options("network")
@integer_option(
    "--threads",
    "Number of threads of PyTorch and of the reader; useful for large batches on an idle machine.",
    least=1,
)
@click.option(
    "--device",
    default="cpu",
    show_default=True,
    help="Device for the data and networks: cpu or cuda.",
)
@click.option("--resume", is_flag=True, help="Resume training from the checkpoints in OUT.")
@click.option("--follow", is_flag=True, help="Use episodes added to DATA during training.")
@click.option("--other-data", is_flag=True, help="With --resume: allow other DATA than in the run.")
@selection_options
@mapping_options
@ray_options
@click.option(
    "--sweep",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="With --ray: train with each combination of settings in FILE; see docs/ray.md.",
)
def train_offline(data: tuple[str, ...], out: Path, sweep: Path | None, **request: Any) -> None:
    """Train a policy on DATA: files, folders or globs of logs.

    A number after a name is a weight: with good.mcap:2 rest/, transitions of good.mcap are drawn
    twice as often as others. With --follow, another process may still write DATA, and training
    uses each episode after it has ended. All seeds are trained in parallel and independently.
    Omitted settings have the algorithm's defaults. With --resume, they have the values of the run;
    a larger number of --updates continues a finished run.
    """
    if sweep is not None:
        _sweep(data, out, sweep, request)
        return
    cluster = [request.pop(name) for name in ("ray", "workers", "address")]
    options = {**bag_options(request), "follow": request.pop("follow")}
    given = {name: value for name, value in request.items() if value is not None}
    facts: list[str] = []

    def read() -> mcaprl.Dataset:
        from mcaprl.recorder.source import opened

        dataset = opened(data, weighted=True, threads=given["threads"], **options)
        facts.append(_facts(dataset))
        return dataset

    with training_progress("updates", "loss") as progress, checkpoints_kept(out, given["resume"]):

        def report(now: TrainingProgress) -> None:
            while facts:
                echo(facts.pop())
            progress(now)

        on_cluster = mcaprl.ClusterOptions(*cluster)
        summaries = mcaprl.train(read, out, ray=on_cluster, progress=report, **given)
    from mcaprl.offline.selection.choice import CHOICE_NAME, read_choice
    from mcaprl.offline.training.metrics import CURVES_NAME, describe_seeds

    if (out / CHOICE_NAME).exists():
        _print_choice(read_choice(out), given.get("report", ""))
    else:
        for line in describe_seeds(summaries):
            echo(line)
    if (out / CURVES_NAME).exists():
        hint(f"curves: {out / CURVES_NAME}, or tensorboard --logdir {out}")
    else:
        hint(
            f"curves: tensorboard --logdir {out}; an image of the curves needs matplotlib:"
            " pip install 'mcaprl[report]'"
        )


def _sweep(data: tuple[str, ...], out: Path, plan: Path, request: dict[str, Any]) -> None:
    context = click.get_current_context()
    for name in request.keys() - {"ray", "workers", "address", "resume"}:
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise UsageError(f"{flag(name)} and --sweep: write the setting into {plan}")
    if not request["ray"]:
        raise UsageError("--sweep requires --ray")
    options = {name: request[name] for name in ("workers", "address", "resume")}
    with working("connecting to Ray") as bar:
        found = mcaprl.sweep(data, out, plan, progress=bar, **options)
    print_table(f"{plan}, best first", list(found.table.columns), list(map(list, found.table.rows)))
    echo(f"policies: {found.results[0].folder} and others; page and table in {out}")


def _facts(dataset: mcaprl.Dataset) -> str:
    return (
        f"learning from {counted(len(dataset.episodes), 'episode')},"
        f" {counted(len(dataset), 'transition')}, mean return {dataset.statistics.mean_return:.2f}"
    )


def _print_choice(choice: Choice, report: str) -> None:
    from mcaprl.offline.selection.choice import COLUMNS

    title = f"{choice.chosen}, chosen by the log"
    print_table(title, list(COLUMNS), [list(row) for row in choice.rows])
    for text in (choice.reason, choice.confidence, *choice.advice):
        echo(text)
    if report:
        echo(f"report: {Path(report) / PAGE_NAME}")


@click.command(cls=Command)
@click.argument("run", metavar="RUN", type=PATH)
@click.option("--out", type=click.Path(path_type=Path), help="ONNX file to write.")
@click.option(
    "--node",
    type=click.Path(path_type=Path),
    help="Python file to write: a program of rclpy that drives the robot of the run's bag.",
)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
def export(run: str, out: Path | None, node: Path | None, overwrite: bool) -> None:
    """Write the policy of RUN, or of RUN/seed-K, as ONNX: observations in, actions out.

    The inputs are the parts of an observation, with the same names as in the log. The outputs are
    action and scores. ONNX Runtime runs the file without this package. A node needs ONNX Runtime,
    NumPy and ROS 2.
    """
    with working("loading the policy"):
        policy = mcaprl.export(run, out, node=node, overwrite=overwrite)
    for file in filter(None, (out, node)):
        echo(f"{file}: {policy.algo} policy {policy.name}, {file.stat().st_size / 1000:.0f} kB")
