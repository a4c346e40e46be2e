"""Offline learning from logs: DQN, Double DQN, CQL and behavior cloning for discrete actions.

Importing this package loads no torch; its modules do.

    from mcaprl.offline.training.train import train
    from mcaprl import load_policy

    train(dataset, "cql", Path("runs/lane"))
    policy = load_policy("runs/lane")

Raises:
    MissingExtraError: the packages of the `offline` extra are not installed.
"""

from importlib.util import find_spec

from mcaprl.errors import MissingExtraError

for _package in ("torch", "safetensors", "tensorboard"):
    if find_spec(_package) is None:
        raise MissingExtraError(f"{_package} is not installed: pip install 'mcaprl[offline]'")
