"""`mcaprl info`, `check`, `recover`, `layout` and `annotate`: commands on logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

import mcaprl
from mcaprl.cli.completion import Name, sims
from mcaprl.cli.help import WITH_LOSSES, Command
from mcaprl.cli.options import (
    PATH,
    actions_option,
    bag_options,
    bag_reader,
    env_arg_option,
    integer_option,
    json_option,
    keys_option,
    mapping_options,
    trust_option,
)
from mcaprl.cli.progress import hint, working
from mcaprl.cli.show import echo, print_facts, print_json, print_problems, print_table
from mcaprl.page import PAGE_NAME
from mcaprl.texts import counted


@click.command(cls=Command)
@click.argument("data", nargs=-1, required=True, type=PATH)
@click.option("--report", type=click.Path(path_type=Path), help="Output folder of the HTML report.")
@click.option("--strict", is_flag=True, help="Exit with 1 if there are problems.")
@json_option
@integer_option(
    "--threads", "Number of threads that decompress chunks; useful for large logs.", least=1
)
@partial(mapping_options, has_strict=False)
def info(
    data: tuple[str, ...], report: Path | None, strict: bool, as_json: bool, **request: Any
) -> int:
    """Show the contents and problems of DATA: files, folders or globs of logs.

    For another robot's bag (MCAP, rosbag2, ROS 1), show its recordings and topics; with --mapping,
    its episodes. Rates are those of the median interval between messages.
    """
    with working("reading data"):
        source = bag_reader(data, bag := bag_options(request))
        found = mcaprl.info(source, report=report, definitions=bag["definitions"], **request)
    if as_json:
        print_json(found.to_json())
    elif hasattr(found, "topic_rows"):
        _print_bag(found)
    else:
        rows = [*found.rows(), ("problems", "\n".join(found.problems) or "none")]
        notes = [str(finding) for finding in found.findings if finding.severity == "note"]
        rows += [("notes", "\n".join(notes))] if notes else []
        print_facts(found.title, rows)
        for moment in found.moments:
            echo(moment)
        if report is not None:
            echo(f"report: {report / PAGE_NAME}")
    return int(strict and bool(found.problems))


def _print_bag(found: Any) -> None:
    rows = [*found.rows(), ("problems", "\n".join(found.problems) or "none"), ("next", found.next)]
    print_facts(found.title, rows)
    if len(found.recordings) > 1:
        print_table("", found.recording_columns, found.recording_rows())
    print_table("", found.topic_columns, found.topic_rows())


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, metavar="DATA...", type=PATH)
@json_option
@integer_option("--threads", "Number of threads that decompress chunks.", least=1)
@mapping_options
def check(files: tuple[str, ...], as_json: bool, **request: Any) -> int:
    """Read DATA, files, folders or globs of logs, completely, and list all problems.

    All messages of another robot's bag are decoded; with --mapping, its transitions are checked.
    Exits with 1 if there are problems.
    """
    with working("reading data"):
        source = bag_reader(files, bag_options(request))
        found = mcaprl.check(source, **request)
    if as_json:
        print_json(found.to_json())
        return int(not found.ok)
    for problem in found.missing:
        echo(f"mcaprl: {problem.what}", err=True)
    print_problems(problem for problem in found.problems if problem not in found.missing)
    if found.ok:
        echo(f"{counted(len(found.files), 'file')} checked, no problems")
    print_problems(found.notes[:1])
    return int(not found.ok)


@click.command(cls=Command)
@click.argument("file", metavar="LOG", type=PATH)
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--keep-unfinished",
    is_flag=True,
    help="Keep unfinished episodes up to their last complete transition, marked truncated.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@json_option
def recover(file: Path, out: Path, keep_unfinished: bool, overwrite: bool, as_json: bool) -> int:
    """Write the valid part of a damaged or cut-off LOG to the new log OUT.

    Exits with 0 if nothing is lost, 3 if data is lost, 1 if nothing can be kept.
    """
    with working("recovering the log"):
        found = mcaprl.recover(file, out, keep_unfinished=keep_unfinished, overwrite=overwrite)
    if as_json:
        print_json(found.to_json())
    else:
        ended = f", {found.ended} of them unfinished" if found.ended else ""
        episodes = counted(found.episodes, "episode")
        echo(f"{out}: {episodes}{ended}, {counted(found.messages, 'message')}")
        print_problems(found.problems)
    return WITH_LOSSES if found.has_losses else 0


@click.command(cls=Command)
@click.argument("source", metavar="SIM|LOG", type=Name(sims, is_path=True))
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    help="JSON file to write; - for the standard output.",
)
@actions_option
@env_arg_option
@keys_option
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def layout(source: str, out: Path, **request: Any) -> None:
    """Write the Foxglove layout of a log, or of the logs of a sim."""
    with working("reading the topics"):
        target = None if str(out) == "-" else out
        found = mcaprl.layout(source, target, **request)
    if str(out) == "-":
        print_json(found)
        return
    echo(f"{out}: written")
    hint("in Foxglove, open the layout menu and import this file")


@click.command(cls=Command)
@click.argument("file", metavar="LOG", type=PATH)
@click.option("--policy", multiple=True, help="Path of a trained run; may be repeated.")
@click.option("--gamma", type=click.FloatRange(0, 1), help="Discount. [default: that of the run]")
@click.option("--scene", is_flag=True, help="Step the sim again and add its scene.")
@click.option("--camera", is_flag=True, help="With --scene: add metric depth images.")
@click.option("--sim", type=Name(sims), help="With --scene: sim to step instead of the logged one.")
@env_arg_option
@trust_option
@mapping_options
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def annotate(file: str, out: Path, **request: Any) -> None:
    """Copy LOG and add a policy's values or the scene of the sim to each step."""
    bag = bag_options(request)
    with working("reading the log") as bar:
        data = file if bag["mapping"] is None else mcaprl.open(file, **bag)
        found = mcaprl.annotate(data, out, progress=bar, **request)
    for name, topic in found.topics.items():
        echo(f"{out}: {topic} has the values of {name} for {counted(found.steps, 'step')}")
    if found.scene is not None:
        episodes, steps = found.scene.episodes, found.scene.steps
        echo(f"{out}: the scene of {counted(episodes, 'episode')}, {counted(steps, 'step')}")
