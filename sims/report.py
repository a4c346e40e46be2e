"""Pictures of an evaluation: how the policies compare, and where they went. Extra: `report`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.figures import COLORS, INK, PALE, new_figure, save_figure
from mcaprl.sims.evaluate import PolicyScore
from mcaprl.sims.scene import Shape

_MAX_PATHS = 30
# What is lower than this is ground, not something to drive around.
_FLAT_M = 1.0


def comparison_picture(
    path: Path,
    scores: Sequence[PolicyScore],
    title: str,
    behavior: tuple[float, float, float] | None,
) -> None:
    """Mean returns with their intervals, a dot for each training seed.

    Args:
        path: of the PNG to write.
        scores: from top to bottom.
        title: over the picture.
        behavior: mean, low and high of the logged episodes' returns, drawn as a band.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure, axes = new_figure(figsize=(8, 0.62 * len(scores) + 1.8))
    if behavior is not None:
        mean, low, high = behavior
        axes.axvspan(low, high, color=PALE, alpha=0.45, lw=0)
        axes.axvline(mean, color=INK, lw=1, ls="--", label=f"behavior in the log {mean:.0f}")
    for row, score in enumerate(scores):
        low, high = score.interval
        color = COLORS[row % len(COLORS)]
        axes.barh(row, score.mean_return, color=color, alpha=0.85, height=0.62)
        axes.plot([low, high], [row, row], color=INK, lw=2, solid_capstyle="butt")
        means = score.returns.mean(axis=1)
        if len(means) > 1:
            axes.plot(means, np.full(len(means), row), "o", color="white", mec=INK, ms=4.5)
        label = f"{score.mean_return:.1f}"
        if score.normalized_score is not None:
            label += f"   score {score.normalized_score:.2f}"
        # Behind the longest of bar, interval and dots.
        end = max(high, 0.0, float(means.max()))
        box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1}
        axes.annotate(label, (end, row), (8, 0), textcoords="offset points", va="center", bbox=box)
    axes.set_yticks(range(len(scores)), [score.policy for score in scores])
    axes.invert_yaxis()
    axes.set_xlim(right=axes.get_xlim()[1] * 1.28)
    axes.set_xlabel("mean return; line: 95 % interval; dots: training seeds")
    axes.set_title(title, loc="left", color=INK)
    if behavior is not None:
        axes.legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def trajectory_picture(path: Path, scores: Sequence[PolicyScore], world: Sequence[Shape]) -> None:
    """Where each policy went, on the map seen from above; a cross where an episode ended early.

    Args:
        path: of the PNG to write.
        scores: a panel each; those without positions are left out.
        world: what stands still, to be drawn beneath.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    shown = [score for score in scores if score.results[0][0].positions.size]
    if not shown:
        return
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    figure, grid = new_figure(figsize=(4.2 * columns, 5.6 * rows), rows=rows, columns=columns)
    panels = np.atleast_1d(grid).ravel()
    for row, (axes, score) in enumerate(zip(panels, shown, strict=False)):
        _draw_world(axes, world)
        color = COLORS[row % len(COLORS)]
        episodes = [episode for seed in score.results for episode in seed]
        stride = -(-len(episodes) // _MAX_PATHS)
        for episode in episodes[::stride]:
            x, y = episode.positions.T
            axes.plot(x, y, color=color, lw=1.1, alpha=0.75)
            if episode.reason != "time_limit":
                axes.plot(x[-1], y[-1], "x", color=INK, ms=5, mew=1.3)
        ends = ", ".join(f"{count} {reason}" for reason, count in score.ends.items())
        axes.set_title(f"{score.policy}\n{ends}", loc="left", fontsize=10, color=INK)
        axes.set_aspect("equal")
        axes.set_xlabel("x, m")
        axes.set_ylabel("y, m")
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    save_figure(figure, path)


def _draw_world(axes: Any, world: Sequence[Shape]) -> None:
    """Lines and boxes that are fixed to the map."""
    for shape in world:
        if shape.frame != "map":
            continue
        if shape.kind == "line":
            axes.plot(shape.points[:, 0], shape.points[:, 1], color=PALE, lw=1, zorder=0)
        elif shape.kind == "box" and shape.size[2] > _FLAT_M:
            corners = _box_corners(shape)
            axes.fill(corners[:, 0], corners[:, 1], color=PALE, alpha=0.6, lw=0, zorder=0)


def _box_corners(shape: Shape) -> Any:
    half_x, half_y = shape.size[0] / 2, shape.size[1] / 2
    local = np.array([(half_x, half_y), (-half_x, half_y), (-half_x, -half_y), (half_x, -half_y)])
    cos, sin = np.cos(shape.yaw_rad), np.sin(shape.yaw_rad)
    return local @ np.array([(cos, sin), (-sin, cos)]) + np.array(shape.position[:2])
