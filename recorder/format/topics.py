"""Topics of a log, and the sizes of their chunks."""

from __future__ import annotations

STEP_TOPIC = "/rl/step"
EPISODE_TOPIC = "/rl/episode"
LEARNER_TOPIC = "/rl/learner"
LOG_TOPIC = "/rosout"
PHASE_TOPIC = "/rl/phase"
RUNNING = "running"
"""Phase of a running episode. At its end, the phase changes to the reason of the end."""
# Maximum number of /rl/step rows, of images, and of bytes in one chunk.
STEPS_PER_CHUNK = 4096
IMAGES_PER_CHUNK = 100
BYTES_PER_CHUNK = 8 * 2**20
# Minimum number of rows in a buffer: the last transition, a new transition, and a spare row. The
# last transition stays in memory because it may turn out to be the end of its episode.
MIN_ROWS = 3
IMAGE_FRAME = "camera"
