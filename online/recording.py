"""What an agent in training tells its recorder before each step: how its actions came about."""

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
    """The log of each seed: the file itself, or seed-K.mcap in a folder where there are several.

    Raises:
        UsageError: several seeds are to go into one file.
        OutputExistsError: a file is there, and no run is to be resumed.
    """
    if len(seeds) > 1 and record.suffix == ".mcap":
        raise UsageError(
            f"{len(seeds)} seeds write a file of each into a folder; {record} is no name for one"
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
    """Record what a batch of environments does from now on, with a row for each step of learning.

    Args:
        env: to be recorded.
        path: of the log.
        algo: who acts.
        seed: of the agent.
        resume: go on behind the last episode of a log that is there. If its recorder was killed,
            it is recovered first, and the damaged file is kept beside it.

    Raises:
        SpaceError, OutputExistsError, LogError: as `RecordVecMcap`.
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
    """Tells the recorder how likely actions were; to be called with them before each step."""

    def __init__(self, recorder: RecordVecMcap, model: BaseAlgorithm) -> None:
        """Watch a model, which `recorder` records."""
        self._recorder, self._model = recorder, model
        self._were_greedy = False
        if isinstance(model, DQN):
            # SB3 asks the network only where it does not explore. Asking it once more at each
            # step, to know what the greedy action is, would cost more than recording.
            model.q_net.register_forward_hook(self._notice)

    def __call__(self, actions: NDArray[Any]) -> None:
        """Describe the actions (N,) that answer the model's last observations."""
        model, recorder = self._model, self._recorder
        recorder.epsilon = epsilon = exploration(model)
        recorder.policy_version = cast(Any, model)._n_updates
        if self._were_greedy:
            count = int(cast(spaces.Discrete, model.action_space).n)
            recorder.behavior_probs = np.full(len(actions), epsilon / count + 1 - epsilon)
        else:
            recorder.behavior_probs = behavior_probabilities(model, actions)
        self.forget()

    def forget(self) -> None:
        """Call it when the network was asked for anything but the next actions."""
        self._were_greedy = False

    def _notice(self, network: nn.Module, *_: Any) -> None:
        """The network was asked: for actions, if it is not learning."""
        self._were_greedy = not network.training


def exploration(model: BaseAlgorithm) -> float:
    """The probability of a random action in the next step; NaN where the policy is stochastic."""
    if not isinstance(model, DQN):
        return math.nan
    at_random = model.num_timesteps < model.learning_starts
    if at_random and not (isinstance(model, WarmDQN) and model.acts_at_once):
        return 1.0
    return model.exploration_rate


def behavior_probabilities(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """How likely it was that the model chose these actions for its last observations.

    With a Q-network and A actions that is epsilon / A, and 1 - epsilon more for the greedy action.
    SB3 draws once for all environments whether to explore; each one's probability is as if it
    had drawn alone.

    Args:
        model: in training; its last observations are those that the actions answer.
        actions: (N,).
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
    """Of actions that were drawn from an actor's distribution."""
    policy = model.policy
    assert isinstance(policy, ActorCriticPolicy)
    with torch.inference_mode():
        observations = policy.obs_to_tensor(cast(Any, model._last_obs))[0]
        chosen = torch.as_tensor(actions, device=policy.device)
        logarithms = policy.get_distribution(observations).log_prob(chosen)
    return np.exp(logarithms.cpu().numpy().astype(np.float64))
