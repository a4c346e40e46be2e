"""Learners of the suite: those of this package, d3rlpy's, and policies that were made elsewhere."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

import mcaprl
from benchmarks.suite.tasks import Task, space_of
from mcaprl.api import load_policies
from mcaprl.architecture import ENCODERS
from mcaprl.offline import ALGORITHMS, BOX_ALGORITHMS, BootstrapConfig

SHARED: Final[dict[str, Any]] = {
    "updates": 3_000,
    "batch_size": 64,
    "hidden": (64, 64),
    "learning_rate": 1e-3,
}
"""Settings of all learners of the tiers `tests` and `study`."""
RELEASE: Final[dict[str, Any]] = SHARED | {
    "updates": 50_000,
    "batch_size": 256,
    "hidden": (256, 256),
    "learning_rate": 3e-4,
}
TARGET: Final = {"target_interval": 60}
"""Updates between two copies to the target network, of both packages."""
POLYAK: Final = 0.02
"""Weight of the networks in an update of the target networks, of both packages."""
RIVALS: Final = {
    "bc": "DiscreteBCConfig",
    "double-dqn": "DoubleDQNConfig",
    "cql": "DiscreteCQLConfig",
    "bcq": "DiscreteBCQConfig",
}
BOX_RIVALS: Final = {
    "bc": "BCConfig",
    "td3-bc": "TD3PlusBCConfig",
    "iql": "IQLConfig",
    "rebrac": "ReBRACConfig",
}
"""Configs of d3rlpy by the name of the same algorithm here."""
RIVAL: Final = "d3rlpy-"
Trained = tuple[Sequence[Any], float]
"""Policies of all seeds, and the CPU seconds that training them took."""


def is_box(task: Task) -> bool:
    """Return whether the actions of a task are those of a Box."""
    return isinstance(space_of(task), gym.spaces.Box)


def learners_of(task: Task, *, with_rivals: bool) -> list[str]:
    """Return the names of the learners that fit a task."""
    own, rivals = (BOX_ALGORITHMS, BOX_RIVALS) if is_box(task) else (ALGORITHMS, RIVALS)
    # Of the two kinds of plain Q-learning, Double DQN is the better one.
    names = [name for name in own if name != "dqn"]
    return names + [RIVAL + name for name in rivals if with_rivals]


def settings_of(task: Task, algo: str) -> dict[str, Any]:
    """Return the settings of a learner of this package; all others are its defaults."""
    settings, box = RELEASE if task.tier == "release" else SHARED, is_box(task)
    if algo == "auto":
        return settings | {"gamma": task.gamma} | ({} if box else TARGET)
    learner = (BOX_ALGORITHMS if box else ALGORITHMS).get(algo)
    if learner is None:
        return settings
    if issubclass(learner.config_type, BootstrapConfig):
        settings = settings | {"gamma": task.gamma}
        if algo in RIVALS:
            settings = settings | TARGET
    return settings


def train_ours(task: Task, data: mcaprl.Dataset, algo: str, seeds: int, folder: Path) -> Trained:
    """Train an algorithm of this package, or one that an installed package adds."""
    shutil.rmtree(folder, ignore_errors=True)
    began_s = time.process_time()
    mcaprl.train(data, folder, algo=algo, seeds=seeds, **settings_of(task, algo))
    return load_policies(folder), time.process_time() - began_s


def train_d3rlpy(task: Task, data: mcaprl.Dataset, algo: str, seeds: int) -> Trained:
    """Train with d3rlpy; what `settings_of` does not share has d3rlpy's defaults."""
    import d3rlpy

    box, shared = is_box(task), RELEASE if task.tier == "release" else SHARED
    space = d3rlpy.ActionSpace.CONTINUOUS if box else d3rlpy.ActionSpace.DISCRETE
    log = d3rlpy.dataset.MDPDataset(
        _inputs(data.observations),
        data.actions,
        data.rewards.astype(np.float32),
        data.terminated.astype(np.float32),
        data.truncated.astype(np.float32),
        action_space=space,
    )
    settings: dict[str, Any] = {"batch_size": shared["batch_size"]}
    if len(data.observation_space.shape or ()) == 3:
        small = ENCODERS["small"]
        filters = [
            [size, *kernel] for size, kernel in zip(small.channels, small.kernels, strict=True)
        ]
        encoder = d3rlpy.models.PixelEncoderFactory(filters, shared["hidden"][0])
        settings |= {"observation_scaler": d3rlpy.preprocessing.PixelObservationScaler()}
    else:
        encoder = d3rlpy.models.VectorEncoderFactory(list(shared["hidden"]))
    parts = ("actor_", "critic_") if box and algo != "bc" else ("",)
    for part in parts:
        settings |= {f"{part}encoder_factory": encoder}
        settings |= {f"{part}learning_rate": shared["learning_rate"]}
    if algo == "iql":
        settings |= {"value_encoder_factory": encoder}
    if isinstance(data.action_space, spaces.Box):
        bounds = {"minimum": data.action_space.low, "maximum": data.action_space.high}
        settings |= {
            "observation_scaler": d3rlpy.preprocessing.StandardObservationScaler(),
            "action_scaler": d3rlpy.preprocessing.MinMaxActionScaler(**bounds),
        }
    if algo != "bc":
        settings |= {"gamma": task.gamma}
        settings |= (
            {"tau": POLYAK} if box else {"target_update_interval": TARGET["target_interval"]}
        )
    config = getattr(d3rlpy.algos, (BOX_RIVALS if box else RIVALS)[algo])
    policies, began_s = [], time.process_time()
    for seed in range(seeds):
        d3rlpy.seed(seed)
        learner = config(**settings).create("cpu")
        learner.fit(
            log,
            n_steps=shared["updates"],
            n_steps_per_epoch=shared["updates"],
            show_progress=False,
            save_interval=10,
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        )
        policies.append(_Predictor(learner.predict))
    return policies, time.process_time() - began_s


class _Predictor:
    """Policy of d3rlpy."""

    is_deterministic = True

    def __init__(self, predict: Callable[[Any], Any]) -> None:
        self._predict = predict

    def act(self, observations: Any) -> Any:
        return self._predict(_inputs(observations))


def _inputs(observations: NDArray[Any]) -> NDArray[Any]:
    """Return observations as d3rlpy expects them: images with the channels first, or float32."""
    seen = np.asarray(observations)
    return np.moveaxis(seen, -1, 1) if seen.ndim == 4 else seen.astype(np.float32)


def train(task: Task, data: mcaprl.Dataset, learner: str, seeds: int, folder: Path) -> Trained:
    """Train the seeds of a learner by its name."""
    if learner.startswith(RIVAL):
        return train_d3rlpy(task, data, learner.removeprefix(RIVAL), seeds)
    return train_ours(task, data, learner, seeds, folder)
