"""Train offline CQL on the log that an online agent is writing, and plot the scores of both.

python examples/experiments/beside.py FOLDER        creates FOLDER, which must not exist
"""

import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
from plot_beside import draw

import mcaprl
from mcaprl.online import SELECTION_SEED, measure_scale
from mcaprl.runs import read_curve
from mcaprl.sims import evaluate, make_sim

EPISODES, UPDATES_BETWEEN_CHECKPOINTS = 10, 500
out = Path(sys.argv[1] if len(sys.argv) > 1 else "beside")
out.mkdir()
log, online, offline = out / "log.mcap", out / "online", out / "offline"
metrics = offline / "seed-0" / "metrics.csv"
COMMANDS = (
    f"train-online powerline --record {log} --out {online} --steps 8000 --eval-interval 1000"
    " --eval-episodes 10 --final-episodes 10",
    f"train-offline {log} --follow --out {offline} --algo cql --updates 3000 --batch-size 128"
    " --target-interval 100 --gamma 0.95 --n-steps 3 --log-interval 250 --checkpoint-interval"
    f" {UPDATES_BETWEEN_CHECKPOINTS}",
)
program = [sys.executable, "-m", "mcaprl"]
agent, learner = (subprocess.Popen([*program, *command.split()]) for command in COMMANDS)

# Each policy that the learner saves is scored while both commands run.
scores: dict[int, float] = {}
with agent, learner, closing(make_sim("powerline")) as env:
    scale = measure_scale(env, episodes=EPISODES, seed=SELECTION_SEED)
    has_ended = False
    while not has_ended:
        has_ended = learner.poll() is not None
        time.sleep(0.5)
        try:
            policy, updates = mcaprl.load_policy(offline), int(read_curve(metrics)["update"][-1])
        except (mcaprl.McaprlError, OSError, IndexError):  # Nothing is saved yet.
            continue
        updates -= updates % UPDATES_BETWEEN_CHECKPOINTS
        if updates not in scores:
            found = evaluate(env, [policy], name="", episodes=EPISODES, seed=SELECTION_SEED)
            scores[updates] = scale.score(found.mean_return)

rows = read_curve(metrics)
read = dict(zip(rows["update"].astype(int).tolist(), rows["transitions"], strict=True))
whole = np.cumsum(mcaprl.open(log).episode_lengths)
if not set(read.values()) <= set(whole.tolist()):
    raise SystemExit("the offline learner read a part of an episode, or an episode twice")
print(f"the log grew to {whole[-1]} transitions in {len(whole)} episodes; the offline learner")
print(f"saw it at {len(set(read.values()))} different lengths: only complete episodes, each once")
draw(out / "beside.png", read_curve(online / "seed-0" / "curve.csv"), read, scores)
print(out / "beside.png")
