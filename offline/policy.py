"""Trained policies, saved as safetensors and JSON; loading executes no code from a file.

`policy.json` describes the networks and how they select actions (`offline.algorithms.heads`);
`policy.safetensors` contains their weights and the normalization of observations. Files of
Stable-Baselines3 become the same class by `online.zip_file`.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from torch import Tensor

from mcaprl.actions import OBSERVATION_KEY, BoxActions, has_source, joint_actions
from mcaprl.architecture import architecture_of
from mcaprl.base_policy import BasePolicy
from mcaprl.chunks import ChunkExecution, Chunks
from mcaprl.errors import PolicyError, SpaceError, TrainingError
from mcaprl.files import as_type, parse_json, read_file, write_json
from mcaprl.frames import FrameStack, mapped
from mcaprl.networks import ImageInput, Network, check_size
from mcaprl.offline.algorithms.heads import ENCODER, Head, build_head
from mcaprl.offline.algorithms.iql import LOG_STD
from mcaprl.offline.algorithms.learner import Learner
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.offline.batches.relative import RelativeActions
from mcaprl.recorder.format.metadata import ActionCommands
from mcaprl.recorder.format.spaces import (
    check_actions,
    check_elements,
    observation_leaves,
    space_from_json,
    space_to_json,
)
from mcaprl.runs import POLICY_NAME
from mcaprl.storage.tensor_files import check_finite, read_tensors, write_tensors

FORMAT_VERSION = 2
_CHUNKS_VERSION = 3
"""Version of a policy with chunks or relative actions, for which earlier versions have no code."""
_RELATIVE = ("relative.low", "relative.high")
TWIN = "q_twin"  # Name of the second critic of a policy for a Box, which is not used to act
_WEIGHTS_NAME = "policy.safetensors"
_IMAGE_SHIFT = "observation.image_{}.shift"
_IMAGE_SCALE = "observation.image_{}.scale"
_BAD_CONTENT = (ValueError, TypeError, KeyError, AttributeError, RuntimeError, SpaceError)


@dataclass(frozen=True, eq=False, kw_only=True)
class Policy(BasePolicy):
    """Trained policy with NumPy inputs and outputs, for B observations and A actions.

    A policy with a `frame_stack` of k > 1 stores the observations of the last k calls of `act`
    since `begin`. All methods accept stacks (B, k, *shape), oldest frame first; all methods but
    `act` need them.

    Attributes:
        name: Folder names of the run and the seed, or name of the file.
        algo: Name of the training algorithm.
        observation_space: Space of one observation; None if the file lacks its bounds.
        action_space: Space of one action. The values of a finite space are numbered as 0 to A - 1;
            each combination of the elements of a MultiDiscrete or MultiBinary space is one action.
        env_id: ID of the environment in which the policy was trained; empty if unknown.
        env_kwargs: Keyword arguments of that environment.
        frame_stack: Number of successive observations in one input.
        encoder: Encoder of observations as tensors.
        head: Networks, and how they select actions.
        reward_scale: Divisor of the rewards in the training. `q_values` returns values in units of
            the logged rewards, without this divisor.
        action_commands: Commands of a robot that the actions stand for; None if unknown.
        mask_from: Source of the action mask, `info:NAME` or a key of the observation; empty if
            the environment's observations have the mask, or there is none. With a source, the
            observations of `act` are `{"observation": ..., "action_mask": ...}`.
        chunk: Length of the chunks of actions that the networks predict, and how `act` executes
            them. With chunks, `act` also stores these, and there are no scores or probabilities.
    """

    name: str
    algo: str
    observation_space: spaces.Space[Any] | None
    action_space: spaces.Space[Any]
    env_id: str
    env_kwargs: dict[str, Any] = field()
    frame_stack: int
    encoder: ObservationEncoder = field(repr=False)
    head: Head = field(repr=False)
    reward_scale: float = 1.0
    action_commands: ActionCommands | None = None
    mask_from: str = ""
    chunk: Chunks = field(default_factory=Chunks)

    def begin(self, rows: Sequence[int] | None = None) -> None:
        """Drop the stored frames and chunks. The next observations start new episodes.

        Args:
            rows: Rows of a batch of environments in which new episodes start; default: all.
        """
        if rows is None:
            self._frames.clear()
            self._new_rows.clear()
        elif self.frame_stack > 1:
            self._new_rows.extend(rows)
        self._execution.clear(rows)

    def interrupt(self) -> None:
        """Drop the actions that were predicted for the next steps; frames are kept."""
        self._execution.clear()

    def with_execution(
        self, *, execute: int | None = None, ensemble: float | None = None
    ) -> Policy:
        """Return the same policy with another execution of its chunks; see `mcaprl.chunks`.

        Args:
            execute: Number of actions that are executed before the next prediction.
            ensemble: Coefficient of temporal ensembling, instead of `execute`.

        Raises:
            PolicyError: A number is out of range, both are given, or actions are not numbers.
        """
        if (execute is None) == (ensemble is None):
            raise PolicyError("pass either `execute` or `ensemble`")
        try:
            return replace(self, chunk=Chunks(self.chunk.length, execute or 1, ensemble))
        except ValueError as error:
            raise PolicyError(f"{self.name}: {error}") from error

    def __post_init__(self) -> None:
        """Check that averaged actions are numbers."""
        if self.chunk.ensemble is not None and not isinstance(self.action_space, spaces.Box):
            raise PolicyError(f"{self.name}: actions of {self.action_space} have no average")

    @property
    def env_observation_space(self) -> spaces.Space[Any] | None:
        """Observation space of the environment, without a mask from `mask_from`."""
        space = self.observation_space
        if not self.mask_from:
            return space
        assert isinstance(space, spaces.Dict)
        return space[OBSERVATION_KEY]

    @torch.inference_mode()
    def act(self, observations: Any) -> NDArray[Any]:
        """Return the best actions (B, *shape) in `action_space`; a tie selects the first action.

        The actions of a Box are in its own units. Those of a policy with chunks may have been
        predicted in an earlier call since `begin`.

        Args:
            observations: Observations (B, *shape), or nested dicts of them; with a frame stack k,
                also stacks (B, k, *shape). For a single observation (*shape), without B, the result
                is a single action. A single stack needs its B, because (k, *shape) are the
                observations of k environments.

        Raises:
            PolicyError: The observations have another shape.
        """
        if (batch := self._with_axis(observations)) is not None:
            action: NDArray[Any] = self.act(batch)[0]
            return action
        observations = self.encoder.arranged(observations)
        if self.frame_stack > 1 and not self._is_stack(observations):
            inputs = self._stack_onto_stored(self._encode(observations))
        else:
            inputs = self._inputs(observations)
        if self.chunk.length == 1:
            return self.head.actions(inputs).numpy()
        return self._execution.act(len(inputs), lambda: self.head.actions(inputs).numpy())

    @torch.inference_mode()
    def act_chunk(self, observations: Any) -> NDArray[Any]:
        """Return the chunks (B, H, *shape) of observations; H is `chunk.length`.

        Nothing is stored.

        Raises:
            PolicyError: The observations have another shape.
        """
        found: NDArray[Any] = self.head.actions(self._inputs(observations)).numpy()
        return found if self.chunk.length > 1 else found[:, None]

    @torch.inference_mode()
    def log_prob(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.float32]:
        """Return the log probabilities (B,) of actions (B, *shape), which must be in the space.

        For a Box, they are log densities in the action's own units; minus infinity outside the Box.
        A policy that selects by Q-values is greedy: minus infinity for all actions but that of
        `act`.

        Raises:
            PolicyError: The observations have another shape, or the policy outputs one action of a
                Box, which has no density.
        """
        return cast(
            NDArray[np.float32], self.head.log_prob(self._of_single(observations), actions).numpy()
        )

    @torch.inference_mode()
    def scores(self, observations: Any) -> NDArray[np.float32] | None:
        """Return the scores (B, A) of all actions, of which `act` selects the largest.

        These are Q-values or logits. The result is None if the actions are not finite in number.

        Raises:
            PolicyError: The observations have another shape.
        """
        scores = self.head.scores(self._of_single(observations))
        return None if scores is None else scores.numpy()

    @torch.inference_mode()
    def q_values(self, observations: Any) -> NDArray[np.float32]:
        """Return the values (B, A) of all actions; minus infinity for masked actions.

        Raises:
            PolicyError: The policy has no values, or the observations have another shape.
        """
        values = self.head.q_values(self._of_single(observations))
        if values is None:
            lacking = "no Q-values, only probabilities"
            if isinstance(self.action_space, spaces.Box):
                lacking = f"no finite list of actions, but {self.action_space}: use action_values"
            raise PolicyError(f"{self.name} ({self.algo}) has {lacking}")
        return cast(NDArray[np.float32], values.numpy())

    @torch.inference_mode()
    def action_values(self, observations: Any, actions: NDArray[Any]) -> NDArray[np.float32]:
        """Return the values (B,) of actions (B, *shape), in units of the logged rewards.

        Raises:
            PolicyError: The policy has no values, or the observations have another shape.
        """
        values = self.head.action_values(self._of_single(observations), actions)
        if values is None:
            raise PolicyError(f"{self.name} ({self.algo}) has no Q-values")
        return cast(NDArray[np.float32], values.numpy())

    @torch.inference_mode()
    def action_probabilities(self, observations: Any) -> NDArray[np.float32]:
        """Return the probabilities (B, A) of all actions.

        A policy that selects by Q-values is greedy: the action of `act` has probability 1.

        Raises:
            PolicyError: The actions are not finite in number, or the observations have another
                shape.
        """
        found = self.head.probabilities(self._of_single(observations))
        if found is None:
            raise PolicyError(f"{self.name} ({self.algo}) has no probabilities, only densities")
        return cast(NDArray[np.float32], found.numpy())

    def _with_axis(self, observation: Any) -> Any:
        """Return a single observation as a batch; None if it is none."""
        try:
            batch = mapped(lambda part: np.asarray(part)[None], observation)
            arranged = self.encoder.arranged(batch)
            shapes = [np.shape(leaf.of(arranged)) for leaf in self.encoder.leaves]
        # A ragged list has no shape.
        except (KeyError, IndexError, TypeError, ValueError):
            return None
        return batch if shapes == [(1, *leaf.shape) for leaf in self.encoder.leaves] else None

    def _is_stack(self, observations: Any) -> bool:
        """Return whether `observations` are stacks (B, frame_stack, *shape)."""
        try:
            shapes = [np.shape(leaf.of(observations))[1:] for leaf in self.encoder.leaves]
            return shapes == [(self.frame_stack, *leaf.shape) for leaf in self.encoder.leaves]
        except (KeyError, IndexError, TypeError):
            return False

    def _inputs(self, observations: Any) -> Observations:
        """Return the networks' inputs without using stored frames."""
        observations = self.encoder.arranged(observations)
        if self.frame_stack == 1:
            return self._encode(observations)
        if not self._is_stack(observations):
            raise PolicyError(
                f"{self.name} has a frame stack of {self.frame_stack}: observations must be"
                f" (B, {self.frame_stack}, *shape), oldest first"
            )
        flat = mapped(lambda part: part.reshape(-1, *part.shape[2:]), observations)
        return self._encode(flat).stacked(self.frame_stack)

    def _of_single(self, observations: Any) -> Observations:
        """Return the networks' inputs, unless an action depends on more than an observation."""
        if self.chunk.length > 1:
            raise PolicyError(
                f"{self.name} predicts {self.chunk}: an action has no probability or value given"
                " one observation"
            )
        return self._inputs(observations)

    @cached_property
    def _frames(self) -> FrameStack:
        return FrameStack(self.frame_stack)

    @cached_property
    def _execution(self) -> ChunkExecution:
        return ChunkExecution(self.chunk)

    @cached_property
    def _new_rows(self) -> list[int]:
        """Rows whose next observation is the first one of an episode."""
        return []

    def _stack_onto_stored(self, now: Observations) -> Observations:
        """Store observations, and return stacks of the last k observations."""
        stacks = self._frames.see(dict(enumerate(part.numpy() for part in now.parts())))
        while self._new_rows:
            self._frames.begin_one(self._new_rows.pop())
        parts = [torch.from_numpy(stack).flatten(0, 1) for stack in stacks.values()]
        return now.like(parts).stacked(self.frame_stack)

    def _encode(self, observations: Any) -> Observations:
        try:
            return self.encoder.encode(observations)
        except SpaceError as error:
            raise PolicyError(f"{self.name} {error}") from error


def save_policy(
    folder: Path,
    learner: Learner,
    seed: int,
    env_id: str,
    env_kwargs: dict[str, Any],
    action_commands: ActionCommands | None = None,
) -> None:
    """Write the current policy of a seed into a folder."""
    buffer = learner.buffer
    networks = copy.deepcopy(learner.policy_networks(seed))
    if "q" in learner.critics:
        # Training online may continue with both critics.
        networks[TWIN] = copy.deepcopy(learner.network("q", seed, member=1))
    for name in {"q", TWIN} & networks.keys():
        # Saved values are in units of the logged rewards.
        networks[name].scale_outputs(buffer.reward_scale)
    relative = buffer.relative
    weights = _weights_of(learner, seed, networks)
    write_tensors(folder / _WEIGHTS_NAME, weights, {"updates": learner.step})
    chunks = getattr(learner.config, "chunks", Chunks())
    has_chunks = chunks.length > 1
    description = {
        "format_version": _CHUNKS_VERSION if has_chunks or relative else FORMAT_VERSION,
        "algo": learner.name,
        "acts_by": learner.acts_by,
        "threshold": getattr(learner.config, "threshold", 0.0),
        "updates": learner.step,
        "reward_scale": buffer.reward_scale,
        "architecture": asdict(learner.architecture),
        "outputs": {name: list(network.output_shape) for name, network in networks.items()},
        "frame_stack": buffer.packing.frame_stack,
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "mask_from": learner.config.mask_from,
        "observation_space": json.loads(space_to_json(buffer.encoder.space)),
        "action_space": json.loads(space_to_json(buffer.action_space)),
        **({"chunk": chunks.to_json()} if has_chunks else {}),
        **({"relative_to": list(relative.relation)} if relative else {}),
        **_box_description(learner),
        **({"action_commands": action_commands.to_json()} if action_commands else {}),
    }
    write_json(folder / POLICY_NAME, description, TrainingError)


def _weights_of(learner: Learner, seed: int, networks: dict[str, Network]) -> dict[str, Tensor]:
    """Return all tensors of a policy by name."""
    weights = {
        f"{name}.{key}": value
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    buffer, relative = learner.buffer, learner.buffer.relative
    if LOG_STD in learner.scalars:
        numbers = learner.scalars[LOG_STD].detach()[learner.seeds.index(seed), : buffer.n_actions]
        weights[LOG_STD] = numbers.clone()
    weights["observation.shift"] = torch.from_numpy(buffer.encoder.shift)
    weights["observation.scale"] = torch.from_numpy(buffer.encoder.scale)
    for number, image in enumerate(buffer.encoder.image_inputs):
        if image.shift is not None:
            weights[_IMAGE_SHIFT.format(number)] = torch.from_numpy(image.shift)
            weights[_IMAGE_SCALE.format(number)] = torch.tensor(image.scale)
    if relative is not None:
        weights |= dict(zip(_RELATIVE, (relative.low.cpu(), relative.high.cpu()), strict=True))
    return weights


def _box_description(learner: Learner) -> dict[str, Any]:
    """Return what a policy for the actions of a Box needs in addition."""
    box = learner.buffer.box
    if box is None:
        return {}
    twins = ("q", TWIN) if "q" in learner.critics else ()
    return {
        "action_range": [box.low.tolist(), box.high.tolist()],
        "critics": {name: asdict(learner.architecture_of("q")) for name in twins},
    }


@dataclass(frozen=True)
class _Description:
    """Content of `policy.json` that is needed to act."""

    format_version: int
    algo: str
    acts_by: str
    threshold: float
    architecture: dict[str, Any]
    outputs: dict[str, list[int]]
    frame_stack: int
    env_id: str
    env_kwargs: dict[str, Any]
    observation_space: Any
    action_space: Any
    action_commands: Any = None
    mask_from: str = ""
    reward_scale: float = 1.0
    action_range: Any = None
    critics: dict[str, dict[str, Any]] = field(default_factory=dict)
    chunk: dict[str, Any] = field(default_factory=dict)
    relative_to: list[int | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.threshold) and 0 < self.reward_scale < math.inf):
            scale = self.reward_scale
            raise ValueError(f"threshold {self.threshold} or reward_scale {scale} is impossible")


def read_policy(folder: Path) -> Policy:
    """Read the policy of one seed's folder."""
    try:
        found = parse_json(read_file(folder / POLICY_NAME))
        description: _Description = as_type(_Description, found, POLICY_NAME)
        if description.format_version not in (FORMAT_VERSION, _CHUNKS_VERSION):
            raise ValueError(f"format_version {description.format_version} is not supported")
        return _build(folder, description, read_tensors(folder / _WEIGHTS_NAME)[0])
    except FileNotFoundError as error:
        raise PolicyError(
            f"{folder} has no policy: {POLICY_NAME} or {_WEIGHTS_NAME} is missing; "
            "training writes them with its first checkpoint"
        ) from error
    except (OSError, SafetensorError, *_BAD_CONTENT) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise PolicyError(f"cannot load the policy in {folder}: {reason}") from error


def _build(folder: Path, description: _Description, weights: dict[str, Tensor]) -> Policy:
    check_finite(weights)
    observation_space = space_from_json(json.dumps(description.observation_space))
    action_space = space_from_json(json.dumps(description.action_space))
    mask_from = description.mask_from
    if mask_from and not has_source(observation_space):
        raise ValueError(f"mask_from {mask_from!r} does not fit {observation_space}")
    check_actions(action_space)
    joint = joint_actions(action_space)
    box = _box(action_space, description.action_range)
    stack = description.frame_stack
    check_elements(stack * sum(leaf.size for leaf in observation_leaves(observation_space)))
    encoder = _encoder(observation_space, joint.count if joint else 0, weights)
    log_std = weights.pop(LOG_STD, None)
    if log_std is not None and (box is None or log_std.shape != (box.size,)):
        raise ValueError(f"{LOG_STD} has shape {tuple(log_std.shape)}")
    chunk = Chunks(**description.chunk)
    relative = _relative(description, encoder, box, chunk.length, weights)
    networks = _networks(description, encoder, 0 if box is None else box.size, weights)
    head = build_head(
        description.acts_by,
        networks,
        action_space,
        description.threshold,
        box=box,
        log_std=log_std,
        chunk=chunk.length,
        relative=relative,
    )
    head.networks.load_state_dict(weights)
    commands = description.action_commands
    return Policy(
        name=f"{folder.resolve().parent.name}/{folder.resolve().name}",
        algo=description.algo,
        observation_space=observation_space,
        action_space=action_space,
        env_id=description.env_id,
        env_kwargs=description.env_kwargs,
        frame_stack=stack,
        encoder=encoder,
        head=head.eval(),
        reward_scale=description.reward_scale,
        action_commands=None
        if commands is None or joint is None
        else ActionCommands.from_json(commands, joint.count),
        mask_from=mask_from,
        chunk=chunk,
    )


def _relative(
    description: _Description,
    encoder: ObservationEncoder,
    box: BoxActions | None,
    length: int,
    weights: dict[str, Tensor],
) -> RelativeActions | None:
    """Return the conversion of relative actions, whose ranges are removed from `weights`."""
    if not description.relative_to:
        return None
    low, high = (weights.pop(name) for name in _RELATIVE)
    if box is None or low.shape != (length, box.size) or not (low < high).all():
        raise ValueError("the ranges of relative actions do not fit the action space")
    return RelativeActions(tuple(description.relative_to), encoder, box, low, high)


def _networks(
    description: _Description, encoder: ObservationEncoder, size: int, weights: dict[str, Tensor]
) -> dict[str, Network]:
    """Create the networks of a file, for actions of a Box with `size` numbers."""
    networks: dict[str, Network] = {}
    stack, outputs = description.frame_stack, description.outputs
    images = [image.stacked(stack) for image in encoder.image_inputs]
    if ENCODER in outputs and not images:
        raise ValueError("there are no images to encode")
    for name, shape in outputs.items():
        architecture = architecture_of(description.critics.get(name, description.architecture))
        width, seen = encoder.width * stack, images
        if name == ENCODER:
            width, architecture = 0, architecture.of_encoder()
        elif ENCODER in outputs:
            width, seen = width + outputs[ENCODER][0], []
        if name in description.critics:
            width += size
        check_size(architecture, width, seen, math.prod(shape), weights)
        networks[name] = Network(width, seen, tuple(shape), architecture)
    return networks


def _encoder(
    space: spaces.Space[Any], actions: int, weights: dict[str, Tensor]
) -> ObservationEncoder:
    """Return an encoder with the normalization that is in `weights`, which is removed there."""
    encoder = ObservationEncoder(space, actions)
    encoder.shift = weights.pop("observation.shift").numpy()
    encoder.scale = weights.pop("observation.scale").numpy()
    if not (encoder.scale > 0).all():
        raise ValueError("observation.scale is not positive")
    encoder.image_inputs = [
        _image_input(image, number, weights) for number, image in enumerate(encoder.image_inputs)
    ]
    return encoder


def _box(action_space: spaces.Space[Any], action_range: Any) -> BoxActions | None:
    """Return the scaling of the actions of a Box."""
    if not isinstance(action_space, spaces.Box):
        return None
    low, high = np.array(action_range, np.float64)
    box = replace(BoxActions.of(action_space, np.stack([low, high])), low=low, high=high)
    fits = low.shape == high.shape == (math.prod(action_space.shape),)
    if not (fits and np.isfinite([low, high]).all() and (low < high).all()):
        raise ValueError("action_range does not fit the action space")
    return box


def _image_input(image: ImageInput, number: int, weights: dict[str, Tensor]) -> ImageInput:
    """Return the input with its normalization, which is removed from `weights`."""
    if _IMAGE_SHIFT.format(number) not in weights:
        return image
    shift = weights.pop(_IMAGE_SHIFT.format(number)).numpy()
    if shift.shape != image.shape:
        raise ValueError(f"the mean image has shape {shift.shape}, but images have {image.shape}")
    return replace(image, shift=shift, scale=float(weights.pop(_IMAGE_SCALE.format(number))))
