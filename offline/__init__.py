"""Offline learning from logs: DQN, Double DQN, CQL, BC, BCQ and IQL for discrete actions.

Importing this package does not import torch; the first use of one of its names does.

    import mcaprl

    mcaprl.train("lane.mcap", "runs/lane", algo="cql")
    policy = mcaprl.load_policy("runs/lane")

Raises:
    MissingExtraError: The packages of the `offline` extra are not installed.
"""

from importlib.util import find_spec

from mcaprl.errors import MissingExtraError
from mcaprl.lazy import lazy_attributes

for _package in ("torch", "safetensors", "tensorboard"):
    if find_spec(_package) is None:
        raise MissingExtraError(f"{_package} is not installed: pip install 'mcaprl[offline]'")

__all__ = [
    "ALGORITHMS",
    "CQL",
    "DETERMINISTIC",
    "ESTIMATORS",
    "BootstrapConfig",
    "CQLConfig",
    "DQNConfig",
    "DoubleDQN",
    "EpisodeTable",
    "EvidenceCollector",
    "FQEConfig",
    "Learner",
    "OffPolicyEvaluator",
    "Scores",
    "TrainingConfig",
    "TransitionBuffer",
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
        "mcaprl.offline.algorithms.learner": ("Learner",),
        "mcaprl.offline.algorithms.registry": ("ALGORITHMS",),
        "mcaprl.offline.batches.buffer": ("TransitionBuffer",),
        "mcaprl.offline.estimate.evidence": ("EvidenceCollector", "fqe_config"),
        "mcaprl.offline.estimate.fqe": ("FQEConfig",),
        "mcaprl.offline.selection.portfolio": ("DETERMINISTIC",),
        "mcaprl.offline.estimate.importance": ("ESTIMATORS", "EpisodeTable"),
        "mcaprl.offline.estimate.off_policy": ("OffPolicyEvaluator",),
        "mcaprl.offline.policy": ("Scores",),
        "mcaprl.offline.training.train": ("train",),
    },
)
