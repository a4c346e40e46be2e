"""Conversions of a dataset to and from other tools' data, as methods of `Dataset`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from mcaprl.recorder.dataset.format_registry import (
    FORMATS,
    module_of,
    read_format,
    write_format,
)

if TYPE_CHECKING:
    from mcaprl.recorder.dataset.dataset import Dataset
    from mcaprl.recorder.dataset.formats.lerobot_items import LeRobotItems


class Conversions:
    """Methods of `Dataset` that convert to and from other tools' data."""

    def to_lerobot(
        self,
        path: str | Path,
        *,
        video: bool | None = None,
        lossy: bool = False,
        overwrite: bool = False,
    ) -> list[str]:
        """Write a LeRobot dataset v3.

        Args:
            path: Path of the folder.
            video: Whether images are videos instead of PNG. If the images are the frames of a
                video, its packets are copied where LeRobot's files can have them; by default, these
                are the only videos. With True, the other images are encoded as H.264, which changes
                the pixels, so it also needs `lossy`. With False, all images are PNG.
            lossy: Whether to leave out or convert data that the format cannot store.
            overwrite: Whether to replace an existing file or folder.

        Returns:
            One sentence for each thing that was left out or changed. Those that begin with `video:`
            say of each video whether its packets are copied, and why not.

        Raises:
            SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
            OutputExistsError: Something exists at the path, and `overwrite` is not set.
            LogError: The files cannot be written, or the dataset has no episodes.
            MissingExtraError: A package of the format is not installed.
        """
        return self._written("lerobot", path, lossy=lossy, overwrite=overwrite, video=video)

    @staticmethod
    def from_lerobot(path: str | Path) -> Dataset:
        """Read a LeRobot dataset v3; `save` copies the packets of its videos to a log.

        Raises:
            LogError: The files are missing, damaged or of another format.
            SpaceError: A log cannot hold a space or dtype of the data.
            MissingExtraError: A package of the format is not installed.
        """
        return _read("lerobot", path)

    def as_lerobot(
        self,
        *,
        episodes: Sequence[int] | None = None,
        delta_timestamps: Mapping[str, Sequence[float]] | None = None,
        image_transforms: Callable[[Any], Any] | None = None,
        tolerance_s: float = 1e-4,
    ) -> LeRobotItems:
        """Return what LeRobot's policies and loaders read like a `LeRobotDataset`; write nothing.

        Its items equal those that LeRobot reads from the folder of `to_lerobot`. LeRobot need not
        be installed.

        Args:
            episodes: Indexes of the episodes; None for all. Statistics are those of all episodes.
            delta_timestamps: Times of further frames, seconds, by feature.
            image_transforms: Function of an image (channels, height, width), or None.
            tolerance_s: Largest difference of a time from a multiple of the period, seconds.

        Raises:
            SpaceError: LeRobot has no place for a space or dtype.
            UsageError: There is no such episode or feature, or a time is between two frames.
        """
        items: LeRobotItems = module_of("lerobot_items").LeRobotItems(
            cast("Dataset", self),
            episodes=episodes,
            delta_timestamps=delta_timestamps,
            image_transforms=image_transforms,
            tolerance_s=tolerance_s,
        )
        return items

    def to_minari(
        self, path: str | Path, *, lossy: bool = False, overwrite: bool = False
    ) -> list[str]:
        """Write a Minari dataset.

        Args:
            path: Path of the folder, or `minari:ID` for a dataset in Minari's local folder. The
                name of the folder is the name of the dataset, and ends with a version, such as
                `drive-v0`.
            lossy: Whether to leave out or convert data that the format cannot store.
            overwrite: Whether to replace an existing file or folder.

        Returns:
            One sentence for each thing that was left out or changed.

        Raises:
            SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
            OutputExistsError: Something exists at the path, and `overwrite` is not set.
            LogError: The files cannot be written, or the dataset has no episodes.
            MissingExtraError: A package of the format is not installed.
        """
        return self._written("minari", path, lossy=lossy, overwrite=overwrite)

    @staticmethod
    def from_minari(path: str | Path, *, lossy: bool = False) -> Dataset:
        """Read a Minari dataset.

        Args:
            path: Path of the folder, or `minari:ID` for a dataset in Minari's local folder.
            lossy: Whether to leave out the parts of observations and actions that a log cannot
                store, such as texts.

        Raises:
            LogError: The files are missing, damaged or of another format.
            SpaceError: A log cannot hold a space or dtype of the data.
            MissingExtraError: A package of the format is not installed.
        """
        return _read("minari", path, lossy=lossy)

    def to_parquet(
        self,
        path: str | Path,
        *,
        next_observations: bool = True,
        lossy: bool = False,
        overwrite: bool = False,
    ) -> list[str]:
        """Write a folder with two Parquet files, for transitions and for episodes.

        Args:
            path: Path of the folder.
            next_observations: Whether to add the next observation to each row. Other tools may need
                it; `from_parquet` does not. Images then take twice the space.
            lossy: Whether to leave out or convert data that the format cannot store.
            overwrite: Whether to replace an existing file or folder.

        Returns:
            One sentence for each thing that was left out or changed.

        Raises:
            OutputExistsError: Something exists at the path, and `overwrite` is not set.
            LogError: The files cannot be written, or the dataset has no episodes.
            MissingExtraError: A package of the format is not installed.
        """
        options = {"next_observations": next_observations}
        return self._written("parquet", path, lossy=lossy, overwrite=overwrite, **options)

    @staticmethod
    def from_parquet(path: str | Path) -> Dataset:
        """Read a folder with two Parquet files, for transitions and for episodes.

        Raises:
            LogError: The files are missing, damaged or of another format.
            SpaceError: A log cannot hold a space or dtype of the data.
            MissingExtraError: A package of the format is not installed.
        """
        return _read("parquet", path)

    def to_hdf5(
        self, path: str | Path, *, lossy: bool = False, overwrite: bool = False
    ) -> list[str]:
        """Write an HDF5 file in D4RL's form.

        Args:
            path: Path of the file.
            lossy: Whether to leave out or convert data that the format cannot store.
            overwrite: Whether to replace an existing file.

        Returns:
            One sentence for each thing that was left out or changed.

        Raises:
            SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
            OutputExistsError: Something exists at the path, and `overwrite` is not set.
            LogError: The files cannot be written, or the dataset has no episodes.
            MissingExtraError: A package of the format is not installed.
        """
        return self._written("hdf5", path, lossy=lossy, overwrite=overwrite)

    @staticmethod
    def from_hdf5(
        path: str | Path,
        *,
        one_episode: bool = False,
        dones: Literal["terminated", "truncated"] | None = None,
    ) -> Dataset:
        """Read an HDF5 file in D4RL's form.

        Args:
            path: Path of the file.
            one_episode: Whether all rows are one episode if nothing marks where an episode ends.
                Otherwise, such a file is refused.
            dones: Kind of the ends that no array distinguishes; see docs/formats.md for the
                default.

        Raises:
            LogError: The files are missing, damaged or of another format, or nothing says where
                episodes end.
            SpaceError: A log cannot hold a space or dtype of the data, or a value is impossible.
            UsageError: The options contradict the file.
            MissingExtraError: A package of the format is not installed.
        """
        return _read("hdf5", path, one_episode=one_episode, dones=dones)

    def to_npz(
        self, path: str | Path, *, lossy: bool = False, overwrite: bool = False
    ) -> list[str]:
        """Write the dataset as NumPy arrays in one .npz file.

        Args:
            path: Path of the file.
            lossy: Whether to leave out or convert data that the format cannot store.
            overwrite: Whether to replace an existing file.

        Returns:
            One sentence for each thing that was left out or changed.

        Raises:
            SpaceError: The format cannot hold a space or dtype, and `lossy` is not set.
            OutputExistsError: Something exists at the path, and `overwrite` is not set.
            LogError: The files cannot be written, or the dataset has no episodes.
            MissingExtraError: A package of the format is not installed.
        """
        return self._written("npz", path, lossy=lossy, overwrite=overwrite)

    @staticmethod
    def from_npz(
        path: str | Path,
        *,
        one_episode: bool = False,
        dones: Literal["terminated", "truncated"] | None = None,
    ) -> Dataset:
        """Read a dataset from the NumPy arrays in an .npz file.

        Args:
            path: Path of the file.
            one_episode: Whether all rows are one episode if nothing marks where an episode ends.
                Otherwise, such a file is refused.
            dones: Kind of the ends that no array distinguishes; see docs/formats.md for the
                default.

        Raises:
            LogError: The files are missing, damaged or of another format, or nothing says where
                episodes end.
            SpaceError: A log cannot hold a space or dtype of the data, or a value is impossible.
            UsageError: The options contradict the file.
            MissingExtraError: A package of the format is not installed.
        """
        return _read("npz", path, one_episode=one_episode, dones=dones)

    def to_d3rlpy(self) -> Any:
        """Return a `d3rlpy.dataset.MDPDataset` with all transitions.

        A truncated episode gets an additional step, because d3rlpy does not use the last step
        of a truncated episode as a transition.

        Raises:
            SpaceError: d3rlpy cannot hold a space.
            MissingExtraError: d3rlpy is not installed.
        """
        return module_of("d3rlpy").to_mdp_dataset(self)

    @staticmethod
    def from_d3rlpy(buffer: Any) -> Dataset:
        """Copy the episodes of a d3rlpy replay buffer, such as an `MDPDataset`.

        Raises:
            SpaceError: A log cannot hold a space or dtype of the data.
            LogError: There are no transitions.
            UsageError: `buffer` is not a replay buffer of d3rlpy.
        """
        found: Dataset = module_of("d3rlpy").from_buffer(buffer)
        return found

    def to_sb3(self, *, device: str = "cpu", buffer_class: Any = None, **options: Any) -> Any:
        """Return a Stable-Baselines3 `ReplayBuffer` or `DictReplayBuffer` with all transitions.

        Images are stored with the channels first, and actions of a bounded Box are scaled to
        [-1, 1], as SB3's algorithms store them.

        Args:
            device: Torch device of the samples.
            buffer_class: Class of the buffer, such as `NStepReplayBuffer`; default:
                `DictReplayBuffer` for a Dict observation space, otherwise `ReplayBuffer`.
            options: Further arguments of the buffer. The default of `buffer_size` is the number of
                rows that the dataset needs.

        Raises:
            SpaceError: SB3 does not support a space.
            UsageError: `buffer_size` is too small, or `n_envs` is not 1.
            MissingExtraError: Stable-Baselines3 is not installed.
        """
        convert = module_of("sb3").to_buffer
        return convert(self, device=device, buffer_class=buffer_class, **options)

    @staticmethod
    def from_sb3(
        buffer: Any,
        *,
        channels_last: bool = True,
        scaled_actions: bool = True,
        lossy: bool = False,
    ) -> Dataset:
        """Copy the transitions of a Stable-Baselines3 replay buffer.

        The result contains all transitions of the first environment, then all transitions of the
        second environment, and so on. The transitions of an environment are in order from old to
        new.

        Args:
            buffer: `ReplayBuffer` or `DictReplayBuffer`.
            channels_last: Whether to return images as (height, width, channels), the order of axes
                in environments. Otherwise, images keep the order of axes in the buffer.
            scaled_actions: Whether the actions of a bounded Box in the buffer are scaled to
                [-1, 1], as SB3's algorithms store them. Such actions are scaled back to the bounds
                of the Box, which rounds them.
            lossy: Whether to read a buffer with `handle_timeout_termination=False`. All its
                truncations become terminations. If the buffer also has `optimize_memory_usage`, it
                has lost the final observations: each becomes a copy of the observation before it.

        Raises:
            SpaceError: A log cannot hold a space or dtype of the data.
            LogError: The buffer is empty, or has lost information and `lossy` is not set.
            UsageError: `buffer` is not a replay buffer of SB3.
        """
        options = {"channels_last": channels_last, "scaled_actions": scaled_actions}
        found: Dataset = module_of("sb3").from_buffer(buffer, lossy=lossy, **options)
        return found

    def _written(
        self, name: str, path: str | Path, *, lossy: bool, overwrite: bool, **options: Any
    ) -> list[str]:
        dataset, form = cast("Dataset", self), FORMATS[name]
        return write_format(dataset, path, form, lossy=lossy, overwrite=overwrite, **options)


def _read(name: str, path: str | Path, **options: Any) -> Dataset:
    return read_format(path, FORMATS[name], **options)
