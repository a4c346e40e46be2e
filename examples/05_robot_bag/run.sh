#!/usr/bin/env sh
# Learn to drive from the bag of a robot that does not know mcaprl, and from the lane sim's own log
# of the same drives: CQL, four seeds each, scored in the lane sim over the same 30 episodes.
#
#   sh examples/05_robot_bag/run.sh FOLDER       writes into FOLDER
set -eu
here=$(dirname "$0")
out=${1:-robot_bag}
mkdir -p "$out"
rm -rf "$out/runs"
export OMP_NUM_THREADS=1

mcaprl record lane --policy pilot --epsilon 0.1 --episodes 40 --seed 1 --out "$out/native.mcap" --overwrite
mcaprl train-offline "$out/native.mcap" --algo cql --seeds 4 --out "$out/runs/native"

for form in ros2 protobuf json; do
  bag="$out/$form"
  [ "$form" = ros2 ] || bag="$bag.mcap"
  rm -rf "$bag"
  python "$here/make_bag.py" "$out/native.mcap" "$bag" --format "$form"
  mcaprl convert "$bag" --mapping "$here/robot.yaml" --dry-run
  mcaprl train-offline "$bag" --mapping "$here/robot.yaml" --algo cql --seeds 4 --out "$out/runs/$form"
done

mcaprl evaluate "$out/runs/native" "$out/runs/ros2" "$out/runs/protobuf" "$out/runs/json" pilot \
  --sim lane --episodes 30
