"""Online learning with recording: DQN, Double DQN, PPO and A2C of Stable-Baselines3.

Importing this package loads no torch; its modules do.

    from mcaprl.online.task import Task
    from mcaprl.online.train import train

    train(Task.for_sim("lane", "double-dqn"), "runs/lane", seeds=4)

Raises:
    MissingExtraError: The packages of the `online` extra are not installed.
"""

from importlib.util import find_spec

from mcaprl.errors import MissingExtraError

for _package in ("stable_baselines3", "tensorboard"):
    if find_spec(_package) is None:
        raise MissingExtraError(f"{_package} is not installed: pip install 'mcaprl[online]'")
