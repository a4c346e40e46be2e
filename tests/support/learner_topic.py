"""Reader of `/rl/learner`: the policy's exploration and version during learning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.format.schema import LEARNER_TOPIC


@dataclass(frozen=True, eq=False)
class LearnerColumns:
    """Epsilon and policy version at each of the N transitions of a log, in order.

    Attributes:
        log_time_ns: (N,) log_time of the transition's observation, nanoseconds.
        epsilon: (N,) probability of a random action; NaN if unknown.
        policy_version: (N,) number of updates of the policy; -1 if unknown.
    """

    log_time_ns: NDArray[np.int64]
    epsilon: NDArray[np.float64]
    policy_version: NDArray[np.int64]


def read_learner(path: str | Path) -> LearnerColumns:
    """Read the learner's columns that `RecordVecMcap(..., policy_version=...)` recorded.

    Raises:
        LogError: The file has no topic `/rl/learner`, or is damaged.
    """
    topic = Topic(McapReader(path), LEARNER_TOPIC)
    if not topic.fields:
        raise LogError(
            f"{path} has no topic {LEARNER_TOPIC}: it was recorded without a policy version"
        )
    columns = topic.read(("epsilon", "policy_version"))
    return LearnerColumns(topic.times, columns["epsilon"], columns["policy_version"])
