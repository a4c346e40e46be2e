"""Export of a trained policy as one ONNX file for a robot.

The inputs are the parts of an observation as the environment returns them, with a leading batch
axis. They have the same names as in `/rl/step` (`observation`, `camera`, ...). A policy with frame
stacks of k expects inputs (B, k, *shape), oldest frame first. The outputs are `action` (B, *shape),
a value of the action space, and `scores` (B, A); the action has the largest score. A policy for the
actions of a Box has no scores; its action is in the units of the space. The file includes the
normalization.

A Discrete action is an int64. An action of a MultiDiscrete or MultiBinary space has the dtype of
the space; score k is that of the k-th combination of its elements, where the last element changes
fastest (`numpy.unravel_index(k, sizes)`). The metadata of the file contain this description.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from mcaprl.errors import PolicyError, import_extra
from mcaprl.files import replacing
from mcaprl.offline.algorithms.heads import BoxHead, DiscreteHead, Head
from mcaprl.offline.batches.observations import Observations, codes_of, has_channels_first
from mcaprl.offline.policy import Policy
from mcaprl.recorder.format.spaces import space_to_json


class ExportedPolicy(nn.Module):
    """Policy as an `nn.Module` whose inputs and outputs are plain tensors."""

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy's networks and normalization."""
        super().__init__()
        self.head: Head = policy.head
        self.encoder = policy.encoder
        self.frame_stack = policy.frame_stack
        self.shift = torch.from_numpy(policy.encoder.shift)
        self.scale = torch.from_numpy(policy.encoder.scale)

    @property
    def input_names(self) -> list[str]:
        """Names of the arguments of `forward`."""
        return [leaf.name for leaf in self.encoder.leaves]

    def examples(self, batch_size: int, seed: int = 0) -> tuple[Tensor, ...]:
        """Return random observations as arguments of `forward`."""
        space = self.encoder.space
        space.seed(seed)
        stack = (self.frame_stack,) if self.frame_stack > 1 else ()
        count = batch_size * self.frame_stack
        samples = [space.sample() for _ in range(count)]
        columns = [
            np.stack([leaf.of(sample) for sample in samples]) for leaf in self.encoder.leaves
        ]
        shapes = [(batch_size, *stack, *column.shape[1:]) for column in columns]
        return tuple(
            torch.from_numpy(column.reshape(shape))
            for column, shape in zip(columns, shapes, strict=True)
        )

    @property
    def output_names(self) -> list[str]:
        """Names of the results of `forward`."""
        return ["action", "scores"] if isinstance(self.head, DiscreteHead) else ["action"]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Map observations to `action`, and to `scores` if the actions are finite in number."""
        if self.frame_stack > 1:
            inputs = tuple(part.flatten(0, 1) for part in inputs)
        observations = self._encode(inputs).stacked(self.frame_stack)
        if not isinstance(self.head, DiscreteHead):
            return (self.head.actions(observations),)
        scores = self.head.scores(observations)
        return self.head.best(scores), scores

    def _encode(self, inputs: tuple[Tensor, ...]) -> Observations:
        """Encode observations in torch as `ObservationEncoder.encode` does in NumPy."""
        encoder, rows = self.encoder, inputs[0].shape[0]
        n_images = len(encoder.images)
        shaped = zip(inputs[:n_images], encoder.image_inputs, strict=True)
        images = tuple(_channels_last(image).reshape(-1, *wanted.shape) for image, wanted in shaped)
        numbers = inputs[n_images : n_images + len(encoder.numbers)]
        parts = [
            _numbers(part, space) for part, (_, space) in zip(numbers, encoder.numbers, strict=True)
        ]
        vector = torch.cat(parts, 1) if parts else torch.empty(rows, 0)
        mask = None
        if encoder.mask is not None:
            allowed = inputs[-1].bool()
            mask = allowed | ~allowed.any(1, keepdim=True)
        return Observations((vector - self.shift) / self.scale, images, mask)


def _channels_last(images: Tensor) -> Tensor:
    return images.permute(0, 2, 3, 1) if has_channels_first(images.shape[1:]) else images


def export_onnx(policy: object, path: Path, *, overwrite: bool = True) -> None:
    """Write the policy of an offline run as an ONNX file, for a batch of any size."""
    if not isinstance(policy, Policy) or not isinstance(policy.head, DiscreteHead | BoxHead):
        raise PolicyError(f"{getattr(policy, 'name', policy)} has no scores of actions to export")
    for package in ("onnx", "onnxscript"):
        import_extra(package, "export")
    module = ExportedPolicy(policy).eval()
    with _quiet():
        program = torch.onnx.export(
            module,
            module.examples(2),
            input_names=module.input_names,
            output_names=module.output_names,
            dynamic_shapes=(tuple({0: torch.export.Dim("batch")} for _ in module.input_names),),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props.update(_metadata(policy))
    with replacing(path, PolicyError, overwrite=overwrite) as unfinished:
        program.save(str(unfinished))


def _metadata(policy: Policy) -> dict[str, str]:
    """Return the properties of the ONNX file that describe its outputs."""
    space = {"action_space": space_to_json(policy.action_space)}
    if policy.chunk.length > 1:
        space |= {
            "chunk": json.dumps(policy.chunk.to_json()),
            "execution": f"action[:, k] is for the k-th step from now: {policy.chunk}; when an"
            " episode begins, earlier predictions are dropped",
        }
    if not isinstance(policy.head, DiscreteHead):
        return space
    joint, scores = policy.head.joint, "scores[:, k]"
    if policy.chunk.length > 1:
        scores = "scores[:, step, k]"
    if not joint.shape:
        order = f"{scores} is the score of action k + {joint.first}"
    else:
        elements = f"numpy.unravel_index(k, {joint.sizes})"
        if joint.starts.any():
            elements += f" + {joint.starts.tolist()}"
        order = f"{scores} is the score of the action {elements}, in C order"
    return {**space, "scores": order}


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's messages about optional packages and future changes."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _numbers(values: Tensor, space: spaces.Space[Any]) -> Tensor:
    """Return values of a space as numbers (B, width); discrete values are one-hot encoded."""
    flat = values.reshape(values.shape[0], -1)
    codes = codes_of(space)
    if codes is None:
        return flat.float()
    columns = (flat - torch.from_numpy(codes.starts)).long().unbind(1)
    return torch.cat(
        [
            nn.functional.one_hot(one, n).float()
            for n, one in zip(codes.sizes, columns, strict=True)
        ],
        1,
    )
