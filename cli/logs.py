"""Commands on logs: `info`, `check`, `recover`, `layout`, `annotate`, `convert` and the edits."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import mcaprl
from mcaprl.cli.completion import Name, sims
from mcaprl.cli.help import WITH_LOSSES, Command
from mcaprl.cli.options import (
    PATH,
    actions_option,
    bag_options,
    bag_reader,
    camera_option,
    env_arg_option,
    integer_option,
    json_option,
    keep_options,
    keys_option,
    mapping_options,
    selection_options,
    trust_option,
)
from mcaprl.cli.progress import hint, working
from mcaprl.cli.show import echo, print_facts, print_json, print_problems, print_table, print_wide
from mcaprl.errors import UsageError
from mcaprl.page import PAGE_NAME
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.recorder.edit.piece import Edited


@click.command(cls=Command)
@click.argument("data", nargs=-1, required=True, type=PATH)
@click.option("--report", type=click.Path(path_type=Path), help="Output folder of the HTML report.")
@click.option("--strict", is_flag=True, help="Exit with 1 if there are problems.")
@click.option("--quality", is_flag=True, help="Look for faults of sensors, clocks and recording.")
@click.option("--test", type=PATH, help="With --quality: held-out data, not to be in DATA.")
@json_option
@integer_option(
    "--threads", "Number of threads that decompress chunks; useful for large logs.", least=1
)
@selection_options
@partial(mapping_options, has_strict=False)
def info(
    data: tuple[str, ...],
    report: Path | None,
    strict: bool,
    test: str | None,
    as_json: bool,
    **request: Any,
) -> int:
    """Show the contents and problems of DATA: files, folders or globs of logs.

    For another robot's bag (MCAP, rosbag2, ROS 1), show its recordings and topics; with --mapping,
    its episodes. Rates are those of the median interval between messages.
    """
    with working("reading data"):
        source = bag_reader(data, bag := bag_options(request))
        request["test"] = test
        if test is not None and bag["mapping"] is not None:
            request["test"] = mcaprl.open(test, **bag)
        selection = {name: request.pop(name) for name in ("only", "mask")}
        if any(selection.values()):
            source = partial(mcaprl.select, source, **selection)
            if test is not None:
                request["test"] = partial(mcaprl.select, request["test"], **selection)
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
    if found.quality is not None and not as_json:
        rows = [(flaw.severity, f"{flaw.share:.1%}", str(flaw)) for flaw in found.quality]
        print_facts("quality", [(f"{kind}, {share}", text) for kind, share, text in rows])
        if not rows:
            echo("no faults of the data were found")
    worst = [flaw for flaw in found.quality or () if flaw.severity == "problem"]
    return int(strict and bool(found.problems or worst))


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
@click.option("--policy", multiple=True, help="Policy as for evaluate --data; may be repeated.")
@click.option("--gamma", type=click.FloatRange(0, 1), help="Discount. [default: that of the run]")
@click.option("--scene", is_flag=True, help="Step the sim again and add its scene.")
@camera_option(
    "With --scene: add metric depth images; with h264: step the sim again, and add a video of what"
    " it renders, also without --scene."
)
@click.option("--sim", type=Name(sims), help="Sim to step instead of the logged one.")
@env_arg_option
@trust_option
@mapping_options
@keep_options
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def annotate(file: str, out: Path, **request: Any) -> None:
    """Copy LOG and add a policy's actions and values, labels, or the scene of the sim to each step.

    The labels of a labeled log are added always; see `mcaprl label`.
    """
    bag = bag_options(request)
    with working("reading the log") as bar:
        data = file if bag["mapping"] is None else mcaprl.open(file, **bag)
        request["trust_code"] = bag["trust_code"]
        found = mcaprl.annotate(data, out, progress=bar, **request)
    for name, topic in found.topics.items():
        echo(f"{out}: {topic} has the values of {name} for {counted(found.steps, 'step')}")
    if found.labels:
        echo(f"{out}: /rl/labels has the labels")
    if found.scene is not None:
        episodes, steps = found.scene.episodes, found.scene.steps
        added = ["scene"] * request["scene"] + ["video"] * (request["camera"] == "h264")
        what = " and ".join(f"the {each}" for each in added)
        echo(f"{out}: {what} of {counted(episodes, 'episode')}, {counted(steps, 'step')}")


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
@keep_options
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
    for sentence in found.videos:
        echo(f"video: {sentence}")
    for sentence in found.lost:
        echo(f"lost: {sentence}")
    if found.out is not None:
        data = found.dataset
        steps = counted(len(data), "step")
        echo(f"{found.out}: {counted(len(data.episodes), 'episode')}, {steps}")


_overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing output.")


@click.command(cls=Command)
@click.argument("logs", nargs=-1, required=True, metavar="LOG... OUT", type=PATH)
@click.option("--shift", is_flag=True, help="Delay each log that overlaps a previous one in time.")
@_overwrite_option
@json_option
def merge(logs: tuple[str, ...], shift: bool, overwrite: bool, as_json: bool) -> None:
    """Join LOG... into the new log OUT, with all topics, metadata and attachments."""
    if len(logs) < 2:
        raise UsageError("merge needs LOG... and OUT")
    with working("copying"):
        found = mcaprl.merge(logs[:-1], logs[-1], shift=shift, overwrite=overwrite)
    _show([found], as_json)


@click.command(cls=Command)
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@click.option("--episodes", type=int, help="Number of episodes of each part.")
@click.option("--ratio", metavar="A:B[:C...]", help="Relative sizes of the parts, such as 8:1:1.")
@click.option("--seed", type=click.IntRange(0), help="Assign episodes at random with this seed.")
@_overwrite_option
@json_option
def split(
    log: str,
    out: str,
    episodes: int | None,
    ratio: str | None,
    seed: int | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Copy the episodes of LOG to several logs in the new folder OUT."""
    shares = None if ratio is None else [_number("ratio", part) for part in ratio.split(":")]
    with working("copying"):
        found = mcaprl.split(
            log, out, episodes=episodes, ratio=shares, seed=seed, overwrite=overwrite
        )
    _show(found, as_json)


@click.command("filter", cls=Command)
@click.argument("expression")
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@_overwrite_option
@json_option
def filter_(expression: str, log: str, out: str, overwrite: bool, as_json: bool) -> None:
    """Copy the episodes of LOG for which EXPRESSION is true to the new log OUT.

    EXPRESSION is a condition such as "length > 100 and reason == 'crash'" on: episode, length,
    total_reward, terminated, truncated, reason, policy, epsilon, seed, options, start_s,
    duration_s, and of labels: success, note.
    """
    with working("copying"):
        found = mcaprl.filter(expression, log, out, overwrite=overwrite)
    _show([found], as_json)


@click.command(cls=Command)
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@click.option(
    "--reward",
    required=True,
    metavar="EXPRESSION",
    help="Reward of a transition, such as 'next(speed) - 0.1 * abs(action[0])'.",
)
@_overwrite_option
def relabel(log: str, out: str, reward: str, overwrite: bool) -> None:
    """Write the transitions of LOG with another reward to the new log OUT.

    The expression can use: action, reward (the logged one), terminated, truncated, the names of the
    observation's elements, observation[K], the parts of a Dict observation, and numeric infos;
    next(...) is a value after the transition.
    """
    with working("relabeling"):
        found = mcaprl.relabel(log, out, reward=reward, overwrite=overwrite)
    statistics = found.statistics
    echo(
        f"{out}: {counted(statistics.episodes, 'episode')},"
        f" {counted(statistics.steps, 'step')}, mean return {statistics.mean_return:.4g}"
    )


@click.command(cls=Command)
@click.argument("log", type=PATH)
@click.option("--episode", type=int, help="Index of the episode, from 0.")
@click.option("--success/--failure", default=None, help="Whether the episode succeeded.")
@click.option("--note", help="Note on the episode.")
@click.option("--interval", metavar="NAME", help="Name of an interval, such as intervention.")
@click.option("--steps", metavar="A:B", help="Steps of the interval; B is not included.")
@click.option("--time", metavar="A:B", help="Seconds of the interval since the episode's start.")
@click.option("--remove", is_flag=True, help="Remove the labels of --episode or --interval.")
@click.option("--file", metavar="FILE", type=PATH, help="CSV or JSON file of labels.")
@mapping_options
@json_option
def label(log: str, steps: str | None, time: str | None, as_json: bool, **request: Any) -> None:
    """Label episodes and intervals of LOG, which is not changed; without options, list the labels.

    Labels are kept in LOG.labels.json. filter and relabel can use them, and train-offline --mask
    does not learn from labeled intervals. With --mapping, LOG is a recording of another robot; the
    mapping's reward and conditions can use its labels, such as labels.success.
    """
    request["steps"] = None if steps is None else _bounds("steps", steps)
    request["time"] = None if time is None else _bounds("time", time)
    with working("reading the log"):
        found = mcaprl.label(log, **request)
    if as_json:
        print_json(found.to_json())
    elif rows := found.rows():
        print_table(f"{log}", ["episode", "result", "note", "intervals"], rows)
    else:
        echo(f"{log}: no labels")


@click.command("slice", cls=Command)
@click.argument("log", type=PATH)
@click.argument("out", type=PATH)
@click.option("--steps", metavar="A:B", help="Transitions from A to B; B is not included.")
@click.option("--time", metavar="A:B", help="Seconds since the first message of LOG.")
@_overwrite_option
@json_option
def slice_(
    log: str, out: str, steps: str | None, time: str | None, overwrite: bool, as_json: bool
) -> None:
    """Copy the part of LOG between two steps or times to the new log OUT.

    Episodes that contain A or B are shortened. If A or B is empty, the start or end of LOG is used.
    """
    bounds = {
        "steps": None if steps is None else _bounds("steps", steps),
        "time": None if time is None else _bounds("time", time),
    }
    with working("copying"):
        found = mcaprl.slice(log, out, **bounds, overwrite=overwrite)
    _show([found], as_json)


def _show(results: list[Edited], as_json: bool) -> None:
    if as_json:
        print_json({"logs": [vars(found) | {"out": str(found.out)} for found in results]})
        return
    for found in results:
        episodes, steps = counted(found.episodes, "episode"), counted(found.steps, "step")
        chunks = f"{found.whole_chunks} of {found.whole_chunks + found.rewritten_chunks} chunks"
        messages = counted(found.messages, "message")
        echo(f"{found.out}: {episodes}, {steps}, {messages}; {chunks} copied unchanged")


def _bounds(option: str, text: str) -> tuple[float | None, float | None]:
    """Parse A:B; an empty bound is None."""
    parts = text.split(":")
    if len(parts) != 2:
        raise UsageError(f"--{option} is '{text}', expected A:B, such as 100:200")
    first, last = (None if not part.strip() else _number(option, part) for part in parts)
    return first, last


def _number(option: str, text: str) -> float:
    try:
        number = int(text) if option == "steps" else float(text)
    except ValueError as error:
        raise UsageError(f"--{option} has '{text}', which is not a number") from error
    if not (math.isfinite(number) and number >= 0):
        raise UsageError(f"--{option} has '{text}', expected a number of 0 or more")
    return number
