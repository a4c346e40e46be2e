"""Topics of a log, and the sizes of their chunks."""

from __future__ import annotations

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
LOG_TOPIC = "/rosout"
# A chunk has this many rows of /rl/step or this many images, or fewer if they exceed this size.
STEPS_PER_CHUNK = 8192
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# Smallest number of rows in a buffer: the last transition, which stays in memory because its
# episode may end there, a new one, and one more.
MIN_ROWS = 3
IMAGE_FRAME = "camera"
