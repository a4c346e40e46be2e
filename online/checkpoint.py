"""Checkpoints from which a killed run resumes.

`checkpoint.safetensors` contains weights, target network, optimizer, replay buffer and generators.
Its header contains the counters, the curve so far and the task. All are in one file, because two
files would be inconsistent if the process were killed between the two writes. A resumed run starts
new episodes, because Gymnasium has no interface to save the state of an environment.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import Tensor

from mcaprl.online.frame_buffer import FrameReplayBuffer
from mcaprl.online.task import Task
from mcaprl.runs import broken_checkpoint
from mcaprl.storage.tensor_files import read_tensors, write_tensors

# SB3 uses NumPy's global generator. NumPy's type stubs do not define `get_bit_generator`.
_NUMPY_RANDOM: Any = np.random
_BEST = "best"
_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
    "learning_starts",
)


def save_checkpoint(
    path: Path, model: BaseAlgorithm, task: Task, extra: dict[str, Any], best: bytes
) -> None:
    """Replace a checkpoint with the current state of a model."""
    generators, states = _generators(model)
    tensors = {
        **{f"policy.{name}": value for name, value in model.policy.state_dict().items()},
        **_optimizer_tensors(model.policy.optimizer),
        **{f"generator.{name}": value for name, value in generators.items()},
        **{f"buffer.{name}": value for name, value in _buffer_tensors(model).items()},
        _BEST: torch.from_numpy(np.frombuffer(best, np.uint8).copy()),
    }
    counters = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    description = {
        **task.identity.parts,
        "counters": counters,
        "generators": states,
        "extra": extra,
    }
    write_tensors(path, tensors, description)


def load_checkpoint(path: Path, model: BaseAlgorithm, task: Task) -> tuple[dict[str, Any], bytes]:
    """Load the state of a checkpoint into a fresh model.

    Returns:
        The arguments `extra` and `best` of `save_checkpoint`.
    """
    try:
        tensors, description = read_tensors(path)
        task.identity.check_same(description, path)
        model.policy.load_state_dict(_below(tensors, "policy"))
        _load_optimizer(model.policy.optimizer, _below(tensors, "optimizer"))
        _load_buffer(model, _below(tensors, "buffer"))
        for name, value in description["counters"].items():
            setattr(model, name, value)
        _load_generators(model, _below(tensors, "generator"), description["generators"])
        best = tensors[_BEST].numpy().tobytes() if _BEST in tensors else b""
        return cast(dict[str, Any], description["extra"]), best
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise broken_checkpoint(path, error) from error


def _optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    return {
        f"optimizer.{index}.{name}": value
        for index, moments in optimizer.state_dict()["state"].items()
        for name, value in moments.items()
    }


def _load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".")
        moments.setdefault(int(index), {})[name] = value
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for number, parts in moments.items():
        for name, part in parts.items():
            if part.shape == weights[number].shape:
                # Optimizer moments need the same memory format as their weights, which is
                # channels-last for convolutions.
                parts[name] = torch.empty_like(weights[number]).copy_(part)
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": moments, "param_groups": groups})


def _buffer_of(model: BaseAlgorithm) -> Any:
    return model.replay_buffer if isinstance(model, OffPolicyAlgorithm) else None


def _sb3_columns(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """Return an SB3 buffer's arrays by name (`name.key` in a dict), without the unfilled rows."""
    columns: dict[str, NDArray[Any]] = {}
    for name, value in vars(buffer).items():
        parts = {f"{name}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {}
        columns |= {k: v for k, v in {name: value, **parts}.items() if isinstance(v, np.ndarray)}
    return {name: column[: buffer.size()] for name, column in columns.items()}


def _buffer_tensors(model: BaseAlgorithm) -> dict[str, Tensor]:
    """Return the contents of the replay buffer; empty if the algorithm has none."""
    buffer = _buffer_of(model)
    if buffer is None:
        return {}
    frames = isinstance(buffer, FrameReplayBuffer)
    columns = buffer.columns() if frames else _sb3_columns(buffer)
    place = torch.tensor([buffer.pos, int(buffer.full)])
    return {"place": place, **{name: torch.from_numpy(part) for name, part in columns.items()}}


def _load_buffer(model: BaseAlgorithm, tensors: dict[str, Tensor]) -> None:
    buffer = _buffer_of(model)
    if buffer is None:
        return
    place = tensors.pop("place").tolist()
    buffer.pos, buffer.full = place[0], bool(place[1])
    columns = {name: tensor.numpy() for name, tensor in tensors.items()}
    if isinstance(buffer, FrameReplayBuffer):
        buffer.restore(columns)
    else:
        for name, rows in _sb3_columns(buffer).items():
            rows[:] = columns[name]


def _generators(model: BaseAlgorithm) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the states of the random generators, as tensors and as JSON values."""
    state = _NUMPY_RANDOM.get_bit_generator().state
    version, words, next_gauss = random.getstate()
    tensors = {
        "torch": torch.get_rng_state(),
        "numpy": torch.from_numpy(state["state"]["key"].astype(np.int64)),
        "python": torch.tensor(words, dtype=torch.int64),
    }
    plain = {
        "numpy": state["state"]["pos"],
        "python": [version, next_gauss],
        "actions": model.action_space.np_random.bit_generator.state,
    }
    return tensors, plain


def _load_generators(
    model: BaseAlgorithm, tensors: Mapping[str, Tensor], plain: Mapping[str, Any]
) -> None:
    torch.set_rng_state(tensors["torch"])
    key = tensors["numpy"].numpy().astype(np.uint32)
    _NUMPY_RANDOM.get_bit_generator().state = {
        "bit_generator": "MT19937",
        "state": {"key": key, "pos": plain["numpy"]},
    }
    version, next_gauss = plain["python"]
    random.setstate((version, tuple(tensors["python"].tolist()), next_gauss))
    model.action_space.np_random.bit_generator.state = plain["actions"]


def _below(tensors: Mapping[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}
