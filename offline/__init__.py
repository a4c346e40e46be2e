"""Offline learning from logs.

DQN, Double DQN, CQL, BC, BCQ and IQL learn discrete actions; BC, TD3+BC, ReBRAC and IQL those of a
Box.

Importing this package does not import torch; the first use of one of its names does.

    import mcaprl

    mcaprl.train("lane.mcap", "runs/lane", algo="cql")
    policy = mcaprl.load_policy("runs/lane")

Raises:
    MissingExtraError: The packages of the `offline` extra are not installed.
"""

from typing import TYPE_CHECKING

from mcaprl.errors import require_extra
from mcaprl.lazy import lazy_attributes

if TYPE_CHECKING:
    from mcaprl.offline.algorithms.config import (
        BootstrapConfig,
        CQLConfig,
        DQNConfig,
        TrainingConfig,
    )
    from mcaprl.offline.algorithms.cql import CQL
    from mcaprl.offline.algorithms.dqn import DoubleDQN
    from mcaprl.offline.algorithms.heads import build_head
    from mcaprl.offline.algorithms.learner import Learner
    from mcaprl.offline.algorithms.registry import ALGORITHMS, BOX_ALGORITHMS
    from mcaprl.offline.algorithms.sac import SAC
    from mcaprl.offline.algorithms.td3 import TD3
    from mcaprl.offline.batches.buffer import TransitionBuffer
    from mcaprl.offline.estimate.evidence import EvidenceCollector, fqe_config
    from mcaprl.offline.estimate.fqe import FQEConfig
    from mcaprl.offline.estimate.importance import ESTIMATORS, EpisodeTable
    from mcaprl.offline.estimate.off_policy import OffPolicyEvaluator
    from mcaprl.offline.selection.choice import DETERMINISTIC
    from mcaprl.offline.training.train import train

require_extra("offline", "torch", "safetensors", "tensorboard")

__all__ = [
    "ALGORITHMS",
    "BOX_ALGORITHMS",
    "CQL",
    "DETERMINISTIC",
    "ESTIMATORS",
    "SAC",
    "TD3",
    "BootstrapConfig",
    "CQLConfig",
    "DQNConfig",
    "DoubleDQN",
    "EpisodeTable",
    "EvidenceCollector",
    "FQEConfig",
    "Learner",
    "OffPolicyEvaluator",
    "TrainingConfig",
    "TransitionBuffer",
    "build_head",
    "fqe_config",
    "train",
]

# These names are imported on first use.
__getattr__ = lazy_attributes(
    __name__,
    {
        "mcaprl.offline.algorithms.config": (
            "BootstrapConfig",
            "CQLConfig",
            "DQNConfig",
            "TrainingConfig",
        ),
        "mcaprl.offline.algorithms.cql": ("CQL",),
        "mcaprl.offline.algorithms.dqn": ("DoubleDQN",),
        "mcaprl.offline.algorithms.heads": ("build_head",),
        "mcaprl.offline.algorithms.learner": ("Learner",),
        "mcaprl.offline.algorithms.registry": ("ALGORITHMS", "BOX_ALGORITHMS"),
        "mcaprl.offline.algorithms.sac": ("SAC",),
        "mcaprl.offline.algorithms.td3": ("TD3",),
        "mcaprl.offline.batches.buffer": ("TransitionBuffer",),
        "mcaprl.offline.estimate.evidence": ("EvidenceCollector", "fqe_config"),
        "mcaprl.offline.estimate.fqe": ("FQEConfig",),
        "mcaprl.offline.selection.choice": ("DETERMINISTIC",),
        "mcaprl.offline.estimate.importance": ("ESTIMATORS", "EpisodeTable"),
        "mcaprl.offline.estimate.off_policy": ("OffPolicyEvaluator",),
        "mcaprl.offline.training.train": ("train",),
    },
)
