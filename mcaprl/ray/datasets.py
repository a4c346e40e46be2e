"""Reading and writing of logs with Ray Data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaprl.errors import McaprlError, import_extra
from mcaprl.ray.cluster import connect, cpus
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.log_reader import LogReader
from mcaprl.recorder.dataset.open import Episodes, find_logs
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.source import Data, logs_of

if TYPE_CHECKING:
    import ray.data

# Maximum size of a block if Ray sets no maximum.
_BLOCK_BYTES = 128 << 20


def read(
    data: Data,
    *,
    columns: Sequence[str] | None = None,
    episodes: Episodes | None = None,
    address: str | None = None,
    **options: Any,
) -> ray.data.Dataset:
    """Read logs as a dataset of Ray Data with one row per transition.

    The columns are those of `Dataset.to_arrow`: `episode`, `step`, `log_time_ns`, `reward`,
    `terminated`, `truncated`, `behavior_prob` (for actions of floats, `behavior_log_prob`),
    `action`, `observation` and `next_observation`, or `observation_<key>` and
    `next_observation_<key>` for the parts of a Dict. Vectors and images are tensors. Each block has
    whole episodes of one log. An episode above Ray's maximum block size is divided. Infos are not
    read.

    This function reads only the summaries of the logs. When rows are needed, the workers read the
    columns that later steps use, and check all CRCs.

    Args:
        data: A file, a folder of `.mcap` files, its `manifest.json`, a glob, a URL, or a sequence
            of these; or a dataset that `open` read from logs. All workers must see local paths.
        columns: Names of the columns to read; default: all.
        episodes: Index, slice or indexes of the episodes to read, counted over all logs; default:
            all. The column `episode` has these indexes.
        address: Address of the Ray cluster, `HOST:PORT` or `auto`; default: the cluster that this
            process is connected to, else RAY_ADDRESS, else a new local cluster.
        **options: Further arguments of `ray.data.read_datasource`, such as `concurrency`.
            `override_num_blocks` is the minimum number of blocks; there are at most as many blocks
            as episodes.

    Raises:
        LogError: A log is missing or damaged, or no log has a finished episode.
        SpaceError: The spaces of the logs differ.
        UnknownNameError: There is no such column.
        UsageError: There is no such episode.
        ClusterError: The Ray cluster cannot be used.
        MissingExtraError: Ray is not installed.
    """
    connect(address)
    ray_data = import_extra("ray.data", "ray")
    from mcaprl.ray.blocks import LogSource

    source = LogSource(
        list(logs_of(data)),
        columns,
        episodes,
        blocks=options.pop("override_num_blocks", None),
        least=2 * cpus(),
        most_bytes=ray_data.DataContext.get_current().target_max_block_size or _BLOCK_BYTES,
    )
    rows: ray.data.Dataset = ray_data.read_datasource(
        source, override_num_blocks=len(source.groups), **options
    )
    return rows


def write(
    rows: ray.data.Dataset,
    folder: str | Path,
    *,
    like: Data | None = None,
    compression: str = "zstd",
    **options: Any,
) -> Path | str:
    """Write a dataset of Ray Data as logs, one for each block, and write a manifest of the logs.

    The rows have the columns of `read`; `log_time_ns`, `behavior_prob` and `behavior_log_prob` may
    be missing. All rows of an episode must be in one block. The logs are numbered in the order of
    the blocks. The times in the logs are new. The seeds and policies of the logs that were read are
    dropped.

    Args:
        rows: Dataset to write; this function runs its steps.
        folder: New folder that all workers see, or URL of a folder. In a local folder, the logs and
            the manifest appear when all are complete.
        like: Logs or dataset of the same environment. The new logs get its spaces and names. This
            argument is needed if a step after `read` has dropped the metadata of the blocks.
        compression: Compression of chunks: `zstd`, `lz4` or `none`.
        **options: Further arguments of `Dataset.write_datasink`, such as `concurrency`.

    Returns:
        Path or URL of the manifest.

    Raises:
        OutputExistsError: The folder contains logs.
        SpaceError: A column is missing or does not fit the spaces, or an episode is not whole.
        UsageError: The rows have no metadata, and `like` is not given.
        ClusterError: A worker has other versions, or does not see the folder.
        MissingExtraError: Ray is not installed.
    """
    import_extra("ray.data", "ray")
    from mcaprl.ray.blocks import LogSink

    sink = LogSink(folder, None if like is None else _described(like), compression)
    try:
        rows.write_datasink(sink, **options)
    except Exception as error:
        raise _ours(error) or error from None
    return sink.manifest


def _described(like: Data) -> LogMetadata:
    if isinstance(like, Dataset):
        return like._description
    return LogReader(find_logs(like)[0]).description


def _ours(error: BaseException | None) -> McaprlError | None:
    """Return the error of this package that caused an error of Ray, or None."""
    seen = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, McaprlError):
            return error
        seen.add(id(error))
        error = getattr(error, "cause", None) or error.__cause__
    return None
