#!/usr/bin/env sh
# From a depth camera to a policy: train online from images alone, record an episode, make its video.
# About twenty minutes on one core.
#
#   sh examples/experiments/camera.sh FOLDER [SIM] [OBSERVATION]     creates FOLDER, which must not exist
#
# SIM is powerline (OBSERVATION depth) or lane (OBSERVATION dashboard or depth).
set -eu
out=${1:-camera}
sim=${2:-powerline}
observation=${3:-depth}
mkdir "$out"
export OMP_NUM_THREADS=1

mcaprl train-online "$sim" --observation "$observation" ${STEPS:+--steps "$STEPS"} --out "$out/run"
mcaprl evaluate "$out/run" pilot random --sim "$sim" --observation "$observation" --episodes 20
mcaprl record "$sim" --observation "$observation" --policy "$out/run" --episodes 1 \
  --out "$out/episode.mcap"
mcaprl replay "$out/episode.mcap" --video "$out/episode.mp4"
