"""Recording of training: behavior probabilities, epsilon and policy version of each step."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from mcaprl.errors import LogError, NoStepsError, NotMcapError, OutputExistsError, UsageError
from mcaprl.files import check_target
from mcaprl.online.algorithms import WarmDQN
from mcaprl.recorder.record.vector_wrapper import RecordVecMcap
from mcaprl.recorder.repair.recover import recover_log


def log_paths(record: Path, seeds: range, resume: bool) -> dict[int, Path]:
    """Return the log of each seed: `record` if it ends in .mcap, else `record`/seed-K.mcap."""
    if len(seeds) > 1 and record.suffix == ".mcap":
        raise UsageError(
            f"{len(seeds)} seeds write one log each: choose a folder; {record} is a file name"
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
    """Wrap a batch of environments to record each step of training."""

    def wrap(append: bool) -> RecordVecMcap:
        return RecordVecMcap(env, path, policy=algo, policy_version=0, seed=seed, append=append)

    if not (resume and path.exists()):
        return wrap(append=False)
    try:
        return wrap(append=True)
    except LogError:
        whole, damaged = (path.with_name(f"{path.name}.{kind}") for kind in ("whole", "damaged"))
        try:
            recover_log(path, whole, overwrite=True)
        except (NoStepsError, NotMcapError):
            # The recorder was killed before its first episode ended.
            with path.open("rb") as file:
                if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))):
                    raise
            check_target(damaged, overwrite=True)
            os.replace(path, damaged)
            return wrap(append=False)
        _keep(path, damaged)
        os.replace(whole, path)
        return wrap(append=True)


def _keep(path: Path, kept: Path) -> None:
    """Link or copy a file to a second path, so that the first path can be replaced atomically."""
    check_target(kept, overwrite=True)
    kept.unlink(missing_ok=True)
    try:
        os.link(path, kept)
    except OSError:
        # Some file systems do not support links.
        shutil.copyfile(path, kept)


class ActionDescriber:
    """Callback that passes the probabilities of each step's actions to the recorder."""

    def __init__(self, recorder: RecordVecMcap, model: BaseAlgorithm) -> None:
        """Prepare to pass the probabilities of the actions of `model` to `recorder`."""
        self._recorder, self._model = recorder, model
        self._were_greedy = False
        if isinstance(model, DQN):
            # SB3 does not run the network when it explores, so a hook detects greedy actions. A
            # second forward pass at each step would take longer than recording.
            model.q_net.register_forward_hook(self._on_forward)

    def __call__(self, actions: NDArray[Any]) -> None:
        """Pass probabilities of the actions (N,), epsilon and policy version to the recorder."""
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
        """Treat the next actions as random unless a forward pass selects them."""
        self._were_greedy = False

    def _on_forward(self, network: nn.Module, *_: Any) -> None:
        # A forward pass outside of training mode selects actions; one in training mode does not.
        self._were_greedy = not network.training


def exploration(model: BaseAlgorithm) -> float:
    """Return epsilon of the next step; NaN if the policy is stochastic."""
    if not isinstance(model, DQN):
        return math.nan
    at_random = model.num_timesteps < model.learning_starts
    if at_random and not (isinstance(model, WarmDQN) and model.skips_random_steps):
        return 1.0
    return model.exploration_rate


def behavior_probabilities(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the probabilities with which the model chose these actions.

    With a Q-network and A actions, the probability of each action is epsilon / A, plus 1 - epsilon
    for the greedy action. At each step, SB3 explores either in all environments or in none; the
    result is the marginal probability.

    Args:
        model: Model in training, which chose `actions` for its last observations.
        actions: Actions (N,).
    """
    if not isinstance(model, DQN):
        return _likelihoods(model, actions)
    epsilon, count = exploration(model), int(cast(spaces.Discrete, model.action_space).n)
    if epsilon == 1.0:
        return np.full(len(actions), 1 / count)
    with torch.inference_mode():
        values = model.q_net(model.policy.obs_to_tensor(cast(Any, model._last_obs))[0])
        greedy = values.argmax(1).cpu().numpy()
    own: NDArray[np.bool_] = np.asarray(actions) == greedy
    return np.asarray(epsilon / count + (1 - epsilon) * own)


def _likelihoods(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the probability of each action under the actor's distribution."""
    policy = model.policy
    assert isinstance(policy, ActorCriticPolicy)
    with torch.inference_mode():
        observations = policy.obs_to_tensor(cast(Any, model._last_obs))[0]
        chosen = torch.as_tensor(actions, device=policy.device)
        logarithms = policy.get_distribution(observations).log_prob(chosen)
    return np.exp(logarithms.cpu().numpy().astype(np.float64))
