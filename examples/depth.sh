#!/usr/bin/env sh
# Learning to drive from pictures alone: a pilot's depth camera log in, a policy out.
#
#   sh examples/depth.sh FOLDER       writes below FOLDER, over what an earlier run left
set -eu
out=${1:-depth}
mkdir -p "$out"
for made in data runs; do
  rm -rf "${out:?}/$made"
done
export OMP_NUM_THREADS=1

number=1
for mix in "0.05 25" "0.1 25" "0.2 50" "0.3 50"; do
  mcaprl record lane --observation depth --no-scene --policy pilot \
    --epsilon "${mix% *}" --episodes "${mix#* }" --seed "$number" --out "$out/data/pilot-$number.mcap"
  number=$((number + 1))
done
mcaprl record lane --observation depth --no-scene --policy random \
  --episodes 50 --seed "$number" --out "$out/data/random.mcap"

# A single picture does not tell the speed; four in a row do.
mcaprl train-offline "$out/data" --algo cql --seeds 4 --frame-stack 4 --hidden 256 \
  --batch-size 32 --learning-rate 3e-4 --updates 4000 --out "$out/runs/cql"
mcaprl evaluate "$out/runs/cql" pilot random --sim lane --observation depth --behavior "$out/data"
