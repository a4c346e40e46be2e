"""Topics of a log, and the sizes of their chunks."""

from __future__ import annotations

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
LOG_TOPIC = "/rosout"
# Rows of /rl/step in a chunk, and images in one of theirs: as many, or as few as have this size.
STEPS_PER_CHUNK = 8192
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# A transition that stays behind, one that is new, and one more to make way.
MIN_ROWS = 3
IMAGE_FRAME = "camera"
