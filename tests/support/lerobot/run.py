"""LeRobot's own reader and writer, run by the tests in an environment that has LeRobot.

    python run.py read FOLDER OUT.npz    all items of a dataset, by key
    python run.py chunks FOLDER OUT.npz  the same, with the actions of the next 4 steps
    python run.py same LOG FOLDER        compares a log with its dataset, item by item
    python run.py merge FOLDER TARGET [OUT.npz]  a dataset with the episodes of FOLDER twice
    python run.py make FOLDER KIND       the golden dataset of KIND `image` or `video`
    python run.py run PROGRAM ...        a script or a module, with its arguments

Only NumPy, PyAV, torch and LeRobot are imported. The writer of LeRobot 0.4 needs NumPy < 2.4.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch


def main(command: str, folder: str, *target: str) -> None:
    """Run a command."""
    if command == "run":
        run(folder, *target)
    else:
        commands: dict[str, Callable[..., None]] = {
            each.__name__: each for each in (read, chunks, same, merge, make)
        }
        commands[command](Path(folder), *target)


def run(program: str, *arguments: str) -> None:
    """Run a program with LeRobot's modules prepared."""
    _lerobot()
    torch.set_num_threads(1)
    sys.argv = [program, *arguments]
    start = runpy.run_path if program.endswith(".py") else runpy.run_module
    start(program, run_name="__main__")


def chunks(folder: Path, target: str) -> None:
    """Write what LeRobot reads with chunks of 4 actions, and the flags of their padding."""
    reader = _lerobot().LeRobotDataset
    fps = reader("any/name", root=folder).fps
    steps = {"action": [step / fps for step in range(4)]}
    _write(reader("any/name", root=folder, delta_timestamps=steps), target)


def read(folder: Path, target: str) -> None:
    """Write what LeRobot reads: items, statistics, frame rate and episode lengths."""
    _write(_lerobot().LeRobotDataset("any/name", root=folder), target)


def _write(dataset: Any, target: str) -> None:
    items = [dataset[row] for row in range(len(dataset))]
    found: dict[str, Any] = {
        key: np.stack([np.asarray(item[key]) for item in items]) for key in items[0]
    }
    found |= {
        f"stats/{key}/{name}": np.asarray(array)
        for key, stats in dataset.meta.stats.items()
        for name, array in stats.items()
    }
    found["fps"] = np.asarray(dataset.fps)
    found["lengths"] = np.asarray(dataset.meta.episodes["length"])
    np.savez(target, allow_pickle=False, **found)


def same(log: Path, folder: str) -> None:
    """Compare what a log and its dataset return, and what LeRobot reads of their descriptions."""
    data = import_module("mcaprl").open(log)
    reader = _lerobot().LeRobotDataset
    fps = reader("any/name", root=folder).fps
    images = [name for name in reader("any/name", root=folder).features if "image" in name]
    steps = {name: [step / fps for step in (-1, 0, 3)] for name in ("action", *images)}
    for options in ({}, {"delta_timestamps": steps}, {"episodes": [1], "delta_timestamps": steps}):
        mine, theirs = data.as_lerobot(**options), reader("any/name", root=folder, **options)
        assert len(mine) == len(theirs) == mine.num_frames == theirs.num_frames
        assert (mine.num_episodes, mine.fps) == (theirs.num_episodes, theirs.fps)
        for row in (*range(len(theirs)), -1):
            found, wanted = mine[row], theirs[row]
            assert found.keys() == wanted.keys()
            assert found.pop("task") == wanted.pop("task")
            for key, value in wanted.items():
                assert found[key].dtype == value.dtype, key
                torch.testing.assert_close(found[key], value, rtol=0, atol=0, equal_nan=True)
        for name in ("info", "video_keys", "image_keys", "camera_keys", "names", "shapes", "fps"):
            assert getattr(mine.meta, name) == getattr(theirs.meta, name), name
        assert mine.meta.tasks.equals(theirs.meta.tasks)
        for key in ("dataset_from_index", "dataset_to_index", "length", "tasks"):
            assert mine.meta.episodes[key] == list(theirs.meta.episodes[key]), key
            assert mine.meta.episodes[1][key] == theirs.meta.episodes[1][key]
        assert mine.meta.stats.keys() == theirs.meta.stats.keys()
        for name, stats in theirs.meta.stats.items():
            for kind, value in stats.items():
                np.testing.assert_array_equal(mine.meta.stats[name][kind], value)


def merge(folder: Path, target: str, items: str | None = None) -> None:
    """Merge a dataset with itself, and write the items of the result."""
    reader = _lerobot().LeRobotDataset
    aggregate = import_module("lerobot.datasets.aggregate").aggregate_datasets
    aggregate(["any/a", "any/b"], "any/merged", roots=[folder, folder], aggr_root=Path(target))
    if items is not None:
        _write(reader("any/name", root=target), items)


def make(folder: Path, kind: str) -> None:
    """Write two episodes of four and three frames with two cameras."""
    features = {
        "observation.state": _feature("float32", 2, names={"motors": ["shoulder", "elbow"]}),
        "observation.images.front": _feature(kind, 32, 48, 3, names=_EDGES),
        "observation.images.wrist": _feature(kind, 32, 32, 3, names=_EDGES),
        "action": _feature("float32", 2, 3),
    }
    if kind == "image":
        features |= {
            "next.reward": _feature("float32", 1),
            "next.done": _feature("bool", 1),
            "complementary_info.discrete_penalty": _feature("float32", 1),
        }
    dataset = _lerobot().LeRobotDataset.create(
        "any/name", 10, features, root=folder, robot_type="arm", use_videos=kind == "video"
    )
    for episode, (length, task) in enumerate([(4, "lift the cube"), (3, "drop the cube")]):
        for step in range(length):
            chunk = np.arange(6).reshape(2, 3) + step + 10 * episode
            frame = {
                "observation.state": np.array([episode, step / 4], np.float32),
                "observation.images.front": np.full((32, 48, 3), 40 * step + episode, np.uint8),
                "observation.images.wrist": np.full(
                    (32, 32, 3), 30 * step + 100 * episode, np.uint8
                ),
                "action": chunk.astype(np.float32),
                "next.reward": np.array([step + episode / 2], np.float32),
                "next.done": np.array([step == length - 1 and episode == 0]),
                "complementary_info.discrete_penalty": np.array([-0.5 * step], np.float32),
            }
            known = {name: value for name, value in frame.items() if name in features}
            dataset.add_frame({**known, "task": task})
        dataset.save_episode()
    dataset.finalize()


def _feature(dtype: str, *shape: int, names: Any = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "names": names}


_EDGES = ["height", "width", "channels"]


def _lerobot() -> Any:
    """Import LeRobot's module of datasets.

    torchvision's wheel is built for CUDA. With torch for the CPU, its compiled operators are
    missing. This function declares them, but LeRobot calls none of them. This torchvision also
    decodes no video, so PyAV decodes videos here.
    """
    library: Any = import_module("torch.library").Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _LIBRARIES.append(library)
    module = import_module("lerobot.datasets.lerobot_dataset")
    vars(module)["decode_video_frames"] = _decode
    return module


# If a library is garbage-collected, its operators are removed.
_LIBRARIES: list[Any] = []


def _decode(path: Path, times_s: list[float], tolerance_s: float, _backend: str) -> torch.Tensor:
    """Return the images (K, 3, height, width) in [0, 1] that a video has at these times."""
    with import_module("av").open(str(path)) as container:
        frames = list(container.decode(video=0))
    found = []
    for time_s in times_s:
        nearest = min(frames, key=lambda frame: abs(frame.time - time_s))
        assert abs(nearest.time - time_s) < tolerance_s, f"no image at {time_s} s"
        found.append(nearest.to_ndarray(format="rgb24").transpose(2, 0, 1) / 255)
    return torch.from_numpy(np.stack(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
