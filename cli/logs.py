"""`mcaprl info`, `check` and `layout`: what is in a log, whether it is whole, how to look at it."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from mcaprl.cli.show import counted, print_facts, print_json, print_problems, size
from mcaprl.errors import LogError, OutputExistsError, ReportError, UsageError, import_extra
from mcaprl.files import write_json
from mcaprl.problem import Problem
from mcaprl.recorder.dataset.calibration import calibration
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.record.scene import DepthSource
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.repair.check import check_log
from mcaprl.recorder.repair.recover import recover_log
from mcaprl.recorder.viewer.log_layout import attached_layout
from mcaprl.recorder.viewer.surprises import moments_of
from mcaprl.sims import SIMS, make_sim

# What `recover` exits with when something of the old file is missing in the new one.
_WITH_LOSSES = 3


@click.command()
@click.argument("data", nargs=-1, required=True)
@click.option(
    "--report", type=click.Path(path_type=Path), help="Folder for a page, a picture and JSON."
)
@click.option("--strict", is_flag=True, help="Exit with 1 if there are problems.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
@click.option(
    "--threads",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="That read chunks at a time; pays for large logs.",
)
def info(
    data: tuple[str, ...], report: Path | None, strict: bool, as_json: bool, threads: int
) -> int:
    """Tell what is in DATA: files, folders or globs of logs."""
    paths = find_logs(data)
    if report is not None:
        import_extra("matplotlib", "report")
        import_extra("jinja2", "report")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = open_logs(paths, threads=threads)
    facts = describe_dataset(dataset)
    facts["size_bytes"] = sum(path.stat().st_size for path in paths)
    facts["storage"] = dataset.storage
    findings = lint(dataset)
    facts["problems"] = [str(warning.message) for warning in caught] + [
        str(finding) for finding in findings if finding.severity == "problem"
    ]
    facts["findings"] = [asdict(finding) for finding in findings]
    moments = [moment for path in paths for moment in moments_of(path)]
    facts["moments"] = [asdict(moment) for moment in moments]
    if report is not None:
        from mcaprl.recorder.viewer.report import dataset_page, dataset_picture

        title = _title(dataset.sources)
        write_json(report / "dataset.json", facts, ReportError)
        dataset_picture(report / "dataset.png", dataset, title)
        rows = _fact_rows(facts, len(paths))
        dataset_page(report / "index.html", dataset, title, rows, findings)
    if as_json:
        print_json(facts)
    else:
        _print_facts(facts, findings, dataset, len(paths))
        for moment in moments:
            click.echo(moment)
    return int(strict and bool(facts["problems"]))


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
@click.option(
    "--threads",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    help="That decompress chunks at a time.",
)
def check(files: tuple[str, ...], as_json: bool, threads: int) -> int:
    """Read every byte of FILE... and tell what is wrong. Exits with 1 if anything is."""
    paths, problems = [], []
    for name in files:
        try:
            found = find_logs(name)
        except LogError as error:
            # The other files are worth checking all the same.
            problems.append(Problem(str(error), "looking for it", next="check the path", file=name))
            if not as_json:
                click.echo(f"mcaprl: {error}", err=True)
            continue
        paths += found
        problems += [problem for path in found for problem in check_log(path, threads=threads)]
    if as_json:
        print_json({"ok": not problems, "problems": [problem.to_json() for problem in problems]})
    else:
        print_problems(problem for problem in problems if problem.file in map(str, paths))
        if not problems:
            click.echo(f"{len(paths)} file{'s' * (len(paths) > 1)} checked, nothing wrong")
    return int(bool(problems))


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--keep-unfinished",
    is_flag=True,
    help="Keep episodes whose end is missing, marked truncated, as far as they are there.",
)
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
def recover(file: Path, out: Path, keep_unfinished: bool, overwrite: bool, as_json: bool) -> int:
    """Write what is left of FILE, cut off or damaged, to OUT, which is whole then.

    Exits with 0 if nothing is lost, with 3 if something is, with 1 if nothing can be kept.
    """
    found = recover_log(file, out, keep_unfinished=keep_unfinished, overwrite=overwrite)
    if as_json:
        print_json({"ok": not found.has_losses, **asdict(found)})
    else:
        ended = f", {found.ended} of them without their end" if found.ended else ""
        episodes = counted(found.episodes, "episode")
        click.echo(f"{out}: {episodes}{ended}, {counted(found.messages, 'message')}")
        print_problems(found.problems)
    return _WITH_LOSSES if found.has_losses else 0


@click.command()
@click.argument("source", metavar="SIM|FILE")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="JSON file to write.")
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def layout(source: str, out: Path, overwrite: bool) -> None:
    """Write the Foxglove layout of a log, or of the logs that a sim will give."""
    if out.suffix == ".mcap":
        raise UsageError(f"{out}: a layout is JSON, and must not take the place of a log")
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: choose another path, or pass --overwrite")
    is_file = source not in SIMS and (Path(source).is_file() or source.endswith(".mcap"))
    found = attached_layout(McapReader(Path(source))) if is_file else _layout_of_sim(source)
    write_json(out, found, ReportError)
    click.echo(f"{out}: in Foxglove, open the layout menu and import this file")


def describe_dataset(dataset: Dataset) -> dict[str, Any]:
    """The facts that `info --json` gives, but for the files' size."""
    statistics = dataset.statistics
    calibrated = calibration(dataset.behavior_probs, dataset.action_space)
    return {
        "env_id": dataset.env_id,
        "episodes": statistics.episodes,
        "steps": statistics.steps,
        "mean_return": statistics.mean_return,
        "return_range": [float(statistics.returns.min()), float(statistics.returns.max())],
        "mean_length": float(statistics.lengths.mean()),
        "duration_s": statistics.duration_s,
        "observations": str(dataset.observation_space),
        "actions": str(dataset.action_space),
        "action_counts": {
            dataset.action_names.get(action, str(action)): count
            for action, count in statistics.action_counts.items()
        },
        "behavior_prob": calibrated and {**calibrated.to_json(), "text": str(calibrated)},
        "policies": sorted({episode.policy for episode in dataset.episodes if episode.policy}),
        "ends": dict(statistics.ends),
    }


def _print_facts(
    facts: dict[str, Any], findings: list[Problem], dataset: Dataset, files: int
) -> None:
    rows = _fact_rows(facts, files)
    rows.append(("problems", "\n".join(facts["problems"]) or "none"))
    notes = [str(finding) for finding in findings if finding.severity == "note"]
    rows += [("notes", "\n".join(notes))] if notes else []
    print_facts(_title(dataset.sources), rows)


def _fact_rows(facts: dict[str, Any], files: int) -> list[tuple[str, str]]:
    low, high = facts["return_range"]
    return [
        ("environment", facts["env_id"] or "unknown"),
        ("files", f"{files}, {size(facts['size_bytes'])}"),
        ("episodes", str(facts["episodes"])),
        ("steps", f"{facts['steps']}, {facts['mean_length']:.1f} an episode"),
        ("simulated time", f"{facts['duration_s']:.1f} s"),
        ("mean return", f"{facts['mean_return']:.3f} (from {low:.3f} to {high:.3f})"),
        ("observations", _short(facts["observations"])),
        ("kept in", facts["storage"]),
        ("actions", _short(facts["actions"])),
        ("taken", _counts(facts["action_counts"]) or "-"),
        ("behavior_prob", _calibration(facts["behavior_prob"])),
        ("policies", ", ".join(facts["policies"]) or "unknown"),
        ("ends", _counts(facts["ends"])),
    ]


def _title(sources: Sequence[Path]) -> str:
    more = f" and {len(sources) - 1} more" if len(sources) > 1 else ""
    return f"{sources[0]}{more}"


def _calibration(found: dict[str, Any] | None) -> str:
    return "unknown" if found is None else f"implies {found['text']}"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _short(text: str) -> str:
    """A space's text on one line; the bounds of a large Box would fill the screen."""
    line = " ".join(text.split())
    return line if len(line) <= 90 else f"{line[:40]} ... {line[-40:]}"


def _layout_of_sim(sim: str) -> dict[str, Any]:
    """The layout that a recording of the sim would carry: one is made and thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "reset.mcap"
        sim_env = make_sim(sim)
        camera = isinstance(sim_env.unwrapped, DepthSource)
        env = RecordMcap(sim_env, path, camera=camera)
        env.reset(seed=0)
        env.close()
        return attached_layout(McapReader(path))
