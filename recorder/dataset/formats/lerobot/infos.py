"""Infos in LeRobot datasets.

All infos are in `meta/mcaprl/infos.parquet`, with one row for each observation. Each info has a
column of values and a column of flags, which are true where the info is present. Numeric infos that
are present at every step are also written as features, so that users of LeRobot see them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import import_extra
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.formats.lerobot.features import (
    INFO,
    MAX_DIMENSIONS,
    PROBABILITY,
    Feature,
)
from mcaprl.recorder.dataset.formats.lerobot.files import read_table
from mcaprl.recorder.dataset.formats.lerobot.tables import write_table

_FILE = "infos.parquet"

Infos = Mapping[str, Any]
"""Masked arrays (F, *shape) by dotted name, one row for each of the F observations."""


def infos_of(dataset: Dataset) -> Infos:
    """Return the infos of a dataset."""
    return dataset.infos


def info_features(infos: Infos, frames: NDArray[np.int64]) -> dict[str, Feature]:
    """Return a feature for each numeric info that is present at every step, by the info's name.

    Args:
        infos: Infos of the dataset.
        frames: Indexes (N,) of the rows with the infos that the steps returned.
    """
    found: dict[str, Feature] = {}
    taken = {PROBABILITY}
    for name, values in infos.items():
        shape = values.shape[1:] or (1,)
        is_number = values.dtype.kind in "biuf" and values.dtype != np.uint64
        if not is_number or len(shape) > MAX_DIMENSIONS or not _present(values)[frames].all():
            continue
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", name)
        feature = INFO + re.sub("image", "img", plain, flags=re.IGNORECASE)
        if feature not in taken:
            taken.add(feature)
            found[name] = Feature(feature, str(values.dtype), shape)
    return found


def write_infos(folder: Path, infos: Infos) -> list[dict[str, Any]]:
    """Write all infos to a folder, and return their descriptions, which `read_infos` needs."""
    arrow = import_extra("pyarrow", "tables")
    columns, described = {}, []
    for number, (name, values) in enumerate(infos.items()):
        shape = values.shape[1:] or (1,)
        feature = Feature(name, str(values.dtype), shape)
        columns[f"{number}.value"] = feature.encode(np.ma.getdata(values).reshape(-1, *shape))
        columns[f"{number}.is_present"] = arrow.array(_present(values))
        described.append(
            {"name": name, "dtype": str(values.dtype), "shape": list(values.shape[1:])}
        )
    if columns:
        write_table(columns, folder / _FILE)
    return described


def read_infos(folder: Path, described: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Read the infos that `write_infos` wrote."""
    if not described:
        return {}
    table, found = read_table(folder / _FILE), {}
    for number, entry in enumerate(described):
        shape = tuple(int(size) for size in entry["shape"])
        dtype: np.dtype[Any] = np.dtype(entry["dtype"])
        column = table[f"{number}.value"]
        if dtype.kind == "U":
            values = np.array(_texts(column), dtype).reshape(len(column), *shape)
        else:
            feature = Feature(entry["name"], str(dtype), shape or (1,))
            values = feature.decode(column).reshape(len(column), *shape)
        present = table[f"{number}.is_present"].to_numpy()
        mask = np.broadcast_to(~present.reshape(-1, *[1] * len(shape)), values.shape)
        found[entry["name"]] = np.ma.MaskedArray(values, mask.copy())
    return found


def _present(values: Any) -> NDArray[np.bool_]:
    """Return flags (F,): whether the info is present in each row."""
    mask: NDArray[np.bool_] = np.ma.getmaskarray(values).reshape(len(values), -1)
    return np.logical_not(mask.all(axis=1))


def _texts(column: Any) -> list[str]:
    types = import_extra("pyarrow", "tables").types
    array = column.combine_chunks()
    while types.is_list(array.type) or types.is_fixed_size_list(array.type):
        array = array.flatten()
    texts: list[str] = array.to_pylist()
    return texts
