#!/usr/bin/env sh
# The main job from end to end. Every line is a command that you can type yourself.
#
#   sh examples/demo.sh FOLDER       writes everything below FOLDER, over what an earlier run left
set -eu
out=${1:-demo}
mkdir -p "$out"
for made in data runs report cql.log double-dqn.log replay.mcap foxglove-layout.json; do
  rm -rf "${out:?}/$made"
done
# One thread for each training; two trainings run side by side.
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "record a mixed data set: a pilot that errs more and more, and one that knows nothing"
mcaprl record lane --policy pilot --epsilon 0.05 --episodes 25 --seed 1 --out "$out/data/pilot-05.mcap"
mcaprl record lane --policy pilot --epsilon 0.1 --episodes 25 --seed 2 --out "$out/data/pilot-10.mcap"
mcaprl record lane --policy pilot --epsilon 0.2 --episodes 50 --seed 3 --out "$out/data/pilot-20.mcap"
mcaprl record lane --policy pilot --epsilon 0.3 --episodes 50 --seed 4 --out "$out/data/pilot-30.mcap"
mcaprl record lane --policy random --episodes 50 --seed 5 --out "$out/data/random.mcap"
mcaprl info "$out/data"

step "learn from these files alone, four seeds each: CQL, offline Double DQN, behavior cloning"
echo "this takes two minutes; CQL and Double DQN run side by side: tail -f $out/*.log"
mcaprl train-offline "$out/data" --algo cql --seeds 4 --out "$out/runs/cql" >"$out/cql.log" 2>&1 &
first=$!
mcaprl train-offline "$out/data" --algo double-dqn --seeds 4 --out "$out/runs/double-dqn" \
  >"$out/double-dqn.log" 2>&1 &
second=$!
# Background jobs do not hear Ctrl-C; end them when this script ends early.
trap 'kill "$first" "$second" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM
wait "$first" && cat "$out/cql.log" || { cat "$out/cql.log"; exit 1; }
mcaprl train-offline "$out/data" --algo bc --seeds 4 --out "$out/runs/bc"
wait "$second" && cat "$out/double-dqn.log" || { cat "$out/double-dqn.log"; exit 1; }

step "evaluate them over the same 30 episodes, beside the data's own behavior, random and pilot"
mcaprl evaluate "$out/runs/cql" "$out/runs/bc" "$out/runs/double-dqn" pilot random --sim lane \
  --episodes 30 --behavior "$out/data" --report "$out/report"

step "record the learnt driver for the replay, depth camera included"
mcaprl record lane --policy "$out/runs/cql" --episodes 3 --seed 9 --camera --out "$out/replay.mcap"
mcaprl layout "$out/replay.mcap" --out "$out/foxglove-layout.json"
mcaprl check "$out/replay.mcap"

cat <<TXT

Done. Under $out/ are now
  data/                     the logs that everything was learnt from
  runs/                     the policies, their checkpoints and curves: tensorboard --logdir $out/runs
  report/index.html         how they compare, with 95 % intervals: a page for any browser
  report/comparison.png     the same as a picture
  report/trajectories.png   where they drove
  report/evaluation.json    the same in numbers
  replay.mcap               three drives of the CQL policy: scene, depth camera, rewards
  foxglove-layout.json      the layout for it

To watch: open app.foxglove.dev or Lichtblick, choose "Open local file", take $out/replay.mcap, then
import $out/foxglove-layout.json from the layout menu. The logs in data/ open the same way.
TXT
