#!/usr/bin/env sh
# Learning to drive by a depth camera: a pilot's log of pictures in, a policy out.
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
for mix in "0.05 25" "0.1 50" "0.2 200" "0.3 200"; do
  mcaprl record lane --observation dashboard --no-scene --policy pilot \
    --epsilon "${mix% *}" --episodes "${mix#* }" --seed "$number" --out "$out/data/pilot-$number.mcap"
  number=$((number + 1))
done

# What all pictures have in common says nothing, so it is taken off; half of the usual channels take
# less than half the time.
mcaprl train-offline "$out/data" --algo cql --seeds 4 --normalize --hidden 256,256 --channels 16,32,32 \
  --batch-size 32 --target-interval 100 --updates 8000 --out "$out/runs/cql"
mcaprl evaluate "$out/runs/cql" pilot random --sim lane --observation dashboard --behavior "$out/data"
