#!/usr/bin/env sh
# Learn to drive from the bag of a robot that does not know mcaprl, and from the lane sim's own log
# of the same drives: four seeds each, scored in the lane sim over the same 30 episodes. The car has
# a pedal and a steering wheel, from which IQL learns, or six buttons, from which CQL learns.
#
#   sh examples/05_robot_bag/run.sh FOLDER            writes into FOLDER
#   sh examples/05_robot_bag/run.sh FOLDER buttons
set -eu
here=$(dirname "$0")
out=${1:-robot_bag}
mkdir -p "$out"
rm -rf "$out/runs"
export OMP_NUM_THREADS=1

case ${2:-commands} in
  commands) actions=continuous exploration="--noise 0.1 --noise-per-episode" mapping=robot.yaml algo=iql ;;
  buttons) actions=discrete exploration="--epsilon 0.1" mapping=buttons.yaml algo=cql ;;
  *) echo "the second argument is 'buttons' or nothing" >&2 && exit 2 ;;
esac

# shellcheck disable=SC2086
mcaprl record lane --actions "$actions" --policy pilot $exploration --episodes 40 --seed 1 \
  --out "$out/native.mcap" --overwrite
mcaprl train-offline "$out/native.mcap" --algo "$algo" --seeds 4 --out "$out/runs/native"

for form in ros2 protobuf json; do
  bag="$out/$form"
  [ "$form" = ros2 ] || bag="$bag.mcap"
  rm -rf "$bag"
  python "$here/make_bag.py" "$out/native.mcap" "$bag" --format "$form"
  mcaprl convert "$bag" --mapping "$here/$mapping" --dry-run
  mcaprl train-offline "$bag" --mapping "$here/$mapping" --algo "$algo" --seeds 4 \
    --out "$out/runs/$form"
done

mcaprl evaluate "$out/runs/native" "$out/runs/ros2" "$out/runs/protobuf" "$out/runs/json" pilot \
  --sim lane --actions "$actions" --episodes 30
