"""Recording of training: behavior probabilities, epsilon and policy version of each step."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from mcaprl.errors import LogError, OutputExistsError, UsageError
from mcaprl.online.double_dqn import WarmDQN
from mcaprl.recorder.record.vector_wrapper import RecordVecMcap
from mcaprl.recorder.repair.recover import recover_log


def log_paths(record: Path, seeds: range, resume: bool) -> dict[int, Path]:
    """Return the log of each seed: the file, or seed-K.mcap in a folder for several seeds.

    Raises:
        UsageError: One file was given for several seeds.
        OutputExistsError: A file exists, and no run is resumed.
    """
    if len(seeds) > 1 and record.suffix == ".mcap":
        raise UsageError(
            f"{len(seeds)} seeds need a folder for one log each; {record} is a file name"
        )
    paths = {seed: record / f"seed-{seed}.mcap" for seed in seeds}
    if record.suffix == ".mcap":
        paths = {seeds[0]: record}
    taken = [path for path in paths.values() if path.exists()]
    if taken and not resume:
        raise OutputExistsError(f"{taken[0]} exists: choose another path to record to")
    return paths


def recorded(
    env: VectorEnv[Any, Any, Any], path: Path, *, algo: str, seed: int, resume: bool = False
) -> RecordVecMcap:
    """Record a batch of environments, with a row for each step of training.

    Args:
        env: Environments to record.
        path: Path of the log.
        algo: Name of the algorithm.
        seed: Seed of the agent.
        resume: Whether to append to an existing log. The log of a killed recorder is recovered
            first, and the damaged file is renamed to `*.damaged`.

    Raises:
        SpaceError, OutputExistsError, LogError: As for `RecordVecMcap`.
    """

    def wrap(append: bool) -> RecordVecMcap:
        return RecordVecMcap(env, path, policy=algo, policy_version=0, seed=seed, append=append)

    if not (resume and path.exists()):
        return wrap(append=False)
    try:
        return wrap(append=True)
    except LogError:
        whole = path.with_name(f"{path.name}.whole")
        recover_log(path, whole, overwrite=True)
        os.replace(path, path.with_name(f"{path.name}.damaged"))
        os.replace(whole, path)
        return wrap(append=True)


class ActionDescriber:
    """A callback for each step that gives the recorder the probabilities of the actions."""

    def __init__(self, recorder: RecordVecMcap, model: BaseAlgorithm) -> None:
        """Describe the actions of `model` to `recorder`."""
        self._recorder, self._model = recorder, model
        self._were_greedy = False
        if isinstance(model, DQN):
            # SB3 evaluates the network only where it does not explore. Another forward pass at
            # each step, to find the greedy action, would cost more than recording.
            model.q_net.register_forward_hook(self._on_forward)

    def __call__(self, actions: NDArray[Any]) -> None:
        """Describe the actions (N,) that the model chose for its last observations."""
        model, recorder = self._model, self._recorder
        recorder.epsilon = epsilon = exploration(model)
        recorder.policy_version = cast(Any, model)._n_updates
        if self._were_greedy:
            count = int(cast(spaces.Discrete, model.action_space).n)
            recorder.behavior_probs = np.full(len(actions), epsilon / count + 1 - epsilon)
        else:
            recorder.behavior_probs = behavior_probabilities(model, actions)
        self.reset()

    def reset(self) -> None:
        """Ignore a forward pass that was not for the next actions."""
        self._were_greedy = False

    def _on_forward(self, network: nn.Module, *_: Any) -> None:
        # Outside of training mode, a forward pass selects actions.
        self._were_greedy = not network.training


def exploration(model: BaseAlgorithm) -> float:
    """Return epsilon of the next step; NaN where the policy is stochastic."""
    if not isinstance(model, DQN):
        return math.nan
    at_random = model.num_timesteps < model.learning_starts
    if at_random and not (isinstance(model, WarmDQN) and model.skips_random_steps):
        return 1.0
    return model.exploration_rate


def behavior_probabilities(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the probabilities with which the model chose these actions.

    With a Q-network and A actions it is epsilon / A, plus 1 - epsilon for the greedy action. SB3
    draws once for all environments whether to explore; the probability is that of one environment.

    Args:
        model: Model in training; the actions are for its last observations.
        actions: Actions (N,).
    """
    if not isinstance(model, DQN):
        return _likelihoods(model, actions)
    assert isinstance(model.action_space, spaces.Discrete)
    epsilon, count = exploration(model), int(model.action_space.n)
    if epsilon == 1.0:
        return np.full(len(actions), 1 / count)
    with torch.inference_mode():
        values = model.q_net(model.policy.obs_to_tensor(cast(Any, model._last_obs))[0])
        greedy = values.argmax(1).cpu().numpy()
    own: NDArray[np.bool_] = np.asarray(actions) == greedy
    return np.asarray(epsilon / count + (1 - epsilon) * own)


def _likelihoods(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the probabilities of actions drawn from an actor's distribution."""
    policy = model.policy
    assert isinstance(policy, ActorCriticPolicy)
    with torch.inference_mode():
        observations = policy.obs_to_tensor(cast(Any, model._last_obs))[0]
        chosen = torch.as_tensor(actions, device=policy.device)
        logarithms = policy.get_distribution(observations).log_prob(chosen)
    return np.exp(logarithms.cpu().numpy().astype(np.float64))
