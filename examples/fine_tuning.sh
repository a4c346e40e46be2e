#!/usr/bin/env sh
# From a poor pilot's logs to a good policy offline, and on from there online; beside it an agent that
# starts with nothing. Some minutes on one core.
#
#   sh examples/fine_tuning.sh FOLDER       writes below FOLDER, which must not exist
set -eu
out=${1:-fine-tuning}
mkdir "$out"
export OMP_NUM_THREADS=1

step() { printf '\n== %s\n' "$*"; }

step "what is known: flights of a pilot that errs three times in ten, and random ones"
mcaprl record powerline --policy pilot --epsilon 0.3 --episodes 30 --seed 1 --no-scene \
  --out "$out/data/pilot.mcap"
mcaprl record powerline --policy random --episodes 30 --seed 2 --no-scene --out "$out/data/random.mcap"

step "learn from these flights alone"
mcaprl train-offline "$out/data" --algo cql --updates 2000 --batch-size 128 --target-interval 100 \
  --gamma 0.95 --n-steps 3 --seeds 4 --out "$out/runs/cql"

step "go on online: each seed from the offline policy of its number"
mcaprl train-online powerline --from "$out/runs/cql" --steps 8000 --learning-rate 1e-4 \
  --eval-interval 1000 --eval-episodes 10 --final-episodes 20 --seeds 4 --out "$out/runs/tuned"

step "start anew, with as many steps"
mcaprl train-online powerline --steps 8000 --eval-interval 1000 --eval-episodes 10 \
  --final-episodes 20 --seeds 4 --out "$out/runs/anew"

python "$(dirname "$0")/compare_curves.py" "$out/runs/tuned" "$out/runs/anew" \
  --title "powerline: from a log and on, and from nothing" --out "$out/curves.png"
