"""Training of one seed with this package's learners, which resumes to the same bits.

Gymnasium has no interface to save the state of an environment. Therefore, all environments start
new episodes at each checkpoint, in every run, with seeds that depend on the seed of the agent and
on the number of steps. The episodes that were going on are truncated, in the log and in the replay
buffer.

`checkpoint.safetensors` contains the learner, the replay buffer, the generators, the best policy
and the counters. All are in one file, because two files would be inconsistent if the process were
killed between the two writes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from mcaprl.actions import BoxActions, joint_actions
from mcaprl.base_policy import BasePolicy
from mcaprl.errors import PolicyError, SpaceError, TrainingError, UsageError
from mcaprl.frames import mapped
from mcaprl.offline.algorithms.actor_critic import ActorCritic
from mcaprl.offline.algorithms.heads import ENCODER, BoxHead, Deterministic, Gaussian, build_head
from mcaprl.offline.algorithms.learner import NotFiniteError
from mcaprl.offline.batches.buffer import TransitionBuffer
from mcaprl.offline.batches.observations import ObservationEncoder
from mcaprl.offline.policy import TWIN, Policy, read_policy, save_policy
from mcaprl.online.agent import Agent, center_images, is_due
from mcaprl.online.collector import Choice, EpsilonGreedy, VectorEnvironments
from mcaprl.online.config import ReplayConfig
from mcaprl.online.engine import Agents
from mcaprl.online.live import WATCHED, command_values, numbered_values
from mcaprl.online.replay import Outcome, ReplayBuffer, packed_log, restored_log
from mcaprl.progress import ProgressCallback
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import POLICY_NAME
from mcaprl.sims.evaluation.rollout import episode_seed
from mcaprl.storage.tensor_files import below

_CHECKED = 64  # Number of observations on which a copied network must produce the same values


class LearningAgent(Agent):
    """Agent of one seed, trained by a learner of this package.

    Attributes:
        agents: Replay buffer, networks and loop of the single agent.
    """

    best_files = ("policy.safetensors", POLICY_NAME)
    repeats_steps = True

    def _prepare(self, tensors: dict[str, Tensor] | None) -> None:
        """Create the encoder, and an agent with new weights."""
        joint = joint_actions(self.env.single_action_space)
        count = 0 if joint is None else joint.count
        encoder = ObservationEncoder(self.env.single_observation_space, count)
        if tensors is not None:
            _load_normalization(encoder, tensors)
        elif self._task.config.center_images and encoder.image_inputs:
            center_images(encoder, self._task, self._seed)
        logged = {} if tensors is None else below(below(tensors, "buffer"), "log")
        self._create(encoder, partial(restored_log, logged) if logged else None)

    def _create(
        self,
        encoder: ObservationEncoder,
        log: Callable[[ReplayBuffer], TransitionBuffer] | None = None,
    ) -> None:
        """Create an agent with new weights; `log` returns logged transitions for its batches."""
        config, actions = cast(ReplayConfig, self._task.config), self.env.single_action_space
        if config.image_shift and not encoder.image_inputs:
            raise UsageError("image_shift is for images, but the observations have none")
        self._encoder = encoder
        self.agents = Agents(config, encoder, actions, [self._seed], torch.device("cpu"), log)
        self._environments = VectorEnvironments(self.env, encoder)
        self.agents.connect(self._environments)
        self.agents.collector.before_step = self._before_step
        self._choice: Choice | None = None
        self.__dict__.pop("policy", None)

    @property
    def steps(self) -> int:
        """Number of finished environment steps, summed over all environments."""
        return self.agents.steps

    @cached_property
    def policy(self) -> Policy:
        """Greedy policy, whose networks share the weights of the learner."""
        learner, seed = self.agents.learner, self._seed
        networks = learner.policy_networks(seed)
        return Policy(
            name=self._task.algo,
            algo=self._task.algo,
            observation_space=self._encoder.space,
            action_space=self.env.single_action_space,
            env_id=self._env_id,
            env_kwargs=self._task.sim_options,
            frame_stack=self._task.config.frame_stack,
            encoder=self._encoder,
            head=build_head(
                learner.acts_by, networks, self.env.single_action_space, box=self.agents.buffer.box
            ).eval(),
        )

    def best_policy(self) -> BasePolicy:
        """Read the policy with the best evaluation."""
        return read_policy(self._folder)

    def start_from(self, data: Dataset | None, policy: Any) -> None:
        """Fill the replay buffer with logged transitions, copy a policy's weights, or do both."""
        if self.agents.steps:
            # The checkpoint has what the first session started from.
            return
        box, encoder = self.agents.buffer.box, self._encoder
        if policy is not None:
            _check_fits(policy, self.env.single_action_space, self._task.config.frame_stack)
            if type(policy.encoder) is ObservationEncoder:
                encoder = policy.encoder
        if data is not None:
            _check_spaces(data, self._encoder.space, self.env.single_action_space)
        fills = box is None or not getattr(self.agents.config, "data_fraction", 0)
        log = None if fills or data is None else partial(packed_log, data)
        if log is not None or encoder is not self._encoder:
            self._create(encoder, log)
        if policy is not None:
            (self._take_values if box is None else self._take_actor_and_critics)(policy)
            self.agents.learner.load_targets()
        if data is not None:
            if fills:
                fill_buffer(self.agents, data)
            self.agents.learning_starts = 0
        if policy is not None:
            self.agents.learning_starts = self.agents.config.learning_starts
            self.agents.continue_policy()

    def _take_values(self, policy: Policy) -> None:
        """Copy the Q-network of a policy."""
        theirs, learner = policy.head.networks["q"], self.agents.learner
        ours = learner.network("q", self._seed)
        _check_layers(policy, theirs, ours)
        for source, target in zip(_layers(theirs), _layers(ours), strict=True):
            target.load_state_dict(source.state_dict())
        observations = _sample_stacks(self._encoder.space, policy.frame_stack)
        values = self.policy.q_values(observations)
        if not np.allclose(values, policy.q_values(observations), rtol=1e-4, atol=1e-4):
            raise PolicyError(
                f"{policy.name} has a network of another architecture (for example, normalized"
                " inputs): the agent's network produces other values with the same weights"
            )

    def _take_actor_and_critics(self, policy: Policy) -> None:
        """Copy the actor of a policy, and its critics if it has them."""
        learner, head = self.agents.learner, cast(BoxHead, policy.head)
        self._take_encoder(policy, head)
        _copy_actor(
            policy, head, learner.network("actor", self._seed), self.agents.buffer.n_actions
        )
        for member, name in enumerate(("q", TWIN)):
            if name in head.networks:
                theirs, ours = head.networks[name], learner.network("q", self._seed, member)
                _check_layers(policy, theirs, ours)
                ours.load_state_dict(theirs.state_dict())
        observations = _sample_stacks(self._encoder.space, policy.frame_stack)
        if not np.allclose(self.policy.act(observations), policy.act(observations), atol=1e-4):
            raise PolicyError(
                f"{policy.name} has an actor of another architecture (for example, normalized"
                " inputs): the agent's actor produces other actions with the same weights"
            )

    def _take_encoder(self, policy: Policy, head: BoxHead) -> None:
        """Copy the encoder that the networks of a policy share, if there are images."""
        ours = self.agents.learner.policy_networks(self._seed).get(ENCODER)
        if ours is None:
            return
        if ENCODER not in head.networks:
            raise PolicyError(
                f"{policy.name} ({policy.algo}) has convolutions in each network, but the agent has"
                " one encoder: from images, start from a policy of sac or td3"
            )
        theirs = head.networks[ENCODER]
        _check_layers(policy, theirs, ours)
        ours.load_state_dict(theirs.state_dict())

    def scalars(self) -> dict[str, float]:
        """Return the scalars of a row of `progress.csv`."""
        episodes, agents, terms = self._environments.episodes, self.agents, self.agents.means()
        found: dict[str, float] = {
            "time/episodes": float(episodes.count),
            "rollout/exploration_rate": agents.epsilon,
            "train/n_updates": float(agents.learner.step),
        }
        if episodes.returns:
            found["rollout/ep_rew_mean"] = float(np.mean(episodes.returns))
            found["rollout/ep_len_mean"] = float(np.mean(episodes.lengths))
        if terms:
            found["train/learning_rate"] = agents.learning_rate
        return found | {f"train/{name}": value for name, value in terms.items()}

    def _train(self, report: ProgressCallback) -> None:
        """Train until all steps are done."""
        agents, config = self.agents, self._task.config
        self._begin()
        while agents.steps < config.steps:
            before = agents.steps
            try:
                agents.step()
            except NotFiniteError as error:
                raise TrainingError(
                    f"update {error.update} of {self._folder}: {error}; lower the learning rate"
                ) from error
            self._after_step(before, report)
            ends = agents.steps >= config.steps
            if ends or is_due(before, agents.steps, config.checkpoint_interval):
                self._begin()
                self._save()

    def _begin(self) -> None:
        """Start new episodes, whose seeds depend on the number of steps."""
        self.agents.collector.begin(episode_seed(self._seed, self.agents.steps))

    def _before_step(self, choice: Choice) -> None:
        """Pass what the log and the live view show of a step."""
        self._choice = choice
        if self._recorder is not None:
            self._recorder.epsilon = self.agents.epsilon
            self._recorder.policy_version = self.agents.learner.step
            name = "behavior_probs" if self.agents.buffer.box is None else "behavior_log_probs"
            setattr(self._recorder, name, choice.behavior().numpy())

    def save_policy(self, folder: Path) -> None:
        """Write the current policy into a folder."""
        learner = self.agents.learner
        save_policy(folder, learner, self._seed, self._env_id, self._task.sim_options)

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the state for a checkpoint, as tensors and as JSON values."""
        episodes = self._environments.episodes
        tensors = {**self.agents.state(), **_normalization_of(self._encoder)}
        finished = [episodes.count, list(episodes.returns), list(episodes.lengths)]
        return tensors, {"counters": self.agents.counters(), "episodes": finished}

    def _load(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore what `_state` returned."""
        self.agents.load_state(tensors, description["counters"])
        count, returns, lengths = description["episodes"]
        episodes = self._environments.episodes
        episodes.count = int(count)
        episodes.returns.extend(returns)
        episodes.lengths.extend(lengths)

    # What the live view shows.

    @property
    def epsilon(self) -> float:
        """Probability of a random action in this step."""
        return self.agents.epsilon

    @property
    def updates(self) -> int:
        """Number of updates of the network."""
        return self.agents.learner.step

    def probability(self) -> float:
        """Return the probability, or log density, of the action of the watched environment."""
        assert self._choice is not None
        return float(self._choice.behavior()[WATCHED])

    def values(self, taken: NDArray[Any]) -> dict[str, Any]:
        """Return the fields of `values_schema` for the watched action, if possible of its pass."""
        assert self._choice is not None
        values, behavior = self._choice.values, self.agents.behavior
        if not isinstance(behavior, EpsilonGreedy):
            return self._command_values(taken)
        if values is None:
            with torch.no_grad():
                values = behavior.values(self.agents.buffer.now())
        q = values[WATCHED]
        return numbered_values(q, q.softmax(0), float(q.max()), int(taken))

    @torch.no_grad()
    def _command_values(self, taken: NDArray[Any]) -> dict[str, Any]:
        """Return the fields of `values_schema` for an action of a Box."""
        learner = cast(ActorCritic, self.agents.learner)
        buffer, box = self.agents.buffer, cast(BoxActions, self.agents.buffer.box)
        seen = learner.inputs(buffer.now().rows(torch.tensor([WATCHED])))
        best = learner.act(seen)
        both = torch.cat((torch.from_numpy(box.scaled(taken[None])).clamp(-1, 1), best))
        twice = seen.rows(torch.zeros(2, dtype=torch.int64))
        q, value = learner.models["q"](twice.with_actions(both), members=1)[0].tolist()
        command = box.unscaled(best.numpy())[0]
        space, log_prob = buffer.action_space, self.probability()
        return command_values(command, taken, space, log_prob=log_prob, q=q, value=value)

    def metrics(self) -> dict[str, float]:
        """Return the metrics of `/rl/training`, without the score."""
        terms, returns = self.agents.means(), self._environments.episodes.returns
        return {
            "mean_return": float(np.mean(returns)) if returns else np.nan,
            "loss": terms.get("loss", np.nan),
            "epsilon": self.epsilon,
            "mean_q": terms.get("mean_q", np.nan),
            "learning_rate": self.agents.learning_rate,
            "steps": self.steps,
            "updates": self.updates,
        }


def fill_buffer(agents: Agents, dataset: Dataset) -> int:
    """Copy logged transitions into one agent's empty replay buffer; return their number."""
    # The buffer has a column of successive steps for each environment, so the log is split into as
    # many parts of equal length. An episode beyond the end of a part counts as truncated there. Of
    # a log that is longer than the buffer, the last transitions are copied.
    buffer = agents.buffer
    _check_spaces(dataset, buffer.encoder.space, buffer.action_space)
    envs = buffer.width
    rows = min(len(dataset) // envs, buffer.capacity)
    if rows == 0:
        raise UsageError(f"{len(dataset)} transitions are too few for {envs} environments")
    steps = np.arange(len(dataset) - rows * envs, len(dataset)).reshape(envs, rows).T
    encode, batch = buffer.encoder.encode, dataset.batch(steps[0])
    buffer.begin(encode(batch.observations))
    for row in range(rows):
        following = dataset.batch(steps[row + 1]) if row + 1 < rows else None
        after = batch.next_observations if following is None else following.observations
        outcome = Outcome(
            torch.from_numpy(batch.rewards.astype(np.float32)),
            torch.from_numpy(batch.terminated),
            torch.from_numpy(batch.truncated),
            encode(after),
            encode(batch.next_observations),
            None,
        )
        taken = buffer.joint.indexes(batch.actions) if buffer.box is None else batch.actions
        buffer.add(torch.from_numpy(taken), outcome)
        if following is not None:
            batch = following
    return rows * envs


def _check_spaces(dataset: Dataset, observation_space: Any, action_space: Any) -> None:
    """Check that logs have the spaces of the environment."""
    for role, own in (("observation_space", observation_space), ("action_space", action_space)):
        if getattr(dataset, role) != own:
            raise SpaceError(
                f"the logs have {role} {getattr(dataset, role)}, but the environment has {own}"
            )


def _check_fits(policy: Policy, action_space: Any, frame_stack: int) -> None:
    """Check that an agent can take the weights of a policy."""
    if policy.chunk.length > 1:
        raise PolicyError(
            f"{policy.name} predicts {policy.chunk}: online algorithms learn single actions"
        )
    if isinstance(action_space, spaces.Box):
        if policy.action_space != action_space:
            raise PolicyError(
                f"{policy.name} has actions of {policy.action_space}, but the environment has"
                f" {action_space}"
            )
        if not isinstance(policy.head, Deterministic | Gaussian):
            raise PolicyError(f"{policy.name} ({policy.algo}) has no actor that can be continued")
    elif "q" not in getattr(policy.head, "networks", {}):
        raise PolicyError(f"{policy.name} ({policy.algo}) has no Q-values to start from")
    if policy.frame_stack != frame_stack:
        raise PolicyError(
            f"{policy.name} stacks {policy.frame_stack} observations, but the agent stacks another"
            f" number: pass `frame_stack={policy.frame_stack}`"
        )


def _check_layers(policy: Policy, theirs: nn.Module, ours: nn.Module) -> None:
    """Check that two networks have the same layers."""
    if _weights_of(theirs) != _weights_of(ours):
        raise PolicyError(
            f"{policy.name} has layers {_chain(theirs)}, but the agent has {_chain(ours)}:"
            " pass `hidden=`, `encoder=`, `channels=`, `dueling=`, `layer_norm=` or"
            " `critic_layer_norm=`"
        )


@torch.no_grad()
def _copy_actor(policy: Policy, head: BoxHead, ours: nn.Module, size: int) -> None:
    """Copy an actor for actions of `size` numbers."""
    # Outputs are means, and the logarithms of the deviations if both networks have them. Where only
    # the agent's has them, they become those of the policy, or 0.
    (*theirs, their_last), (*layers, last) = _layers(head.networks["actor"]), _layers(ours)
    if [layer.weight.shape for layer in theirs] != [layer.weight.shape for layer in layers]:
        _check_layers(policy, head.networks["actor"], ours)
    for source, target in zip(theirs, layers, strict=True):
        target.load_state_dict(source.state_dict())
    common = min(len(their_last.bias), len(last.bias))
    last.weight[:common], last.bias[:common] = their_last.weight[:common], their_last.bias[:common]
    if len(last.bias) > common:
        last.weight[common:] = 0.0
        last.bias[common:] = 0.0 if head.log_std is None else head.log_std


def _sample_stacks(space: Any, count: int) -> Any:
    """Sample observations (B, *shape), or stacks (B, count, *shape), to compare networks."""
    space.seed(0)
    drawn = [space.sample() for _ in range(_CHECKED * count)]
    whole = mapped(lambda *parts: np.stack(parts), *drawn)
    if count == 1:
        return whole
    return mapped(lambda part: part.reshape(_CHECKED, count, *part.shape[1:]), whole)


def _normalization_of(encoder: ObservationEncoder) -> dict[str, Tensor]:
    """Return the normalization of an encoder, for a checkpoint."""
    found = {
        "observation.shift": torch.from_numpy(encoder.shift),
        "observation.scale": torch.from_numpy(encoder.scale),
    }
    for number, image in enumerate(encoder.image_inputs):
        if image.shift is not None:
            found[f"observation.image_{number}.shift"] = torch.from_numpy(image.shift)
        found[f"observation.image_{number}.scale"] = torch.tensor(image.scale, dtype=torch.float64)
    return found


def _load_normalization(encoder: ObservationEncoder, tensors: dict[str, Tensor]) -> None:
    encoder.shift = tensors["observation.shift"].numpy()
    encoder.scale = tensors["observation.scale"].numpy()
    encoder.image_inputs = [
        replace(
            image,
            shift=None
            if (shift := tensors.get(f"observation.image_{number}.shift")) is None
            else shift.numpy(),
            scale=float(tensors[f"observation.image_{number}.scale"]),
        )
        for number, image in enumerate(encoder.image_inputs)
    ]


def _layers(network: nn.Module) -> list[Any]:
    """Return the layers with weights, from input to output."""
    kinds = nn.Linear | nn.Conv2d | nn.LayerNorm
    return [layer for layer in network.modules() if isinstance(layer, kinds)]


def _weights_of(network: nn.Module) -> list[tuple[int, ...]]:
    return [tuple(layer.weight.shape) for layer in _layers(network)]


def _chain(network: nn.Module) -> str:
    """Format the widths of the layers from the input to the output.

    >>> _chain(nn.Sequential(nn.Linear(12, 256), nn.LayerNorm(256), nn.Linear(256, 6)))
    '12-256-norm-6'
    """
    widths = ["norm" if len(shape) == 1 else str(shape[0]) for shape in _weights_of(network)]
    return "-".join([str(_weights_of(network)[0][1]), *widths])
