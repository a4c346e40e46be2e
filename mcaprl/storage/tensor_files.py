"""Safetensors files with a JSON object in the header; pickle is not used."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from mcaprl.errors import TrainingError
from mcaprl.storage.documents import parse_json
from mcaprl.storage.locks import check_regular
from mcaprl.storage.work_folders import write_atomically

_DESCRIPTION = "description"


def write_tensors(path: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write tensors atomically, with a description in the header of the file."""
    # Safetensors refuses tensors that share storage.
    whole = {
        name: tensor.clone(memory_format=torch.contiguous_format)
        for name, tensor in tensors.items()
    }
    content = save(whole, {_DESCRIPTION: json.dumps(description)})
    write_atomically(path, content, TrainingError)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the description of a file that `write_tensors` wrote."""
    check_regular(path)
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        description = parse_json((file.metadata() or {}).get(_DESCRIPTION, "null"))
    if not isinstance(description, dict):
        raise ValueError(f"{path} has no description in its header")
    return tensors, description


def below(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with `name` and a dot, without this prefix."""
    prefix = f"{name}."
    return {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Check that all weights are finite, as those of every policy of a training are."""
    for name, tensor in weights.items():
        if not torch.isfinite(tensor).all():
            raise ValueError(f"{name} is not finite")


def check_widths(widths: Sequence[int], weights: Mapping[str, Tensor]) -> None:
    """Check that a file has enough weights for layers, before the layers are created."""
    if not all(isinstance(width, int) and width >= 1 for width in widths):
        raise ValueError(f"layers of widths {list(widths)} cannot be made")
    present = sum(tensor.numel() for tensor in weights.values())
    needed = max((first * second for first, second in itertools.pairwise(widths)), default=0)
    if needed > present:
        raise ValueError(f"a layer has {needed} weights, more than the {present} in the file")
