"""Safetensors files with a JSON object in the header; nothing is unpickled."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from mcaprl.files import write_atomically

_DESCRIPTION = "description"


def write_tensors(path: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write tensors, and a description in the header of the file, with `replacing`."""
    # Safetensors refuses tensors that share storage.
    whole = {
        name: tensor.clone(memory_format=torch.contiguous_format)
        for name, tensor in tensors.items()
    }
    write_atomically(path, save(whole, {_DESCRIPTION: json.dumps(description)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and the description of a file that `write_tensors` wrote.

    Raises:
        OSError: The file cannot be opened.
        SafetensorError: The file is not a safetensors file.
        ValueError: The header has no description.
    """
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        description = json.loads((file.metadata() or {}).get(_DESCRIPTION, "null"))
    if not isinstance(description, dict):
        raise ValueError(f"{path} has no description in its header")
    return tensors, description
