"""Topics of a log, and the sizes of their chunks."""

from __future__ import annotations

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
LOG_TOPIC = "/rosout"
PHASE_TOPIC = "/rl/phase"
RUNNING = "running"
"""Phase of an episode before its end; from then on the phase is the reason of the end."""
# Maximum numbers of /rl/step rows, images and bytes in a chunk.
STEPS_PER_CHUNK = 8192
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# Minimum number of rows in a buffer: the last transition, which stays in memory because it may turn
# out to end its episode, a new one, and one more.
MIN_ROWS = 3
IMAGE_FRAME = "camera"
