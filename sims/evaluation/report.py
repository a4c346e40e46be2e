"""HTML report of an evaluation: comparison of policies, trajectories, and selected episodes.

Extra: `report`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.page import (
    BACKGROUND,
    COLORS,
    INK,
    PAGE_NAME,
    PALE,
    Card,
    Figure,
    Panel,
    Section,
    Table,
    new_figure,
    save_panels,
    save_png,
    tick_labels,
    to_svg,
    write_page,
)
from mcaprl.sims.drawing.scene import Shape
from mcaprl.sims.drawing.top_view import patches
from mcaprl.sims.evaluation.evaluate import Improvement, PolicyScore, interquartile_mean, median
from mcaprl.sims.evaluation.rollout import EpisodeResult
from mcaprl.texts import counted

_MAX_PATHS = 30
_PAIRS = (
    "Probability that an episode of the first policy has a higher return than an episode of"
    " the second; ties count half."
)
_CARDS = (
    "env.reset(seed=...) starts the same episode. Episodes that are recorded to a log have the"
    " command that replays them instead. A cross marks an end before the time limit."
)
_FLAT_M = 1.0  # Boxes up to this height are ground and are not drawn


def comparison_figure(
    scores: Sequence[PolicyScore],
    title: str,
    behavior: tuple[float, float, float] | None,
    width: float = 8.0,
    notes: Sequence[str] = (),
) -> Any:
    """Draw mean returns with intervals, a dot per training seed, and `behavior` as a band."""
    # `notes` are lines below the axis.
    figure, axes = new_figure((width, 0.62 * len(scores) + (1.8 if notes else 1.2)))
    if behavior is not None:
        mean, low, high = behavior
        axes.axvspan(low, high, color=PALE, alpha=0.45, lw=0)
        axes.axvline(mean, color=INK, lw=1, ls="--", label=f"behavior in the log {mean:.0f}")
    for row, score in enumerate(scores):
        color = COLORS[row % len(COLORS)]
        axes.barh(row, score.mean_return, color=color, alpha=0.85, height=0.62)
        low, high = _draw_interval(axes, row, score)
        means = score.returns.mean(axis=1)
        if len(means) > 1:
            axes.plot(means, np.full(len(means), row), "o", color=BACKGROUND, mec=INK, ms=4.5)
        label = f"{score.mean_return:.1f}"
        if score.normalized_score is not None:
            label += f"   score {score.normalized_score:.2f}"
        # The label is to the right of the bar, the interval and the dots.
        end = max(high, 0.0, float(means.max()))
        text = axes.annotate(label, (end, row), (8, 0), textcoords="offset points", va="center")
        # The background keeps the label readable where the line of the logged behavior crosses it.
        text.set_bbox({"facecolor": BACKGROUND, "alpha": 0.85, "lw": 0, "pad": 1})
    axes.set_yticks(range(len(scores)), tick_labels(score.policy for score in scores))
    axes.invert_yaxis()
    axes.set_xlim(right=axes.get_xlim()[1] * 1.28)
    axes.set_xlabel("\n".join(notes))
    axes.set_title(title)
    if behavior is not None:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def comparison_notes(scores: Sequence[PolicyScore]) -> list[str]:
    """Return what the figure of a comparison shows, and what is wrong with its intervals."""
    notes = ["mean return; line: 95 % interval; dots: training seeds"]
    if any(_exceeds_returns(score) for score in scores):
        notes.append("arrow: bootstrap-t interval of few, skewed returns; evaluate more episodes")
    if not all(score.has_interval for score in scores):
        notes.append("no interval of 2 seeds, which have one difference; train 3 or more")
    return notes


def _exceeds_returns(score: PolicyScore) -> bool:
    """Return whether an interval contains means that no sample of the returns could have."""
    low, high = score.interval
    return score.has_interval and bool(low < score.returns.min() or high > score.returns.max())


def _draw_interval(axes: Any, row: int, score: PolicyScore) -> tuple[float, float]:
    """Draw an interval, cut at the extreme returns; return the limits of the line."""
    if not score.has_interval:
        return (score.mean_return,) * 2
    limits = (float(score.returns.min()), float(score.returns.max()))
    low, high = np.clip(score.interval, *limits)
    axes.plot([low, high], [row, row], color=INK, lw=2, solid_capstyle="butt")
    for end, wanted, marker in zip((low, high), score.interval, "<>", strict=True):
        if end != wanted:
            axes.plot([end], [row], marker, color=INK, ms=7)
    return float(low), float(high)


def _trajectories(scores: Sequence[PolicyScore], world: Sequence[Shape]) -> list[Panel]:
    """Return a panel for each policy that has positions."""
    return [
        Panel(
            f"{score.policy}: {_ends(score)}",
            partial(_draw_trajectories, score=score, world=world, color=COLORS[row % len(COLORS)]),
            (4.2, 4.8),
        )
        for row, score in enumerate(scores)
        if score.results[0][0].positions.size
    ]


def _draw_trajectories(axes: Any, score: PolicyScore, world: Sequence[Shape], color: str) -> None:
    _draw_world(axes, world)
    episodes = [episode for seed in score.results for episode in seed]
    stride = -(-len(episodes) // _MAX_PATHS)
    for episode in episodes[::stride]:
        x, y = episode.positions.T
        axes.plot(x, y, color=color, lw=1.1, alpha=0.75)
        if episode.reason != "time_limit":
            axes.plot(x[-1], y[-1], "x", color=INK, ms=5, mew=1.3)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")


def _ends(score: PolicyScore) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in score.ends.items())


def evaluation_page(
    folder: Path,
    title: str,
    scores: Sequence[PolicyScore],
    compared: Sequence[Improvement],
    world: Sequence[Shape],
    behavior: tuple[float, float, float] | None,
    recorded: tuple[Path, int] | None,
    curves: Sequence[Figure] = (),
) -> None:
    """Write FOLDER/index.html, comparison.png and trajectories.png."""
    # `recorded` is a log, and the number of first policies in `scores` whose episodes it contains.
    notes = comparison_notes(scores)
    image = comparison_figure(scores, "mean return", behavior, notes=notes)
    save_png(image, folder / "comparison.png")
    # Phones show this width with letters of the size of the page's small print.
    comparison = comparison_figure(scores, "", behavior, width=4.4)
    figures = [Figure.of("; ".join(notes).capitalize(), comparison)]
    sections = [
        Section("Scores", figures=figures, table=_score_table(scores)),
        Section("Probability of improvement", _PAIRS, table=_improvement_table(compared)),
    ]
    if panels := _trajectories(scores, world):
        save_panels(folder / "trajectories.png", panels)
        text = "A cross marks the end of an episode before the time limit."
        figures = [Figure.of(panel.caption, panel.figure()) for panel in panels]
        sections.append(Section("Trajectories", text, figures=figures))
    cards = _cards(scores, world, recorded)
    sections.append(Section("Best and worst episodes", _CARDS, cards=cards))
    if curves:
        sections.append(Section("Learning curves", figures=curves))
    episodes = sum(score.returns.size for score in scores)
    lead = f"{counted(episodes, 'episode')}, greedy actions"
    write_page(folder / PAGE_NAME, title, lead, sections)


def _score_table(scores: Sequence[PolicyScore]) -> Table:
    rows = [
        (
            score.policy,
            f"{score.mean_return:.2f}",
            "" if score.normalized_score is None else f"{score.normalized_score:.3f}",
            "" if score.success_rate is None else f"{score.success_rate:.0%}",
            f"{score.interval[0]:.2f} to {score.interval[1]:.2f}"
            if score.has_interval
            else "none: 2 seeds",
            f"{float(interquartile_mean(score.returns)):.2f}",
            f"{float(median(score.returns)):.2f}",
            _ends(score),
        )
        for score in scores
    ]
    # A phone shows the first columns only.
    names = ("policy", "mean return", "score", "success", "95 % interval", "IQM", "median", "ends")
    # Most environments have neither a pilot nor a known success.
    shown = [k for k in range(len(names)) if any(row[k] for row in rows)]
    return Table([names[k] for k in shown], [[row[k] for k in shown] for row in rows])


def _improvement_table(compared: Sequence[Improvement]) -> Table:
    rows = []
    for one in compared:
        interval = f"{one.interval[0]:.2f} to {one.interval[1]:.2f}"
        rows.append((one.better, one.than, f"{one.probability:.2f}", interval))
    return Table(("policy", "than", "probability", "95 % interval"), rows)


def _cards(
    scores: Sequence[PolicyScore], world: Sequence[Shape], recorded: tuple[Path, int] | None
) -> list[Card]:
    """Return cards of the best and the worst episode of each policy."""
    cards, first = [], 0
    for row, score in enumerate(scores):
        episodes = [episode for seed in score.results for episode in seed]
        totals = [episode.total_reward for episode in episodes]
        for kind, index in (("best", int(np.argmax(totals))), ("worst", int(np.argmin(totals)))):
            episode = episodes[index]
            command = f"env.reset(seed={episode.seed})"
            if recorded is not None and row < recorded[1]:
                command = f"mcaprl replay {recorded[0]} --episode {first + index}"
            steps = counted(episode.length, "step")
            text = f"return {episode.total_reward:.4g}, {steps}, {episode.reason}"
            thumbnail = _thumbnail(episode, world, COLORS[row % len(COLORS)])
            cards.append(Card(f"{score.policy}: {kind}", text, thumbnail, command))
        first += len(episodes)
    return cards


def _thumbnail(episode: EpisodeResult, world: Sequence[Shape], color: str) -> str:
    """Return a trajectory as a small SVG; empty without positions."""
    # The end is a cross if it came before the time limit, otherwise a dot.
    if not episode.positions.size:
        return ""
    figure, axes = new_figure((3.2, 2.2))
    _draw_world(axes, world)
    axes.plot(*episode.positions.T, color=color, lw=1.6)
    marker = "o" if episode.reason == "time_limit" else "x"
    axes.plot(*episode.positions[-1], marker, color=INK, ms=6)
    axes.set_aspect("equal")
    axes.set_axis_off()
    return to_svg(figure)


def _draw_world(axes: Any, world: Sequence[Shape]) -> None:
    """Draw the lines and boxes that are fixed to the map."""
    for shape in world:
        if shape.frame != "map":
            continue
        if shape.kind == "line":
            axes.plot(shape.points[:, 0], shape.points[:, 1], color=PALE, lw=1, zorder=0)
        elif shape.kind == "segments":
            pairs = shape.points[:, :2].reshape(-1, 2, 2)
            # NaN separates the segments.
            strokes = np.pad(pairs, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
            axes.plot(*strokes.reshape(-1, 2).T, color=PALE, lw=1, zorder=0)
        elif shape.kind == "box" and shape.size[2] > _FLAT_M:
            (patch,) = patches([shape])
            axes.fill(*patch.corners_m.T, color=PALE, alpha=0.6, lw=0.8, zorder=0)
