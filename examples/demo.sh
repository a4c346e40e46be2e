#!/usr/bin/env sh
# The main workflow from end to end. Every line is a command that you can run separately.
#
#   sh examples/demo.sh FOLDER       writes into FOLDER, and replaces the output of an earlier run
set -eu
out=${1:-demo}
mkdir -p "$out"
(cd "$out" && rm -rf data runs report iql.log td3-bc.log replay.mcap foxglove-layout.json)
# One thread for each training; two trainings run side by side.
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "1 of 4: record a pilot with random errors, and random commands of pedal and steering"
mcaprl record lane --actions continuous --policy pilot --noise 0.1 --noise-per-episode \
  --episodes 25 --seed 1 --out "$out/data/noise-10.mcap"
mcaprl record lane --actions continuous --policy pilot --noise 0.3 --noise-per-episode \
  --episodes 50 --seed 2 --out "$out/data/noise-30.mcap"
mcaprl record lane --actions continuous --policy pilot --epsilon 0.3 --episodes 50 --seed 3 \
  --out "$out/data/epsilon-30.mcap"
mcaprl record lane --actions continuous --policy random --episodes 50 --seed 4 --out "$out/data/random.mcap"
mcaprl info "$out/data"

step "2 of 4: train on these files alone, four seeds of each algorithm"
echo "IQL and TD3+BC train side by side, for about two minutes:"
mcaprl train-offline "$out/data" --algo iql --seeds 4 --out "$out/runs/iql" >"$out/iql.log" 2>&1 &
first=$!
mcaprl train-offline "$out/data" --algo td3-bc --seeds 4 --out "$out/runs/td3-bc" \
  >"$out/td3-bc.log" 2>&1 &
second=$!
tail -F "$out/iql.log" 2>/dev/null &
shown=$!
# Background jobs ignore Ctrl-C; stop them when this script ends early.
trap 'kill "$first" "$second" "$shown" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM
wait "$first"
sleep 1 && kill "$shown"
wait "$second" || { cat "$out/td3-bc.log"; exit 1; }
echo "behavior cloning:"
mcaprl train-offline "$out/data" --algo bc --seeds 4 --out "$out/runs/bc"

step "3 of 4: evaluate all of them, the pilot and random actions over 30 episodes"
mcaprl evaluate "$out/runs/iql" "$out/runs/bc" "$out/runs/td3-bc" pilot random --sim lane \
  --actions continuous --episodes 30 --behavior "$out/data" --report "$out/report"

step "4 of 4: record the trained policy for the replay, with the depth camera"
mcaprl record lane --actions continuous --policy "$out/runs/iql" --episodes 3 --seed 9 --camera \
  --out "$out/replay.mcap"
mcaprl layout "$out/replay.mcap" --out "$out/foxglove-layout.json"
mcaprl check "$out/replay.mcap"

cat <<TXT

Done. $out/ contains
  data/                  the logs for training
  runs/                  the policies, their checkpoints and curves.png
  report/index.html      the comparison, with 95 % intervals: open it in a browser
  replay.mcap            three drives of the IQL policy, with scene and camera
  foxglove-layout.json   the layout; in Foxglove or Lichtblick, open replay.mcap and import it
TXT
