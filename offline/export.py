"""Export of a trained policy as one self-contained ONNX file, for example for a robot.

Inputs are the parts of the observation as the environment returns them, named as in `/rl/step`
(`observation`, `camera`, ...), with a leading batch axis; a policy that stacks k frames accepts
(B, k, *shape), oldest first. Outputs are `action` (B,) int64, values of the action space, and
`scores` (B, A); the action is the one with the largest score. The model includes normalization.
"""

from __future__ import annotations

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
from mcaprl.offline.batches.observations import Observations
from mcaprl.offline.policy import Policy


class ExportedPolicy(nn.Module):
    """Policy as a module with plain tensors as inputs and outputs, for exporters."""

    def __init__(self, policy: Policy) -> None:
        """Create the module from the networks and the normalization of a policy."""
        super().__init__()
        self.scores = policy.scores
        self.encoder = policy.encoder
        self.frame_stack = policy.frame_stack
        self.first_action = int(policy.action_space.start)
        self.shift = torch.from_numpy(policy.encoder.shift)
        self.scale = torch.from_numpy(policy.encoder.scale)

    @property
    def input_names(self) -> list[str]:
        """Names of the arguments of `forward`."""
        return [leaf.name for leaf in self.encoder.leaves]

    def examples(self, batch_size: int, seed: int = 0) -> tuple[Tensor, ...]:
        """Create arguments of `forward` from random observations."""
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

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Map observations to `action` and `scores`."""
        if self.frame_stack > 1:
            inputs = tuple(part.flatten(0, 1) for part in inputs)
        observations = self._encode(inputs).stacked(self.frame_stack)
        scores = self.scores(observations)
        return scores.argmax(1) + self.first_action, scores

    def _encode(self, inputs: tuple[Tensor, ...]) -> Observations:
        """Encode observations as `ObservationEncoder.encode` does, in torch."""
        encoder, rows = self.encoder, inputs[0].shape[0]
        n_images = len(encoder.images)
        shaped = zip(inputs[:n_images], encoder.image_inputs, strict=True)
        images = tuple(image.reshape(-1, *wanted.shape) for image, wanted in shaped)
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


def export_onnx(policy: object, path: Path) -> None:
    """Write the policy of an offline run as an ONNX file, for a batch of any size.

    Raises:
        MissingExtraError: onnx or onnxscript is not installed.
        PolicyError: The policy is not from an offline run, or the file cannot be written.
    """
    if not isinstance(policy, Policy):
        raise PolicyError(f"{getattr(policy, 'name', policy)} is not the policy of an offline run")
    for package in ("onnx", "onnxscript"):
        import_extra(package, "export")
    module = ExportedPolicy(policy).eval()
    with _quiet():
        program = torch.onnx.export(
            module,
            module.examples(2),
            input_names=module.input_names,
            output_names=["action", "scores"],
            dynamic_shapes=(tuple({0: torch.export.Dim("batch")} for _ in module.input_names),),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    try:
        program.save(str(path))
    except OSError as error:
        raise PolicyError(f"cannot write {path}: {error.strerror}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporter's notices about optional packages and future versions."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _numbers(values: Tensor, space: spaces.Space[Any]) -> Tensor:
    """Encode one part of the space as (B, width): discrete values one-hot, others unchanged."""
    flat = values.reshape(values.shape[0], -1)
    if isinstance(space, spaces.Discrete):
        counts, starts = [int(space.n)], [int(space.start)]
    elif isinstance(space, spaces.MultiDiscrete):
        counts, starts = space.nvec.ravel().tolist(), space.start.ravel().tolist()
    else:
        return flat.float()
    codes = [
        nn.functional.one_hot(flat[:, k].long() - start, count).float()
        for k, (count, start) in enumerate(zip(counts, starts, strict=True))
    ]
    return torch.cat(codes, 1)
