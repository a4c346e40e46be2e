"""`mcaprl convert`: other robots' bags as logs."""

from __future__ import annotations

from pathlib import Path

import click

import mcaprl
from mcaprl.cli.options import json_option, mapping_options
from mcaprl.cli.show import echo, print_facts, print_json, print_problems
from mcaprl.errors import UsageError
from mcaprl.texts import counted


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="BAG... [OUT]")
@mapping_options
@click.option("--suggest", is_flag=True, help="Print a mapping to begin with; there is no OUT.")
@click.option("--dry-run", is_flag=True, help="Write nothing; there is no OUT.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@json_option
def convert(
    paths: tuple[str, ...],
    mapping: Path | None,
    trust_code: bool,
    suggest: bool,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Read BAG by a mapping, and write its transitions to the log OUT.

    BAG is an MCAP file of any writer, a rosbag2 folder or database, or a ROS 1 bag. Begin with
    `mcaprl convert --suggest BAG > robot.yaml`.
    """
    if suggest:
        click.echo(mcaprl.suggest_mapping(paths), nl=False)
        return
    if mapping is None:
        raise UsageError("convert needs --mapping FILE, or --suggest for a mapping to begin with")
    if not dry_run and len(paths) < 2:
        raise UsageError("convert needs BAG and OUT, or --dry-run to write nothing")
    bags, out = (paths, None) if dry_run else (paths[:-1], paths[-1])
    found = mcaprl.convert(bags, out, mapping=mapping, trust_code=trust_code, overwrite=overwrite)
    if as_json:
        print_json(found.to_json())
        return
    print_facts(", ".join(bags), found.report.rows())
    if dry_run:
        for number, step in enumerate(found.first()):
            echo(f"{number}: {step}")
    print_problems(found.report.problems())
    if found.out is not None:
        data = found.dataset
        steps = counted(len(data), "step")
        echo(f"{found.out}: {counted(len(data.episodes), 'episode')}, {steps}")
