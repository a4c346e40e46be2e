"""Perform the tasks of the benchmarks with other libraries, as their documentation shows."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import mcaprl
from benchmarks.speed.workloads import ACTION, EPISODE_STEPS, OBSERVATION, Constant, run_env
from mcaprl.recorder import message_dtype, step_schema

NAME, TEXT = step_schema(OBSERVATION, ACTION)
Fields = dict[str, tuple[str, ...]]
"""Names of the fields to read, by topic."""
Span = tuple[int | None, int | None]
"""Half-open range of log_times, in nanoseconds; None for all."""
DEPTH = "/rl/observation/depth"
VECTOR_FIELDS: Fields = {"/rl/step": ("observation", "action", "reward")}
IMAGE_FIELDS: Fields = {"/rl/step": ("observation_state", "action", "reward"), DEPTH: ("data",)}


def messages(data: mcaprl.Dataset) -> list[bytes]:
    """Return prebuilt CDR messages of `/rl/step`, so that only the writing is timed."""
    dtype = message_dtype(TEXT)
    assert dtype is not None
    rows = np.zeros(len(data), dtype)
    rows["encapsulation"] = 0x0100
    rows["observation"], rows["action"] = data.observations, data.actions
    rows["reward"] = data.rewards
    size, buffer = dtype.itemsize, rows.tobytes()
    return [buffer[start : start + size] for start in range(0, len(buffer), size)]


def write_mcap(encoded: list[bytes], path: Path) -> None:
    """Write with mcap's Writer, with zstd."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema(NAME, "ros2msg", TEXT.encode())
        channel = writer.register_channel("/rl/step", "cdr", schema)
        for row, message in enumerate(encoded):
            writer.add_message(channel, row, message, row, row)
        writer.finish()


def write_interleaved(encoded: list[bytes], path: Path) -> None:
    """Write with mcap's Writer, together with messages of varying length on `/chatter`."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema(NAME, "ros2msg", TEXT.encode())
        channel = writer.register_channel("/rl/step", "cdr", schema)
        text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        chatter = writer.register_channel("/chatter", "cdr", text)
        for row, message in enumerate(encoded):
            writer.add_message(channel, row, message, row, row)
            if row % 4 == 0:
                count = 1 + row % 30
                said = b"\0\1\0\0" + count.to_bytes(4, "little") + b"x" * (count - 1) + b"\0"
                writer.add_message(chatter, row, said, row, row)
        writer.finish()


def write_foxglove(encoded: list[bytes], path: Path) -> None:
    """Write with foxglove-sdk, whose writer is in Rust."""
    import foxglove

    context = foxglove.Context()
    writer = foxglove.open_mcap(path, allow_overwrite=True, context=context)
    schema = foxglove.Schema(name=NAME, encoding="ros2msg", data=TEXT.encode())
    channel = foxglove.Channel("/rl/step", schema=schema, message_encoding="cdr", context=context)
    for row, message in enumerate(encoded):
        channel.log(message, log_time=row)
    writer.close()


def write_rosbags(encoded: list[bytes], folder: Path) -> None:
    """Write with rosbags, as a bag in MCAP."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(TEXT, NAME))
    shutil.rmtree(folder, ignore_errors=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/rl/step", NAME, typestore=store)
        for row, message in enumerate(encoded):
            bag.write(connection, row, message)


def read_mcap(
    path: Path, fields: Fields = VECTOR_FIELDS, span_ns: Span = (None, None)
) -> dict[str, NDArray[Any]]:
    """Read with mcap and mcap-ros2-support, message by message."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    columns, (start, stop) = _empty(fields), span_ns
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(list(fields), start_time=start, end_time=stop)
        for _, channel, _, message in found:
            for name in fields[channel.topic]:
                columns[name].append(getattr(message, name))
    return _as_arrays(columns)


def read_rerun(path: Path, topic: str, fields: Sequence[str]) -> list[list[NDArray[Any]]]:
    """Read fields with rerun's McapReader; return one array for each field of each chunk."""
    from rerun.chunk import McapReader

    reader = McapReader(path, decoders=["ros2_reflection"], include_topic_regex=[f"^{topic}$"])
    found = []
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        found.append([_arrow_field(batch, field) for field in fields])
    return found


def _arrow_field(batch: Any, field: str) -> NDArray[Any]:
    """Return one field as an array with a row for each message.

    The column stores each message as a list of one struct.
    """
    messages = next(
        column
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
        if name.endswith(":message")
    )
    column = messages.flatten()
    for part in field.split("."):
        column = column.field(part)
    values: NDArray[Any] = np.asarray(column.flatten() if hasattr(column, "offsets") else column)
    return values.reshape(len(messages), -1)


def read_rosbags(
    path: Path, fields: Fields = VECTOR_FIELDS, span_ns: Span = (None, None)
) -> dict[str, NDArray[Any]]:
    """Read with rosbags, message by message."""
    from rosbags.highlevel import AnyReader

    columns, (start, stop) = _empty(fields), span_ns
    with AnyReader([path]) as bag:
        wanted = [connection for connection in bag.connections if connection.topic in fields]
        for connection, _, raw in bag.messages(wanted, start, stop):
            message = bag.deserialize(raw, connection.msgtype)
            for name in fields[connection.topic]:
                columns[name].append(getattr(message, name))
    return _as_arrays(columns)


def _empty(fields: Fields) -> dict[str, list[Any]]:
    return {name: [] for names in fields.values() for name in names}


def _as_arrays(columns: dict[str, list[Any]]) -> dict[str, NDArray[Any]]:
    # mcap-ros2-support returns images as bytes.
    return {
        name: np.array([np.frombuffer(v, np.uint8) if isinstance(v, bytes) else v for v in values])
        for name, values in columns.items()
    }


class MinariFolder:
    """Minari's datasets in a separate folder."""

    def __init__(self, folder: Path) -> None:
        """Set Minari's root to the folder."""
        os.environ["MINARI_DATASETS_PATH"] = str(folder)
        self._folder = folder

    def record(self, episodes: int, data_format: str) -> None:
        """Step through an environment in Minari's DataCollector."""
        import minari

        name = f"bench/record-{data_format}-v0"
        shutil.rmtree(self._folder / name, ignore_errors=True)
        env = minari.DataCollector(_NoSpec(), data_format=data_format)
        for _ in range(episodes):
            env.reset()
            for _ in range(EPISODE_STEPS):
                env.step(3)
        env.create_dataset(name)
        env.close()

    def write(self, data: mcaprl.Dataset, data_format: str) -> str:
        """Write a dataset, and return its name."""
        import minari
        from minari.data_collector import EpisodeBuffer

        name = self.name(data, data_format)
        shutil.rmtree(self._folder / name, ignore_errors=True)
        buffers = [
            EpisodeBuffer(
                id=episode.index,
                observations=_frames(episode.observations, episode.next_observations),
                actions=episode.actions,
                rewards=episode.rewards,
                terminations=episode.terminated,
                truncations=episode.truncated,
                infos={},
            )
            for episode in data.episodes
        ]
        minari.create_dataset_from_buffers(
            name,
            buffers,
            observation_space=data.observation_space,
            action_space=data.action_space,
            data_format=data_format,
        )
        return name

    def name(self, data: mcaprl.Dataset, data_format: str) -> str:
        """Return the name under which `write` stores a dataset."""
        what = "images" if isinstance(data.observations, dict) else "vectors"
        return f"bench/{what}-{data_format}-v0"

    def read(self, name: str, episodes: list[int] | None = None) -> list[Any]:
        """Read observations, actions and rewards of episodes (default: all) into arrays."""
        import minari

        found = list(minari.load_dataset(name).iterate_episodes(episodes))
        return [
            _joined([getattr(episode, column) for episode in found])
            for column in ("observations", "actions", "rewards")
        ]


def _frames(observations: Any, following: Any) -> Any:
    """Return the observations of an episode, followed by the last next observation."""
    if isinstance(observations, dict):
        return {name: _frames(observations[name], following[name]) for name in observations}
    return np.concatenate([observations, following[-1:]])


def _joined(parts: list[Any]) -> Any:
    if isinstance(parts[0], dict):
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return np.concatenate(parts)


class _NoSpec(gym.Wrapper[Any, Any, Any, Any]):
    """Environment with an empty spec, which Minari requires."""

    def __init__(self) -> None:
        super().__init__(Constant())


def columns_of(data: mcaprl.Dataset) -> dict[str, NDArray[Any]]:
    """Return the columns for table formats.

    Next observations have no column: they are the observations of the next row.
    """
    here = data.observations
    return {
        **(here if isinstance(here, dict) else {"observation": here}),
        "action": data.actions,
        "reward": data.rewards,
        "terminated": data.terminated,
        "truncated": data.truncated,
    }


def write_h5py(data: mcaprl.Dataset, path: Path) -> None:
    """Write one chunked HDF5 file with h5py and gzip level 1; HDF5 has no built-in zstd."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, column in columns_of(data).items():
            file.create_dataset(
                name, data=column, chunks=True, compression="gzip", compression_opts=1
            )


def read_h5py(path: Path, rows: slice = slice(None)) -> dict[str, NDArray[Any]]:
    """Read with h5py."""
    import h5py

    with h5py.File(path) as file:
        return {name: file[name][rows] for name in file}


def write_parquet(data: mcaprl.Dataset, path: Path) -> None:
    """Write with pyarrow, compressed with zstd level 1."""
    import pyarrow
    import pyarrow.parquet

    table = {}
    for name, column in columns_of(data).items():
        if column.ndim == 1:
            table[name] = pyarrow.array(column)
        else:
            flat = pyarrow.array(column.ravel())
            table[name] = pyarrow.FixedSizeListArray.from_arrays(flat, column.shape[1])
    pyarrow.parquet.write_table(pyarrow.table(table), path, compression="zstd", compression_level=1)


def read_parquet(path: Path) -> dict[str, NDArray[Any]]:
    """Read with pyarrow, in this thread."""
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(path, use_threads=False)
    columns = {}
    for name in table.column_names:
        array = table.column(name).combine_chunks()
        is_list = hasattr(array, "flatten") and "list" in str(array.type)
        flat = array.flatten() if is_list else array
        values = flat.to_numpy(zero_copy_only=False)
        columns[name] = values.reshape(len(array), -1) if is_list else values
    return columns


def write_npz(data: mcaprl.Dataset, path: Path) -> None:
    """Write with NumPy, compressed."""
    columns: dict[str, Any] = columns_of(data)
    np.savez_compressed(path, **columns)


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read with NumPy."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


def record_nothing(episodes: int) -> None:
    """Step through the environment in a wrapper that does nothing."""
    run_env(gym.Wrapper(Constant()), episodes)
