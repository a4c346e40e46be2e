"""Reading of LeRobot datasets, version 3.0, written by LeRobot or by this package."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mcaprl.errors import LogError, import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.dataset.formats.lerobot import features
from mcaprl.recorder.dataset.formats.lerobot.files import Files
from mcaprl.recorder.dataset.formats.lerobot.foreign import foreign_dataset
from mcaprl.recorder.dataset.formats.lerobot.own import Own, read_own
from mcaprl.recorder.format.spaces import action_leaf, leaves_of, nest

# Types of the errors that invalid values in damaged files cause.
_DAMAGED = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    RecursionError,
    OSError,
)


def read(path: Path) -> Dataset:
    """Read a dataset.

    LeRobot does not store the observation after the last action of an episode. If `next.done` is
    set in the last frame, the observation of this frame is repeated as the final observation.
    Otherwise, the observation of the last frame becomes the final observation, the action of the
    last frame is left out, and the episode is truncated. A warning states the number of episodes
    in each of these cases.

    Args:
        path: Folder of the dataset.

    Raises:
        LogError: A file is missing, damaged or of another version.
        SpaceError: A log cannot hold a feature.
        MissingExtraError: PyArrow, Pillow or PyAV is not installed.
    """
    arrow = import_extra("pyarrow", "tables")
    try:
        files = Files(path)
        own = read_own(path, files.lengths)
        if own is not None and {*own.features, features.ACTION} <= set(files.features):
            return _own_dataset(files, own)
        return foreign_dataset(files)
    except (*_DAMAGED, arrow.ArrowException) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise LogError(f"{path} is a damaged LeRobot dataset: {reason}") from error


def _own_dataset(files: Files, own: Own) -> Dataset:
    """Return the dataset that the writer of this package wrote."""
    leaves = leaves_of(own.metadata.observation_space)
    action = action_leaf(own.metadata.action_space)
    columns = []
    for leaf, name in zip(leaves, own.features, strict=True):
        values = files.values(files.features[name])
        # In a video, a gray image has three equal channels: use the first channel.
        shown = values[..., 0] if leaf.encoding == "mono8" else values
        columns.append(shown.reshape(len(values), *leaf.shape))
    steps = files.steps()
    actions = steps[features.ACTION].reshape(-1, *action.shape)
    probabilities = steps.get(features.PROBABILITY)
    infos, episodes = own.infos.items(), []
    for index, (start, stop) in enumerate(files.ranges()):
        parts = [
            np.concatenate([column[start:stop], own.finals[leaf.name][index : index + 1]])
            for leaf, column in zip(leaves, columns, strict=True)
        ]
        episode = EpisodeArrays(
            observations=nest(leaves, parts),
            actions=actions[start:stop],
            rewards=steps[features.REWARD][start:stop, 0],
            terminated=bool(steps[features.DONE][stop - 1, 0]),
            truncated=bool(steps[features.TRUNCATED][stop - 1, 0]),
            behavior_probs=None if probabilities is None else probabilities[start:stop, 0],
            times_ns=own.times_ns[index],
            infos={name: values[start + index : stop + index + 1] for name, values in infos},
            summary=own.summaries[index],
        )
        episodes.append(episode)
    return dataset_of(episodes, own.metadata, files.path)
