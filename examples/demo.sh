#!/usr/bin/env sh
# The main workflow from end to end. Every line is a command that you can run separately.
#
#   sh examples/demo.sh FOLDER       writes into FOLDER, and replaces the output of an earlier run
set -eu
out=${1:-demo}
mkdir -p "$out"
(cd "$out" && rm -rf data runs report cql.log double-dqn.log replay.mcap foxglove-layout.json)
# One thread for each training; two trainings run side by side.
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "1 of 4: record a pilot with 5 to 30 % random actions, and random actions"
mcaprl record lane --policy pilot --epsilon 0.05 --episodes 25 --seed 1 --out "$out/data/pilot-05.mcap"
mcaprl record lane --policy pilot --epsilon 0.1 --episodes 25 --seed 2 --out "$out/data/pilot-10.mcap"
mcaprl record lane --policy pilot --epsilon 0.2 --episodes 50 --seed 3 --out "$out/data/pilot-20.mcap"
mcaprl record lane --policy pilot --epsilon 0.3 --episodes 50 --seed 4 --out "$out/data/pilot-30.mcap"
mcaprl record lane --policy random --episodes 50 --seed 5 --out "$out/data/random.mcap"
mcaprl info "$out/data"

step "2 of 4: train on these files alone, four seeds of each algorithm"
echo "CQL and offline Double DQN train side by side, for about two minutes:"
mcaprl train-offline "$out/data" --algo cql --seeds 4 --out "$out/runs/cql" >"$out/cql.log" 2>&1 &
first=$!
mcaprl train-offline "$out/data" --algo double-dqn --seeds 4 --out "$out/runs/double-dqn" \
  >"$out/double-dqn.log" 2>&1 &
second=$!
tail -F "$out/cql.log" 2>/dev/null &
shown=$!
# Background jobs ignore Ctrl-C; stop them when this script ends early.
trap 'kill "$first" "$second" "$shown" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM
wait "$first"
sleep 1 && kill "$shown"
wait "$second" || { cat "$out/double-dqn.log"; exit 1; }
echo "behavior cloning, half as many updates:"
mcaprl train-offline "$out/data" --algo bc --updates 4000 --seeds 4 --out "$out/runs/bc"

step "3 of 4: evaluate all of them, the pilot and random actions over 30 episodes"
mcaprl evaluate "$out/runs/cql" "$out/runs/bc" "$out/runs/double-dqn" pilot random --sim lane \
  --episodes 30 --behavior "$out/data" --report "$out/report"

step "4 of 4: record the trained policy for the replay, with the depth camera"
mcaprl record lane --policy "$out/runs/cql" --episodes 3 --seed 9 --camera --out "$out/replay.mcap"
mcaprl layout "$out/replay.mcap" --out "$out/foxglove-layout.json"
mcaprl check "$out/replay.mcap"

cat <<TXT

Done. $out/ contains
  data/                  the logs for training
  runs/                  the policies, their checkpoints and curves.png
  report/index.html      the comparison, with 95 % intervals: open it in a browser
  replay.mcap            three drives of the CQL policy, with scene and camera
  foxglove-layout.json   the layout for Foxglove and Lichtblick

To watch a drive: in app.foxglove.dev or Lichtblick, choose "Open local file",
open $out/replay.mcap, and import $out/foxglove-layout.json from the layout menu.
TXT
