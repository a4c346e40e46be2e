"""Reads `/rl/learner`: how the policy that acted learned meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.chunks import record_dtype
from mcaprl.recorder.log_writer import LEARNER_TOPIC
from mcaprl.recorder.mcap_reader import McapReader
from mcaprl.recorder.schema import LEARNER_TEXT, message_dtype


@dataclass(frozen=True, eq=False)
class LearnerColumns:
    """One row for each transition of a log, in the log's order.

    Attributes:
        log_time_ns: (N,) when its observation was made.
        epsilon: (N,) probability of a random action; NaN if unknown.
        policy_version: (N,) updates that the policy had seen; -1 if unknown.
    """

    log_time_ns: NDArray[np.int64]
    epsilon: NDArray[np.float64]
    policy_version: NDArray[np.int64]


def read_learner(path: str | Path) -> LearnerColumns:
    """Read what `RecordVecMcap(..., policy_version=...)` wrote beside the transitions.

    Raises:
        LogError: the file has no such topic, or is damaged.
    """
    reader = McapReader(path)
    channel = reader.channel_of(LEARNER_TOPIC)
    dtype = message_dtype(LEARNER_TEXT)
    if channel is None or dtype is None:
        raise LogError(
            f"{path} has no topic {LEARNER_TOPIC}: it was recorded without a policy version"
        )
    rows = [part.copy() for part in reader.rows(channel, dtype)]
    joined = np.concatenate(rows) if rows else np.empty(0, record_dtype(dtype))
    payload = joined["payload"]
    return LearnerColumns(
        joined["log_time"].astype(np.int64), payload["epsilon"], payload["policy_version"]
    )
