#!/usr/bin/env sh
# The main workflow from end to end. Every line is a command that you can run separately.
#
#   sh examples/demo.sh FOLDER       writes into FOLDER, and replaces the output of an earlier run
set -eu
out=${1:-demo}
mkdir -p "$out"
for made in data runs report cql.log double-dqn.log replay.mcap foxglove-layout.json; do
  rm -rf "${out:?}/$made"
done
# One thread for each training; two trainings run side by side.
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "record a mixed dataset: a pilot with 5 to 30 % random actions, and random actions"
mcaprl record lane --policy pilot --epsilon 0.05 --episodes 25 --seed 1 --out "$out/data/pilot-05.mcap"
mcaprl record lane --policy pilot --epsilon 0.1 --episodes 25 --seed 2 --out "$out/data/pilot-10.mcap"
mcaprl record lane --policy pilot --epsilon 0.2 --episodes 50 --seed 3 --out "$out/data/pilot-20.mcap"
mcaprl record lane --policy pilot --epsilon 0.3 --episodes 50 --seed 4 --out "$out/data/pilot-30.mcap"
mcaprl record lane --policy random --episodes 50 --seed 5 --out "$out/data/random.mcap"
mcaprl info "$out/data"

step "train on these files alone, four seeds each: CQL, offline Double DQN, behavior cloning"
echo "this takes two minutes; CQL and Double DQN run side by side: tail -f $out/*.log"
mcaprl train-offline "$out/data" --algo cql --seeds 4 --out "$out/runs/cql" >"$out/cql.log" 2>&1 &
first=$!
mcaprl train-offline "$out/data" --algo double-dqn --seeds 4 --out "$out/runs/double-dqn" \
  >"$out/double-dqn.log" 2>&1 &
second=$!
# Background jobs ignore Ctrl-C; stop them when this script ends early.
trap 'kill "$first" "$second" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM
wait "$first" && cat "$out/cql.log" || { cat "$out/cql.log"; exit 1; }
mcaprl train-offline "$out/data" --algo bc --seeds 4 --out "$out/runs/bc"
wait "$second" && cat "$out/double-dqn.log" || { cat "$out/double-dqn.log"; exit 1; }

step "evaluate them over the same 30 episodes, with the behavior of the data, random and pilot as references"
mcaprl evaluate "$out/runs/cql" "$out/runs/bc" "$out/runs/double-dqn" pilot random --sim lane \
  --episodes 30 --behavior "$out/data" --report "$out/report"

step "record the trained policy for the replay, with the depth camera"
mcaprl record lane --policy "$out/runs/cql" --episodes 3 --seed 9 --camera --out "$out/replay.mcap"
mcaprl layout "$out/replay.mcap" --out "$out/foxglove-layout.json"
mcaprl check "$out/replay.mcap"

cat <<TXT

Done. $out/ contains
  data/                     the logs for training
  runs/                     the policies, their checkpoints and curves: tensorboard --logdir $out/runs
  report/index.html         the comparison, with 95 % intervals: a page for any browser
  report/comparison.png     the comparison as an image
  report/trajectories.png   the paths of the policies
  report/evaluation.json    the comparison as numbers
  replay.mcap               three drives of the CQL policy: scene, depth camera, rewards
  foxglove-layout.json      the layout for Foxglove and Lichtblick

To view: open app.foxglove.dev or Lichtblick, choose "Open local file", select $out/replay.mcap, then
import $out/foxglove-layout.json from the layout menu. The logs in data/ open the same way.
TXT
