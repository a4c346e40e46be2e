#!/usr/bin/env sh
# Compare the published rewards with the default ones: the same learner and settings, four seeds each,
# measured by the distance along the path. About ten minutes on one core.
#
#   sh examples/experiments/classic_reward.sh FOLDER       creates FOLDER, which must not exist
set -eu
out=${1:-classic-reward}
mkdir "$out"
export OMP_NUM_THREADS=1

# learn SIM RULES SETTING...
learn() {
  sim=$1 rules=$2
  shift 2
  mcaprl train-online "$sim" --rules "$rules" "$@" --seeds 4 --learning-rate 5e-4 \
    --final-learning-rate-fraction 0.04 --hidden 256,256 --batch-size 128 --learning-starts 2000 \
    --exploration-fraction 0.3 --eval-episodes 10 --out "$out/$sim/$rules"
}

for rules in default classic; do
  learn powerline "$rules" --steps 8000 --gamma 0.95 --n-steps 3 --target-update-interval 2000 \
    --eval-interval 1000 --final-episodes 20
  learn lane "$rules" --steps 20000 --gamma 0.97 --target-update-interval 1000 --eval-interval 2000 \
    --final-episodes 10
done
for sim in powerline lane; do
  python "$(dirname "$0")/compare_curves.py" "$out/$sim/default" "$out/$sim/classic" \
    --value mean_progress_m --title "$sim: the default and the classic reward" \
    --out "$out/$sim.png"
done
