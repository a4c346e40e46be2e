#!/usr/bin/env sh
# Train a policy that drives by a depth camera, from a log of a pilot.
#
#   sh examples/experiments/depth.sh FOLDER       writes into FOLDER, and replaces the output of an earlier run
set -eu
out=${1:-depth}
mkdir -p "$out"
for made in data runs; do
  rm -rf "${out:?}/$made"
done
export OMP_NUM_THREADS=1

number=1
for mix in "0.05 25" "0.1 50" "0.2 200" "0.3 200"; do
  mcaprl record lane --observation dashboard --no-scene --policy pilot \
    --epsilon "${mix% *}" --episodes "${mix#* }" --seed "$number" --out "$out/data/pilot-$number.mcap"
  number=$((number + 1))
done

# --normalize centers the images, and also normalizes speed, steering angle and next turn.
mcaprl train-offline "$out/data" --algo cql --seeds 4 --normalize --hidden 256,256 --batch-size 64 \
  --target-interval 100 --updates 8000 --out "$out/runs/cql"
mcaprl evaluate "$out/runs/cql" pilot random --sim lane --observation dashboard --behavior "$out/data"
