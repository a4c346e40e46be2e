"""Train offline CQL on the log that an online agent is writing, and plot both.

    python examples/beside.py FOLDER        creates FOLDER, which must not exist

Runs these two commands in parallel, and scores each policy that the second one saves:

    mcaprl train-online powerline --record FOLDER/log.mcap --out FOLDER/online ...
    mcaprl train-offline FOLDER/log.mcap --follow --algo cql --out FOLDER/offline ...
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

import mcaprl
from mcaprl.errors import PolicyError
from mcaprl.figures import COLORS, INK, new_figure, save_png
from mcaprl.online import SELECTION_SEED, measure_scale
from mcaprl.runs import Curve, read_curve
from mcaprl.sims import evaluate, make_sim

SIM = "powerline"
EPISODES = 10
ONLINE = {"steps": 8_000, "eval-interval": 1_000, "eval-episodes": 10, "final-episodes": 10}
OFFLINE = {
    "algo": "cql",
    "updates": 3_000,
    "batch-size": 128,
    "target-interval": 100,
    "gamma": 0.95,
    "n-steps": 3,
    "log-interval": 250,
    "checkpoint-interval": 500,
}


def start(*arguments: str, **options: Any) -> subprocess.Popen[bytes]:
    """Start an mcaprl command."""
    arguments += tuple(
        text for name, value in options.items() for text in (f"--{name}", f"{value}")
    )
    print("mcaprl", *arguments, flush=True)
    return subprocess.Popen([sys.executable, "-m", "mcaprl.cli", *arguments])


def scores_while_it_learns(learner: subprocess.Popen[bytes], run: Path) -> dict[int, float]:
    """Score each policy that a run saves during training; return the scores by updates."""
    found: dict[int, float] = {}
    with closing(make_sim(SIM)) as env:
        scale = measure_scale(env, episodes=EPISODES, seed=SELECTION_SEED)
        ended = False
        while not ended:
            ended = learner.poll() is not None
            time.sleep(0.5)
            try:
                policy = mcaprl.load_policy(run)
                updates = int(read_curve(run / "seed-0" / "metrics.csv")["update"][-1])
            except (PolicyError, OSError, IndexError):
                continue
            updates -= updates % OFFLINE["checkpoint-interval"]
            if updates not in found:
                score = evaluate(env, [policy], name="", episodes=EPISODES, seed=SELECTION_SEED)
                found[updates] = scale.score(score.mean_return)
    return found


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


def main() -> None:
    """Run both commands, check what the offline learner read, and plot the scores."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "beside")
    out.mkdir()
    log, online, offline = out / "log.mcap", out / "online", out / "offline"
    agent = start("train-online", SIM, "--record", str(log), "--out", str(online), **ONLINE)
    learner = start("train-offline", str(log), "--follow", "--out", str(offline), **OFFLINE)
    try:
        scores = scores_while_it_learns(learner, offline)
        agent.wait()
    finally:
        agent.kill()
        learner.kill()
    metrics = read_curve(offline / "seed-0" / "metrics.csv")
    known = dict(zip(metrics["update"].astype(int).tolist(), metrics["transitions"], strict=True))
    whole = np.cumsum(mcaprl.open(log).episode_lengths)
    if not set(known.values()) <= set(whole.tolist()):
        raise SystemExit("the offline learner read a part of an episode, or an episode twice")
    grown = len(set(known.values()))
    print(f"the log grew to {whole[-1]} transitions in {len(whole)} episodes; the offline learner")
    print(f"saw it at {grown} different lengths: only complete episodes, and each of them once")
    draw(out / "beside.png", read_curve(online / "seed-0" / "curve.csv"), known, scores)
    print(out / "beside.png")


if __name__ == "__main__":
    main()
