"""`mcaprl convert`: convert logs, other robots' bags or datasets to logs or datasets."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

import mcaprl
from mcaprl.cli.help import Command
from mcaprl.cli.options import PATH, bag_options, bag_reader, json_option, mapping_options
from mcaprl.cli.progress import working
from mcaprl.cli.show import echo, print_facts, print_json, print_problems, print_wide
from mcaprl.errors import UsageError
from mcaprl.texts import counted


@click.command(cls=Command)
@click.argument("paths", nargs=-1, required=True, metavar="SRC... [DST]", type=PATH)
@mapping_options
@click.option("--from", "source_format", metavar="FORMAT", help="Format of SRC if not detected.")
@click.option(
    "--one-episode",
    is_flag=True,
    help="All of SRC is one episode if it marks no end of an episode.",
)
@click.option(
    "--dones",
    type=click.Choice(["terminated", "truncated"]),
    help="Kind of the ends of episodes in SRC if SRC does not say it.",
)
@click.option("--to", metavar="FORMAT", help="Format of DST if not clear from its name.")
@click.option("--lossy", is_flag=True, help="Convert or omit data that DST or a log cannot store.")
@click.option("--suggest", is_flag=True, help="Print a draft of a mapping for SRC; takes no DST.")
@click.option(
    "--bins",
    type=click.IntRange(2),
    metavar="N",
    help="With --suggest: N bins of each continuous command, each with as many commands.",
)
@click.option("--dry-run", is_flag=True, help="Read SRC and write nothing; takes no DST.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--upload", metavar="URL", help="Copy the finished file to a URL.")
@json_option
def convert(
    paths: tuple[str, ...],
    suggest: bool,
    bins: int | None,
    dry_run: bool,
    as_json: bool,
    source_format: str | None,
    one_episode: bool,
    dones: str | None,
    **request: Any,
) -> None:
    """Read SRC, and write its transitions to DST.

    SRC is a log or a dataset of another tool. With --mapping, SRC is a bag: an MCAP file of any
    writer, a rosbag2 folder or database, or a ROS 1 bag. To write a mapping for a bag, begin with
    `mcaprl convert --suggest BAG > robot.yaml`. DST is a log if it ends with .mcap. Otherwise, DST
    is a dataset in the format that --to names: lerobot, minari, parquet, npz, d3rlpy or hdf5.
    """
    if bins is not None and not suggest:
        raise UsageError("--bins is for --suggest: set `edges` of the mapping instead")
    bag = bag_options(request)
    if suggest:
        with working("reading the topics"):
            text = mcaprl.suggest_mapping(paths, bins=bins, definitions=bag["definitions"])
        click.echo(text, nl=False)
        return
    if not dry_run and len(paths) < 2:
        raise UsageError("convert needs SRC and DST, or --dry-run to write nothing")
    sources, out = (paths, None) if dry_run else (paths[:-1], paths[-1])
    source = bag_reader(sources, bag)
    reading: dict[str, Any] = {"format": source_format, "one_episode": one_episode, "dones": dones}
    if any(reading.values()):
        source = partial(mcaprl.open, sources, lossy=request["lossy"], **reading, **bag)
    with working("converting"):
        found = mcaprl.convert(source, out, **request)
    if as_json:
        print_json(found.to_json())
        return
    if found.report is not None:
        print_facts(", ".join(sources), found.report.rows(), width=100)
        print_wide("recordings: missing share, median age, largest age", *found.run_table())
    if dry_run:
        print_wide("first transitions", *found.first_table(), last=3)
    if found.report is not None:
        print_problems(found.report.problems())
    for sentence in found.lost:
        echo(f"lost: {sentence}")
    if found.out is not None:
        data = found.dataset
        steps = counted(len(data), "step")
        echo(f"{found.out}: {counted(len(data.episodes), 'episode')}, {steps}")
