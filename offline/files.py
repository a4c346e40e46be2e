"""Files that are either whole or not there: a kill at any moment leaves the old one or the new.

Tensors go to safetensors files and everything else to JSON; nothing is ever unpickled.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

_DESCRIPTION = "description"


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file beside `path`, make sure that it is on the disk, then put it in place."""
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON object, indented for people."""
    write_atomically(path, (json.dumps(value, indent=2) + "\n").encode())


def write_tensors(path: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write tensors, with a JSON object in the file's header."""
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    write_atomically(path, save(whole, {_DESCRIPTION: json.dumps(description)}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `write_tensors` wrote.

    Raises:
        OSError: the file cannot be opened.
        SafetensorError: it is no safetensors file.
        ValueError: its header has no JSON object.
    """
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        description = json.loads((file.metadata() or {}).get(_DESCRIPTION, "null"))
    if not isinstance(description, dict):
        raise ValueError(f"{path} has no description in its header")
    return tensors, description
