"""Foxglove layouts of logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from mcaprl.api.environments import all_options
from mcaprl.errors import OutputExistsError, ReportError, UsageError
from mcaprl.files import temporary_folder, write_json
from mcaprl.recorder.format.reading import McapReader
from mcaprl.recorder.record.scene import DepthSource
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.viewer.annotate import attached_layout
from mcaprl.sims import SIMS, make_sim
from mcaprl.storage.remote import is_url


def layout(
    source: str | Path,
    out: str | Path | None = None,
    *,
    actions: str | int | None = None,
    sim_options: Mapping[str, Any] | None = None,
    keys: Sequence[str] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Return the Foxglove layout of a log, or of the logs of a sim.

    Args:
        source: Path or URL of a log, short name of a sim, or Gymnasium id.
        out: JSON file to write; None to write nothing.
        actions: Actions of the sim, such as `continuous`.
        sim_options: Other arguments of the environment.
        keys: Keys of the parts of a Dict or Tuple observation that the logs contain; default: all.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: `out` has the suffix of a log, or arguments or keys are given for a log.
        UnknownNameError: There is no such sim.
        OutputExistsError: `out` exists.
        LogError: The log cannot be read.
        ReportError: `out` cannot be written.
    """
    path = None if out is None else Path(out)
    if path is not None and path.suffix == ".mcap":
        raise UsageError(f"{path}: a layout is a JSON file and must not replace a log")
    if path is not None and path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists: choose another path, or pass `overwrite=True`")
    name = str(source)
    is_file = is_url(name) or Path(name).is_file() or name.endswith(".mcap")
    is_log = name not in SIMS and is_file
    options = all_options(None, None, actions, sim_options)
    if is_log and (options or keys is not None):
        raise UsageError(
            f"{name} is a log, but `actions=`, `sim_options=` and `keys=` are for a sim: omit them"
        )
    found = attached_layout(McapReader(name)) if is_log else _layout_of_sim(name, options, keys)
    if path is not None:
        write_json(path, found, ReportError)
    return found


def _layout_of_sim(sim: str, options: dict[str, Any], keys: Sequence[str] | None) -> dict[str, Any]:
    """Return the layout of a temporary recording of a sim."""
    with temporary_folder() as folder:
        path = folder / "reset.mcap"
        env = make_sim(sim, **options)
        camera = isinstance(env.unwrapped, DepthSource)
        with closing(RecordMcap(env, path, camera=camera, keys=keys)) as log:
            log.reset(seed=0)
        return attached_layout(McapReader(path))
