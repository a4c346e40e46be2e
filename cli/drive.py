"""`mcaprl drive`: a trained policy drives a robot."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

import click

import mcaprl
from mcaprl.cli.help import Command
from mcaprl.cli.options import PATH
from mcaprl.cli.progress import is_quiet
from mcaprl.cli.show import echo, print_table, print_wide
from mcaprl.errors import UsageError
from mcaprl.progress import printed_lines
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.drive.loop import DriveStatus
    from mcaprl.drive.transports.bag import Compared

_COMPARED = ["command", "steps", "mean in bag", "mean of policy", "RMS difference", "correlation"]
_COLUMNS = ["topic", "type", "messages", "Hz", "age in s"]


@click.command(cls=Command)
@click.argument("run", type=PATH)
@click.option("--dds", is_flag=True, help="Drive over DDS; needs no ROS, and ROS 2 nodes see it.")
@click.option("--ros1", is_flag=True, help="Drive over ROS 1, by rospy.")
@click.option("--ros2", is_flag=True, help="Drive over ROS 2, by rclpy of the sourced ROS 2.")
@click.option(
    "--bag",
    type=PATH,
    help="Bag to play through the policy, without publishing anything; with another transport, a"
    " bag that has the topics, if RUN does not contain their types.",
)
@click.option("--mapping", type=PATH, help="Mapping file that replaces that of RUN.")
@click.option(
    "--enable",
    metavar="TOPIC",
    help="Deadman switch: topic of a Bool, or a button such as /joy.buttons[4]. The policy drives"
    " while it is true, and not older than 0.5 s.",
)
@click.option("--dry-run", is_flag=True, help="Publish nothing.")
@click.option(
    "--duration",
    "duration_s",
    metavar="S",
    type=click.FloatRange(0, min_open=True),
    help="Seconds after which the drive ends.",
)
@click.option(
    "--deadline",
    "deadline_s",
    metavar="S",
    type=click.FloatRange(0, min_open=True),
    help="Longest time in seconds from a step's message or tick to its command; a later command is"
    " replaced by the stop command.  [default: the period of the clock, at most 0.1]",
)
@click.option(
    "--domain-id", type=click.IntRange(0, 232), help="DDS domain.  [default: ROS_DOMAIN_ID, or 0]"
)
@click.option(
    "--interface", help="Network interface for DDS, such as eth0.  [default: this machine alone]"
)
@click.option(
    "--record",
    type=PATH,
    help="MCAP file to write: a log to learn from, with the robot's topics; with --bag alone, the"
    " commands of the bag, and on /mcaprl/... those of the policy.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--trust-code", is_flag=True, help="Allow Python functions that the mapping names.")
def drive(run: str, dds: bool, ros1: bool, ros2: bool, bag: str | None, **request: Any) -> None:
    """Drive a robot with the policy of RUN, which was trained from the robot's bag.

    The mapping of RUN says which topics the policy sees and commands. Nothing is commanded before
    all inputs are there. The stop command is published if an input is missing or too old, if a
    command is late, and at the end.
    """
    kinds = [name for name, on in (("dds", dds), ("ros1", ros1), ("ros2", ros2)) if on]
    kinds = kinds or (["bag"] if bag else [])
    if len(kinds) != 1:
        raise UsageError("choose one of --dds, --ros1, --ros2 and --bag")
    status: list[DriveStatus] = []
    try:
        with _table() as live, _lines(status):

            def show(found: DriveStatus) -> None:
                status[:] = [found]
                if live is not None:
                    live.update(_drawn(found))

            mcaprl.drive_robot(run, kinds[0], bag=bag, on_status=show, **request)
    finally:
        if status:
            print_table("", _COLUMNS, _rows(status[0]))
            print_wide("", _COMPARED, [_compared(each) for each in status[0].compared])
            echo(_summary(status[0]))


def _table() -> Any:
    """Return a context manager of a table that is redrawn on a terminal."""
    if is_quiet() or not sys.stderr.isatty():
        return nullcontext()
    from rich.console import Console
    from rich.live import Live

    return Live(console=Console(stderr=True), transient=True)


def _lines(status: Sequence[DriveStatus]) -> AbstractContextManager[None]:
    """Return a context manager that prints the last status every 10 s, if there is no terminal."""
    if is_quiet() or sys.stderr.isatty():
        return nullcontext()
    return printed_lines(lambda: _summary(status[0]) if status else "loading the policy")


def _drawn(status: DriveStatus) -> Any:
    from rich.table import Table

    table = Table(*_COLUMNS, caption=_summary(status), caption_justify="left")
    for row in _rows(status):
        table.add_row(*row)
    return table


def _rows(status: DriveStatus) -> list[list[str]]:
    return [
        [each.name, each.type_name, str(each.count), _number(each.rate_hz), _number(each.age_s)]
        for each in status.topics
    ]


def _compared(found: Compared) -> list[str]:
    return [found.field, str(found.count), *(_number(each) for each in found[2:])]


def _summary(status: DriveStatus) -> str:
    return (
        f"{status.state}; {status.duration_s:.1f} s, {counted(status.steps, 'step')},"
        f" {status.driven} driven; command after {_number(status.latency_p50_ms)} ms (median),"
        f" {_number(status.latency_p99_ms)} ms (99 %), {status.missed} missed;"
        f" {counted(status.dropped, 'message')} dropped"
    )


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"
