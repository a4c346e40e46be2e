"""Training on images that stay on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.recorder.dataset.images import MappedImages

SPACE = spaces.Dict(
    {
        "action_mask": spaces.Box(1, 1, (3,), np.int8),
        "camera": spaces.Box(0, 255, (40, 36, 2), np.uint8),
        "rear": spaces.Box(0, 255, (36, 36), np.uint8),
        "speed": spaces.Box(-1, 1, (2,), np.float32),
    }
)


def random_data(steps: int, seed: int) -> mcaprl.Dataset:
    """Return one episode of random observations."""
    random = np.random.default_rng(seed)
    frames = {
        "action_mask": np.ones((steps + 1, 3), np.int8),
        "camera": random.integers(0, 256, (steps + 1, 40, 36, 2), np.uint8),
        "rear": random.integers(0, 256, (steps + 1, 36, 36), np.uint8),
        "speed": random.uniform(-1, 1, (steps + 1, 2)).astype(np.float32),
    }
    last = np.arange(steps) == steps - 1
    return mcaprl.Dataset.from_arrays(
        observations={key: values[:-1] for key, values in frames.items()},
        next_observations={key: values[1:] for key, values in frames.items()},
        actions=random.integers(0, 3, steps),
        rewards=random.normal(size=steps),
        terminated=last,
        truncated=np.zeros(steps, bool),
        observation_space=SPACE,
        action_space=spaces.Discrete(3),
    )


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with three logs."""
    folder = tmp_path_factory.mktemp("logs")
    for number, steps in enumerate((9, 4, 7)):
        random_data(steps, number).save(folder / f"{number}.mcap", compression="none")
    return folder


@pytest.mark.parametrize(
    "settings",
    [
        {"algo": "cql", "frame_stack": 2, "normalize": True},
        {"algo": "iql", "n_steps": 2, "center_images": True, "held_out": 0.4, "seeds": 2},
    ],
    ids=["stacked", "centered"],
)
def test_weights_are_those_of_images_in_memory(
    logs: Path, tmp_path: Path, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("all images were read into memory")

    monkeypatch.setattr(MappedImages, "__array__", refuse)
    weights = []
    for storage in ("memory", "mapped"):
        data = mcaprl.open(logs, images=storage)
        options = {
            "updates": 20,
            "gamma": 0.5,
            "target_interval": 5,
            "batch_size": 4,
            "hidden": (8,),
            "held_out": 0.0,
            **settings,
        }
        found = mcaprl.train(data, tmp_path / storage, **options)
        weights.append([(one.folder / "policy.safetensors").read_bytes() for one in found])
    assert weights[0] == weights[1]
