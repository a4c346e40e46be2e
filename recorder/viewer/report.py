"""Report about a dataset: an HTML page, and its plots as a PNG. Extra: `report`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import Problem
from mcaprl.page import (
    COLORS,
    INK,
    PALE,
    Card,
    Figure,
    Panel,
    Section,
    Table,
    save_panels,
    tick_labels,
    to_svg,
    write_page,
)
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.quality import Flaw, Plot
from mcaprl.recorder.dataset.statistics import calibration
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.reading import McapReader, Topic, telemetry_names
from mcaprl.recorder.record.display import TELEMETRY
from mcaprl.recorder.record.panels import action_parts, bounded_actions
from mcaprl.recorder.source import open_data
from mcaprl.texts import counted

Positions = NDArray[np.float64]
_POSITION = ("x_m", "y_m")
_BINS = 30
_LAST: Final = "A cross in a map is the last position of the episode."
_SHOWN_EPISODES: Final = 3
"""Maximum number of best episodes, and of worst episodes, on the page."""
_MAP_CELLS = 80
_MAX_ROWS = 60
_SHOWN_PARTS: Final = 6


def dataset_page(
    path: Path,
    dataset: Dataset,
    title: str,
    facts: Sequence[tuple[str, str]],
    findings: Sequence[Problem],
) -> None:
    """Write an HTML page about a dataset, and its plots as `dataset.png` beside it.

    `facts` are names and values for the first table, and `findings` the results of `lint`.
    """
    tracks = tracks_of(dataset)
    panels = _panels(dataset, tracks)
    save_panels(path.with_name("dataset.png"), panels, title)
    statistics = dataset.statistics
    lead = (
        f"{counted(statistics.episodes, 'episode')}, {counted(statistics.steps, 'step')} of"
        f" {dataset.env_id or 'an unknown environment'}"
    )
    sections = [
        Section("Overview", table=Table(("", ""), facts)),
        _findings_section(findings),
        *_plots_section(findings),
        Section("Episodes", figures=[Figure.of(one.caption, one.figure()) for one in panels]),
        *_calibration_section(dataset),
        Section(
            "Best and worst episodes",
            _LAST if any(map(len, tracks)) else "",
            cards=_cards(dataset, tracks),
        ),
        Section("Observations", table=_columns(dataset)),
    ]
    write_page(path, title, lead, sections)


def bag_page(
    path: Path,
    title: str,
    facts: Sequence[tuple[str, str]],
    tables: Mapping[str, tuple[Sequence[str], Sequence[Sequence[str]]]],
    findings: Sequence[Problem],
) -> None:
    """Write an HTML page about a bag: facts, findings with their plots, and tables by title."""
    sections = [
        Section("Overview", table=Table(("", ""), facts)),
        _findings_section(findings),
        *_plots_section(findings),
        *(Section(name, table=Table(*table)) for name, table in tables.items()),
    ]
    write_page(path, title, "Topics of a bag, without a mapping", sections)


def _findings_section(findings: Sequence[Problem]) -> Section:
    if not findings:
        return Section("Findings", text="No problems were found.")
    rows = [(one.severity, one.what, one.where, one.effect, one.next) for one in findings]
    return Section("Findings", table=Table(("", "what", "where", "effect", "what to do"), rows))


def _plots_section(findings: Sequence[Problem]) -> list[Section]:
    """Return the section with the plots of the findings; concerned parts are marked."""
    figures = [
        Figure.of(one.what, Panel(one.what, partial(_plot, plot=one.plot)).figure())
        for one in findings
        if isinstance(one, Flaw) and one.plot is not None
    ]
    text = "The first or longest place of each finding; what is concerned has another color."
    return [Section("Plots of the findings", text, figures=figures)] if figures else []


def _plot(axes: Any, plot: Plot) -> None:
    x, y = np.asarray(plot.x, np.float64), np.asarray(plot.y, np.float64)
    marked = np.zeros(len(x), bool)
    for low, high in plot.spans:
        marked |= (x >= low) & (x <= high)
    if plot.is_bars:
        width = 0.9 * float(np.diff(x).min(initial=np.inf)) if len(x) > 1 else 0.9
        axes.bar(x, y, width, color=np.where(marked, COLORS[1], COLORS[0]))
    elif plot.spans:
        axes.plot(x, y, color=COLORS[0], lw=1, marker=".", ms=3)
        axes.plot(x[marked], y[marked], ".", color=COLORS[1], ms=6)
        for low, high in plot.spans:
            axes.axvspan(low, high, color=COLORS[1], alpha=0.15, lw=0)
    else:
        axes.plot(x, y, ".", color=COLORS[1], ms=4)
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)


def _calibration_section(dataset: Dataset) -> list[Section]:
    """Return the section about behavior probabilities. If they are unknown, the list is empty."""
    found = calibration(dataset.behavior, dataset.action_space)
    if found is None:
        return []
    rows = [
        (f"{one.probability:.3f}", f"{one.steps / len(dataset):.1%}", f"{one.actions:.2f}")
        for one in found.ranges
    ]
    table = Table(("behavior_prob", "share of steps", "actions per state"), rows)
    origin = "The probabilities are estimated. " if dataset.has_estimated_probs else ""
    text = f"{origin}behavior_prob implies {found}."
    return [Section("Behavior probabilities", text, table=table)]


def _panels(dataset: Dataset, tracks: Sequence[Positions]) -> list[Panel]:
    statistics = dataset.statistics

    def by_episode(axes: Any) -> None:
        axes.plot(statistics.returns, ".", color=COLORS[0], ms=7)
        axes.set_xlabel("episode")
        axes.xaxis.get_major_locator().set_params(integer=True)

    found = [
        Panel(
            f"Return per episode, mean {statistics.mean_return:.4g}",
            partial(_histogram, values=statistics.returns),
        ),
        Panel("Steps per episode", partial(_histogram, values=statistics.lengths)),
        Panel("Return by episode, in the order of the log", by_episode),
    ]
    if isinstance(dataset.action_space, spaces.Box):
        found += _command_panels(dataset)
    bars = {"Actions taken": _actions_taken(dataset), "End reasons": statistics.ends}
    for caption, counts in ((caption, counts) for caption, counts in bars.items() if counts):
        size = (4.4, max(1.6, 0.28 * len(counts) + 0.8))
        found.append(Panel(caption, partial(_bars, counts=counts), size))
    places = np.concatenate([np.empty((0, 2)), *tracks])
    if len(places):
        caption = "Positions in meters; a stronger color means more steps"
        found.append(Panel(caption, partial(_coverage, places=places), (4.4, 3.6)))
    return found


def _coverage(axes: Any, places: Positions) -> None:
    """Plot the number of steps at each position."""
    cell_m = max(float(np.ptp(places, axis=0).max()) / _MAP_CELLS, 1e-6)
    cells, counts = np.unique(np.rint(places / cell_m), axis=0, return_counts=True)
    shade = 0.15 + 0.85 * np.log1p(counts) / np.log1p(counts.max())
    axes.scatter(
        *(cells * cell_m).T, s=6, c=COLORS[0], alpha=shade, marker="s", lw=0, rasterized=True
    )
    axes.set_aspect("equal")


def _cards(dataset: Dataset, tracks: Sequence[Positions]) -> list[Card]:
    order = np.argsort([-episode.total_reward for episode in dataset.episodes], kind="stable")
    # No episode is among both the best and the worst.
    most = min(_SHOWN_EPISODES, max(len(order) // 2, 1))
    best, worst = order[:most], order[most:][-most:][::-1]
    shown = [("best", int(k)) for k in best] + [("worst", int(k)) for k in worst]
    places, commands = np.concatenate([np.empty((0, 2)), *tracks]), _commands(dataset)
    return [_card(kind, dataset.episodes[k], tracks[k], places, commands[k]) for kind, k in shown]


def _commands(dataset: Dataset) -> list[str]:
    """Return a replay command for each episode, or empty strings if their files are unknown."""
    counts = [len(open_data(path, columns=[]).episodes) for path in dataset.sources]
    if sum(counts) != len(dataset.episodes):
        return [""] * len(dataset.episodes)
    return [
        f"mcaprl replay {path} --episode {number}"
        for path, count in zip(dataset.sources, counts, strict=True)
        for number in range(count)
    ]


def _card(kind: str, episode: Episode, track: Positions, places: Positions, command: str) -> Card:
    steps, reason = counted(len(episode), "step"), episode.reason or "unknown"
    text = f"return {episode.total_reward:.4g}, {steps}, {reason}"
    if episode.policy:
        text += f", by {episode.policy}"
    return Card(
        f"{kind}: episode {episode.index}", text, _thumbnail(episode, track, places), command
    )


def _thumbnail(episode: Episode, track: Positions, places: Positions) -> str:
    """Plot an episode's track on top of all positions.

    If the episode has no track, plot its cumulative reward instead.
    """

    def draw(axes: Any) -> None:
        if not len(track):
            # The first point makes an episode of one step visible.
            axes.plot(np.cumsum([0.0, *episode.rewards]), color=COLORS[1])
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.set_xlabel("step")
            axes.set_title("cumulative reward")
            return
        stride = max(1, len(places) // 4000)
        axes.plot(*places[::stride].T, ".", color=PALE, ms=1, rasterized=True)
        axes.plot(*track.T, color=COLORS[1], lw=1.6)
        axes.plot(*track[-1], "x", color=INK, ms=6)
        axes.set_aspect("equal")
        axes.set_axis_off()

    return to_svg(Panel("", draw, (3.2, 2.2)).figure())


def _columns(dataset: Dataset) -> Table:
    """Return a table of the observations' statistics."""
    rows = []
    for name, column in dataset.statistics.observations.items():
        names = dataset.observation_names
        for k in range(len(column.low)):
            own = names[k] if len(names) == len(column.low) else f"{name}[{k}]"
            numbers = (column.low[k], column.mean[k], column.std[k], column.high[k])
            rows.append([own, *(f"{number:.4g}" for number in numbers)])
    more = [[f"and {len(rows) - _MAX_ROWS} more", "", "", "", ""]] if len(rows) > _MAX_ROWS else []
    return Table(("", "min", "mean", "std", "max"), rows[:_MAX_ROWS] + more)


def _actions_taken(dataset: Dataset) -> dict[str, int]:
    names = dataset.action_names
    counts = dataset.statistics.action_counts
    return {names.get(value, str(value)): count for value, count in counts.items()}


def _command_panels(dataset: Dataset) -> list[Panel]:
    """Return a histogram of each of the first elements of a Box action, over its range."""
    metadata = LogMetadata.from_strings(dataset.metadata)
    bounded = {one.element: (one.low, one.high) for one in bounded_actions(metadata)}
    columns = dataset.actions.reshape(len(dataset), -1).T
    return [
        Panel(f"Action {name}", partial(_commands_taken, values=column, ends=bounded.get(index)))
        for index, (name, column) in enumerate(
            zip(list(action_parts(metadata))[:_SHOWN_PARTS], columns, strict=False)
        )
    ]


def _commands_taken(axes: Any, values: NDArray[Any], ends: tuple[float, float] | None) -> None:
    axes.hist(values[np.isfinite(values)], bins=_BINS, range=ends, color=COLORS[0])
    axes.set_ylabel("steps")
    axes.yaxis.get_major_locator().set_params(integer=True)


def _histogram(axes: Any, values: NDArray[Any]) -> None:
    axes.hist(values[np.isfinite(values)], bins=_BINS, color=COLORS[0])
    if values.dtype.kind in "iu":
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("episodes")
    axes.yaxis.get_major_locator().set_params(integer=True)


def _bars(axes: Any, counts: Mapping[str, int]) -> None:
    axes.barh(range(len(counts)), list(counts.values()), color=COLORS[0], height=0.7)
    axes.set_yticks(range(len(counts)), tick_labels(counts))
    axes.set_ylim(max(len(counts), 3) - 0.5, -0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)


def tracks_of(dataset: Dataset) -> list[Positions]:
    """Return the positions (T + 1, 2) of each episode in meters.

    If the positions are unknown, the arrays have the shape (0, 2).
    """
    logs = [log for log in (_positions_in(path) for path in dataset.sources) if log is not None]
    return [_positions_at(episode.log_time_ns, logs) for episode in dataset.episodes]


def _positions_in(path: Path) -> tuple[NDArray[np.int64], Positions] | None:
    """Return the times (M,) and positions (M, 2) in a log; None if it has no positions."""
    reader = McapReader(path)
    topic = Topic(reader, TELEMETRY)
    if not set(_POSITION) <= set(telemetry_names(reader)) or not len(topic):
        return None
    columns = topic.read(list(_POSITION))
    return topic.times, np.column_stack([columns[name] for name in _POSITION]).astype(np.float64)


def _positions_at(
    times: NDArray[np.int64], logs: Sequence[tuple[NDArray[np.int64], Positions]]
) -> Positions:
    """Return the positions at `times`.

    If no single log has positions at all these times, the array is empty.
    """
    for known, positions in logs:
        start = int(np.searchsorted(known, times[0]))
        stop = start + len(times)
        if np.array_equal(known[start:stop], times):
            return positions[start:stop]
    return np.empty((0, 2))
