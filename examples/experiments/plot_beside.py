"""Plot the scores of an online agent, and of an offline learner that reads the agent's log."""

from __future__ import annotations

from pathlib import Path

from mcaprl.page import COLORS, INK, new_figure, save_png
from mcaprl.runs import Curve


def draw(path: Path, curve: Curve, known: dict[int, float], scores: dict[int, float]) -> None:
    """Plot both scores over the number of transitions that were recorded or read."""
    figure, (left, right) = new_figure((9, 3.6), 1, 2)
    left.plot(curve["step"], curve["score"], color=COLORS[0], label="online")
    x = [known[updates] for updates in scores]
    left.plot(x, list(scores.values()), "o-", ms=4, color=COLORS[1], label="offline")
    left.axhline(1, color=INK, lw=1, ls="--", zorder=0)
    left.set_xlabel("transitions recorded or read")
    left.set_ylabel("score: random 0, pilot 1")
    left.legend()
    right.step(list(known), list(known.values()), where="post", color=COLORS[1])
    right.axhline(curve["step"][-1], color=INK, lw=1, ls="--", zorder=0)
    right.set_xlabel("updates of the offline learner")
    right.set_ylabel("transitions read by the offline learner")
    save_png(figure, path)
