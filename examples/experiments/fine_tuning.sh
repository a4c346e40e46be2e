#!/usr/bin/env sh
# Train offline on a poor pilot's logs, then continue online; for comparison, train online without data.
# A few minutes on one core.
#
#   sh examples/experiments/fine_tuning.sh FOLDER       creates FOLDER, which must not exist
set -eu
out=${1:-fine-tuning}
mkdir "$out"
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "record flights of a pilot with 30 % random actions, and random flights"
mcaprl record powerline --policy pilot --epsilon 0.3 --episodes 30 --seed 1 --no-scene \
  --out "$out/data/pilot.mcap"
mcaprl record powerline --policy random --episodes 30 --seed 2 --no-scene --out "$out/data/random.mcap"

step "train on these flights alone"
mcaprl train-offline "$out/data" --algo cql --updates 2000 --batch-size 128 --target-interval 100 \
  --gamma 0.95 --n-steps 3 --seeds 4 --out "$out/runs/cql"

step "continue online: each seed from the offline policy of the same number"
mcaprl train-online powerline --from "$out/runs/cql" --steps 8000 --learning-rate 1e-4 \
  --eval-interval 1000 --eval-episodes 10 --final-episodes 20 --seeds 4 --out "$out/runs/tuned"

step "train online without data, with as many steps"
mcaprl train-online powerline --steps 8000 --eval-interval 1000 --eval-episodes 10 \
  --final-episodes 20 --seeds 4 --out "$out/runs/online"

python "$(dirname "$0")/compare_curves.py" "$out/runs/tuned" "$out/runs/online" \
  --title "powerline: offline then online, and online only" --out "$out/curves.png"
