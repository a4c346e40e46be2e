"""Writes files of policies that every later version has to read, and what these policies do.

`python -m tests.golden.make_policies` writes only missing files and never replaces existing files.
NAME.npz has observations of B episodes at T successive steps, and the outputs of the policy NAME.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import A2C, DQN, PPO

from mcaprl.api.policies import load_policy
from mcaprl.architecture import Architecture
from mcaprl.errors import PolicyError
from mcaprl.frames import stacked_space
from mcaprl.networks import ImageInput
from mcaprl.offline.algorithms.registry import choose_algorithm
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.policy import save_policy
from mcaprl.online.features import NetworkDQNPolicy, normalize_images, policy_arguments
from mcaprl.online.zip_file import describe_run
from mcaprl.online.zip_file import save_policy as save_model
from mcaprl.recorder.dataset.dataset import Dataset

FOLDER = Path(__file__).parent / "policies"
STEPS, EPISODES = 4, 3
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
CAMERA = spaces.Box(0, 255, (36, 36, 1), np.uint8)
PARTS = spaces.Dict(
    {
        "action_mask": spaces.MultiBinary(3),
        "camera": CAMERA,
        "deep": spaces.Dict(
            {"gear": spaces.Discrete(3, start=-1), "bytes": spaces.Box(0, 255, (2,), np.uint8)}
        ),
        "motion": VECTOR,
    }
)
COMPACT: dict[str, Any] = {"encoder": "compact", "channels": (2, 4)}


class Still(gym.Env[Any, Any]):
    """Environment with given spaces, whose observations are random."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(**kwargs)
        return self.observation_space.sample(), {}


def offline(
    path: Path, seed: int, *, algo: str, observation_space: Any, action_space: Any, **settings: Any
) -> None:
    """Write a run's policy after a few updates on random data."""
    seen = drawn(observation_space, 41, seed=1)
    actions = drawn(action_space, 40, seed=2)
    if isinstance(observation_space, spaces.Dict):
        seen["action_mask"][:] = 1
    ends = np.arange(40) % 10 == 9
    dataset = Dataset.from_arrays(
        observations=rows(seen, slice(0, 40)),
        actions=actions,
        rewards=np.random.default_rng(3).normal(size=40),
        terminated=ends,
        truncated=np.zeros(40, bool),
        next_observations=rows(seen, slice(1, 41)),
        observation_space=observation_space,
        action_space=action_space,
    )
    learner_type, defaults = choose_algorithm(algo)
    config = type(defaults)(updates=20, batch_size=16, hidden=(8, 4), **settings)
    learner = learner_type(config, TransitionBuffer.from_dataset(dataset, config.packing), [seed])
    for _ in range(20):
        learner.update()
    path.mkdir(exist_ok=True)
    save_policy(path, learner, seed, "Still-v0", {"height": 2})


def online(
    path: Path,
    seed: int,
    *,
    kind: Any,
    observation_space: Any,
    stack: int = 1,
    ours: bool = True,
    **kwargs: Any,
) -> None:
    """Write a model of Stable-Baselines3 with random weights, as this package or SB3 does."""
    env = Still(stacked_space(observation_space, stack), spaces.Discrete(4))
    architecture = kwargs.get("architecture")
    policy: Any = "MlpPolicy"
    policy_kwargs = {"net_arch": [8], **kwargs.get("policy_kwargs", {})}
    if architecture is not None:
        policy, policy_kwargs = NetworkDQNPolicy, policy_arguments(architecture)
    others = {"buffer_size": 10} if kind is DQN else {"n_steps": 64}
    model = kind(policy, env, seed=seed, device="cpu", policy_kwargs=policy_kwargs, **others)
    if architecture is not None:
        images = drawn(observation_space, 9, seed=4)["camera"]
        camera = ImageInput(images.shape[1:]).normalized_to(images)
        normalize_images(model.policy, [camera], stack)
    if not ours:
        model.save(path)
        return
    run = describe_run(
        kind.__name__.lower(),
        (8,),
        observation_space,
        env.action_space,
        "Still-v0",
        {"height": 2},
        stack,
        architecture,
    )
    save_model(path, model, run)


SMALL = spaces.Dict(
    {"camera": CAMERA, "motion": VECTOR, "wind": spaces.Box(-1, 1, (2,), np.float32)}
)
TWO, THREE = spaces.Discrete(2, start=5), spaces.Discrete(3)
CASES: dict[str, partial[None]] = {
    "dqn": partial(
        offline,
        algo="dqn",
        observation_space=VECTOR,
        action_space=TWO,
        n_quantiles=3,
        scale_rewards=True,
    ),
    "double-dqn": partial(
        offline,
        algo="double-dqn",
        observation_space=VECTOR,
        action_space=TWO,
        dueling=True,
        frame_stack=3,
    ),
    "cql": partial(
        offline,
        algo="cql",
        observation_space=VECTOR,
        action_space=spaces.MultiDiscrete([2, 3]),
        normalize=True,
        layer_norm=True,
    ),
    "bc": partial(offline, algo="bc", observation_space=VECTOR, action_space=spaces.MultiBinary(2)),
    "bcq": partial(
        offline, algo="bcq", observation_space=PARTS, action_space=THREE, frame_stack=2, **COMPACT
    ),
    "iql": partial(offline, algo="iql", observation_space=CAMERA, action_space=TWO, **COMPACT),
    "online-dqn.zip": partial(online, kind=DQN, observation_space=VECTOR, stack=3),
    "online-ppo.zip": partial(online, kind=PPO, observation_space=VECTOR),
    "online-camera.zip": partial(
        online,
        kind=DQN,
        observation_space=SMALL,
        stack=2,
        architecture=Architecture((8, 4), (2, 4), dueling=True, encoder="compact"),
    ),
    "sb3-dqn.zip": partial(online, kind=DQN, observation_space=VECTOR, ours=False),
    "sb3-a2c.zip": partial(
        online,
        kind=A2C,
        observation_space=VECTOR,
        ours=False,
        policy_kwargs={"net_arch": {"pi": [5, 4], "vf": [4]}, "activation_fn": torch.nn.ELU},
    ),
}


def drawn(space: spaces.Space[Any], count: int, seed: int) -> Any:
    """Return random values (count, *shape) of a space, or a dict of them."""
    if isinstance(space, spaces.Dict):
        return {key: drawn(part, count, seed + n) for n, (key, part) in enumerate(space.items())}
    space.seed(seed)
    return np.stack([space.sample() for _ in range(count)])


def rows(values: Any, index: Any) -> Any:
    """Return rows of an array, or of each array in a dict."""
    if isinstance(values, dict):
        return {key: rows(part, index) for key, part in values.items()}
    return values[index]


def outputs(policy: Any, seen: Any) -> dict[str, NDArray[Any]]:
    """Return what a policy does with observations (T * B, *shape) of B episodes at T steps.

    Returns:
        `actions`: actions (T, B, ...) of calls with one observation of each episode.
        `probabilities`, `q_values`: (T * B, A); the latter only if the policy has values.
    """
    steps = np.arange(STEPS * EPISODES).reshape(STEPS, EPISODES)
    policy.begin()
    found = {"actions": np.stack([policy.act(rows(seen, step)) for step in steps])}
    stack = policy.frame_stack
    if stack > 1:
        ages = np.arange(stack)[::-1] * EPISODES
        seen = rows(
            seen, np.maximum(steps.ravel()[:, None] - ages, steps.ravel()[:, None] % EPISODES)
        )
    found["probabilities"] = policy.action_probabilities(seen)
    with suppress(PolicyError):
        found["q_values"] = policy.q_values(seen)
    return found


def leaves(values: Any, name: str = "observation") -> dict[str, NDArray[Any]]:
    """Return the arrays in a nested dict by their dotted names."""
    if not isinstance(values, dict):
        return {name: values}
    return {k: v for key, part in values.items() for k, v in leaves(part, f"{name}.{key}").items()}


def restored(arrays: Any) -> Any:
    """Return the nested dict that `leaves` divided; other arrays are left out."""
    tree: dict[str, Any] = {}
    for name in arrays:
        *folders, last = name.split(".")
        if folders[:1] == ["observation"] or last == "observation":
            node = tree
            for folder in folders:
                node = node.setdefault(folder, {})
            node[last] = arrays[name]
    return tree["observation"]


def main() -> None:
    """Write the missing files."""
    for name, write in CASES.items():
        path = FOLDER / name
        if path.exists():
            continue
        seen = drawn(write.keywords["observation_space"], STEPS * EPISODES, seed=5)
        seed, found = 0, {"actions": np.zeros(1)}
        while len(np.unique(found["actions"])) == 1:
            write(path, seed)
            seed, found = seed + 1, outputs(load_policy(path), seen)
        arrays: dict[str, Any] = {**leaves(seen), **found}
        np.savez_compressed(FOLDER / f"{path.stem}.npz", **arrays)


if __name__ == "__main__":
    main()
