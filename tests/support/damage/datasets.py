"""Damaged datasets of other tools, read in a process of bounded memory.

    python -m tests.support.damage.datasets FOLDER CASES SEED [FORMAT...]

Writes a small dataset in each form, changes some of the bytes of one of its files, and opens it.
Only errors of `mcaprl.errors` with one line may be raised, and little memory may be used. The last
line of the output is the number of cases and of those that were refused. A case that fails is left
in FOLDER.
"""

from __future__ import annotations

import itertools
import json
import random
import resource
import shutil
import struct
import sys
import traceback
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np

import mcaprl
from mcaprl import Dataset
from mcaprl.errors import McaprlError

_MEMORY_BYTES = 4 << 30
_GROWTH_BYTES = 512 << 20
"""Memory that a damaged file of a few kB may take."""
_SIZES = (0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_JSON: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    0.5,
    1e300,
    10**400,
    2**63,
    "x",
    [],
    {},
    [[[0]]],
    {"a": {}},
)


def dataset() -> Dataset:
    """Return three episodes of 4, 3 and 2 steps; the second one is truncated."""
    rows = np.arange(10, dtype=np.float32)[:, None] * np.ones(2, np.float32)
    return Dataset.from_arrays(
        observations=rows[:9],
        next_observations=rows[1:],
        actions=np.arange(9) % 3,
        rewards=np.arange(9.0),
        terminated=np.isin(np.arange(9), (3, 8)),
        truncated=np.arange(9) == 6,
    )


def write_all(folder: Path) -> dict[str, tuple[str, Path]]:
    """Write the dataset in each form; return the name of the format and the path of each form."""
    import h5py

    data = dataset()
    found: dict[str, tuple[str, Path]] = {}
    for form, name in (
        ("npz", "own.npz"),
        ("hdf5", "own.hdf5"),
        ("d3rlpy", "own.h5"),
        ("minari", "own-v0"),
        ("parquet", "parquet"),
        ("lerobot", "lerobot"),
    ):
        mcaprl.convert(_log(data, folder), folder / name, to=form)
        found[form] = form, folder / name
    flat: dict[str, Any] = {
        "observations": data.observations,
        "actions": data.actions.astype(np.int32),
        "rewards": data.rewards,
        "terminals": data.terminated,
        "episode_terminals": data.terminated | data.truncated,
    }
    np.savez_compressed(folder / "theirs.npz", allow_pickle=False, **flat)
    found["npz of others"] = "npz", folder / "theirs.npz"
    for form, name, more in (
        ("hdf5 of others", "theirs.hdf5", {"infos/names": np.array([b"a"] * 9)}),
        ("d3rlpy 1", "theirs.h5", {"discrete_action": True, "version": "1.0"}),
    ):
        with h5py.File(folder / name, "w") as file:
            for key, values in (flat | more).items():
                is_large = key == "observations"
                file.create_dataset(key, data=values, **({"compression": 4} if is_large else {}))
        found[form] = form.split()[0], folder / name
    with h5py.File(folder / "demos.hdf5", "w") as file:
        for index in range(2):
            group = file.create_group(f"data/demo_{index}")
            group["obs/x"], group["actions"] = data.observations[:4], np.zeros((4, 2))
            group["rewards"], group["dones"] = np.zeros(4), np.array([0, 0, 0, index])
    found["robomimic"] = "hdf5", folder / "demos.hdf5"
    return found


def _log(data: Dataset, folder: Path) -> Path:
    path = folder / "log.mcap"
    data.save(path, overwrite=True)
    return path


def damaged(data: bytes, chance: random.Random) -> bytes:
    """Change some of the bytes of a file."""
    changed = bytearray(data)
    place = chance.randrange(len(changed) + 1)
    match chance.randrange(6):
        case 0:
            for _ in range(chance.choice((1, 3, 20))):
                changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
        case 1:
            return bytes(changed[:place])
        case 2:
            changed[place:place] = changed[place : place + 200]
        case 3:
            del changed[place : place + chance.choice((1, 8, 200))]
        case 4:
            changed[place : place + 8] = struct.pack("<Q", chance.choice(_SIZES))
        case _:
            changed[place : place + 16] = bytes(chance.choice((0, 255)) for _ in range(16))
    return bytes(changed)


def damaged_json(data: bytes, chance: random.Random) -> bytes:
    """Replace one value of a JSON text."""
    found = json.loads(data)
    inner, steps = found, []
    while isinstance(inner, dict | list) and inner:
        keys = list(inner) if isinstance(inner, dict) else range(len(inner))
        steps.append((inner, chance.choice(list(keys))))
        inner = inner[steps[-1][1]]
        if chance.random() < 0.3:
            break
    parent, key = steps[-1]
    parent[key] = chance.choice(_JSON)
    if chance.random() < 0.1:
        return b"[" * 5000 + data
    return json.dumps(found).encode()


def damaged_archive(data: bytes, chance: random.Random) -> bytes:
    """Change the bytes of one array of an .npz file, whose CRCs are then correct."""
    import io
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        chosen = chance.choice(old.namelist())
        for name in old.namelist():
            array = old.read(name)
            if name == chosen:
                # Headers of arrays have 118 bytes or more.
                header = damaged(array[:118], chance) + array[118:]
                array = chance.choice((header, damaged(array, chance)))
            new.writestr(name, array)
    return out.getvalue()


def damage(path: Path, chance: random.Random) -> None:
    """Damage one file of a dataset."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    file = chance.choice(files)
    data = file.read_bytes()
    if file.suffix == ".json" and chance.random() < 0.8:
        data = damaged_json(data, chance)
    elif file.suffix == ".npz" and chance.random() < 0.7:
        data = damaged_archive(data, chance)
    else:
        data = damaged(data, chance)
    file.write_bytes(data)


def is_refused(path: Path, form: str) -> bool:
    """Open a dataset; return whether it was refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        message = ""
        try:
            found = mcaprl.open(path, format=form)
        except McaprlError as error:
            message = str(error)
    if message:
        assert "\n" not in message, message
        return True
    assert len(found) == len(found.rewards) == found.episode_lengths.sum()
    assert len(repr(found.statistics)) > 0
    return False


def peak_bytes() -> int:
    """Return the largest memory of this process so far.

    Memory that is allocated but never written does not count.
    """
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def main(folder: str, cases: str, seed: str, *wanted: str) -> None:
    """Try damaged datasets of each form in turn."""
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, most))
    root = Path(folder)
    forms = write_all(root)
    for form, path in forms.values():
        assert not is_refused(path, form), path
    before, refused, work = peak_bytes(), 0, root / "work"
    names = itertools.cycle([name for name in forms if not wanted or name in wanted])
    for number, name in zip(range(int(cases)), names, strict=False):
        form, source = forms[name]
        path = work / source.name
        shutil.rmtree(work, ignore_errors=True)
        if source.is_dir():
            shutil.copytree(source, path)
        else:
            work.mkdir()
            shutil.copy(source, path)
        damage(path, random.Random(zlib.crc32(f"{seed} {number} {name}".encode())))
        print(f"case {number} of {name}", flush=True)
        try:
            refused += is_refused(path, form)
            grown = peak_bytes() - before
            assert grown < _GROWTH_BYTES, f"memory grew by {grown >> 20} MiB"
        except Exception:
            traceback.print_exc()
            sys.exit(f"case {number} of {name} failed: {path}")
    print(f"{cases} cases, {refused} refused")


if __name__ == "__main__":
    main(*sys.argv[1:])
