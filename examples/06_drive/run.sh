#!/usr/bin/env sh
# From a robot's bag to a policy that drives the robot over DDS, and from the log of this drive to
# the next policy. The robot is another process, which knows nothing of policies; after each drive
# it prints the score: the return as a fraction of its pilot's in the same episodes.
#
#   sh examples/06_drive/run.sh FOLDER                 a car with a pedal and a steering wheel
#   sh examples/06_drive/run.sh FOLDER car-buttons     a car with six buttons
#   sh examples/06_drive/run.sh FOLDER drone           a drone, commanded by velocities
#   sh examples/06_drive/run.sh FOLDER drone-buttons   a drone with seven buttons
set -eu
here=$(dirname "$0")
out=${1:-drive}
kind=${2:-car}
export OMP_NUM_THREADS=1 ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-42}"

case $kind in
  car) sim=lane actions=continuous noise=0.1 episodes=80 algo=iql ;;
  car-buttons) sim=lane actions=discrete noise=0.1 episodes=80 algo=cql ;;
  drone) sim=powerline actions=continuous noise=0.2 episodes=120 algo=bc ;;
  drone-buttons) sim=powerline actions=discrete noise=0.1 episodes=80 algo=bc ;;
  *) echo "the second argument is car, car-buttons, drone, drone-buttons or nothing" >&2 && exit 2 ;;
esac

# Drive the robot with a policy, and record the drive.
drive() {
  python "$here/robot.py" "$sim" "$actions" --episodes "${EPISODES:-8}" --limit 200 \
    --seed "${SEED:-1000}" &
  robot=$!
  # The robot does without commands for half a second.
  mcaprl drive "$1" --dds --deadline 0.3 --record "$2" --quiet &
  driver=$!
  wait "$robot"
  kill "$driver" 2>/dev/null || true
  wait "$driver" || true
}

rm -rf "$out"
mkdir -p "$out"
python "$here/robot.py" "$sim" "$actions" --pilot --noise "$noise" --bag "$out/bag" \
  --episodes "${RECORDED:-$episodes}" --limit 200 --seed 1
mcaprl train-offline "$out/bag" --mapping "$here/$kind.yaml" --algo "$algo" \
  --updates "${UPDATES:-4000}" --out "$out/first"
mcaprl drive "$out/first" --bag "$out/bag"
drive "$out/first" "$out/first.mcap"

mcaprl convert "$out/bag" "$out/bag.mcap" --mapping "$here/$kind.yaml"
mcaprl train-offline "$out/bag.mcap" "$out/first.mcap" --algo "$algo" \
  --updates "${UPDATES:-4000}" --out "$out/second"
drive "$out/second" "$out/second.mcap"
