"""Target of Ray Data that writes rows as logs. The logs and their manifest appear together."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from ray.data import Datasink
from ray.data.block import BlockAccessor

from mcaprl.errors import OutputExistsError, UsageError
from mcaprl.files import parse_json, temporary_folder
from mcaprl.ray.blocks import Columns, dataset_of
from mcaprl.ray.tasks import check_machine
from mcaprl.recorder.dataset.manifest import (
    MANIFEST_NAME,
    LogFile,
    unfinished_folder,
    write_manifest,
)
from mcaprl.recorder.format.metadata import METADATA_NAME, LogMetadata, installed_versions
from mcaprl.storage.remote import check_upload, is_url, upload


class LogSink(Datasink[LogFile | None]):  # type: ignore[misc]
    """Sink that writes one log for each write task to a folder or URL."""

    def __init__(
        self, folder: str | Path, description: LogMetadata | None, compression: str
    ) -> None:
        """Create the folder. The arguments are those of `ray.write`."""
        self._url = str(folder).rstrip("/") if is_url(folder) else None
        self._description, self._compression = description, compression
        self._versions = installed_versions()
        if self._url is not None:
            check_upload(self._url, overwrite=True)
            return
        self._folder = Path(folder).absolute()
        if self._folder.is_file() or (self._folder.is_dir() and any(self._folder.glob("*.mcap"))):
            raise OutputExistsError(f"{folder} exists: choose the name of a new folder")
        self._hidden = unfinished_folder(self._folder)

    @property
    def manifest(self) -> Path | str:
        """Path or URL of the manifest."""
        if self._url is not None:
            return f"{self._url}/{MANIFEST_NAME}"
        return self._folder / MANIFEST_NAME

    def write(self, blocks: Iterable[Any], ctx: Any) -> LogFile | None:
        """Write the blocks of one task as a log; return None if there are no rows."""
        tables = [BlockAccessor.for_block(block).to_arrow() for block in blocks]
        tables = [table for table in tables if len(table)]
        if not tables:
            return None
        name = f"shard-{ctx.task_idx:05d}.mcap"
        data = dataset_of(_joined(tables), self._describe(tables[0]), name)
        if self._url is None:
            check_machine(self._versions, [self._hidden])
            return self._save(data, self._hidden / name)
        with temporary_folder() as folder:
            found = self._save(data, folder / name)
            upload(folder / name, f"{self._url}/{name}")
        return found

    def on_write_complete(self, write_result: Any) -> None:
        """Move the logs from the hidden folder to the target folder, and write the manifest.

        If the target is a URL, only write the manifest.
        """
        files = sorted(filter(None, write_result.write_returns), key=lambda file: file.name)
        if self._url is not None:
            with temporary_folder() as folder:
                path = write_manifest(folder, files)
                upload(path, f"{self._url}/{path.name}")
            return
        for file in files:
            os.replace(self._hidden / file.name, self._folder / file.name)
        shutil.rmtree(self._hidden)
        write_manifest(self._folder, files)

    def on_write_failed(self, error: Exception) -> None:
        """Remove the unfinished logs."""
        if self._url is None:
            shutil.rmtree(self._hidden, ignore_errors=True)

    def _save(self, data: Any, path: Path) -> LogFile:
        # A repeated task replaces the log of the killed task.
        data.save(path, compression=self._compression, overwrite=True)
        return LogFile(path.name, len(data.episode_lengths), len(data), path.stat().st_size)

    def _describe(self, table: pyarrow.Table) -> LogMetadata:
        if self._description is not None:
            return self._description
        found = (table.schema.metadata or {}).get(METADATA_NAME.encode())
        if found is None:
            raise UsageError(
                "the rows have no metadata of their spaces: pass like=, the logs or the"
                " mcaprl.Dataset of the same environment"
            )
        return LogMetadata.from_strings(parse_json(found))


def _joined(tables: list[pyarrow.Table]) -> Columns:
    parts = [BlockAccessor.for_block(table).to_numpy(table.column_names) for table in tables]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
