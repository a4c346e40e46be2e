"""Damaged and forged datasets of other tools: one clear error, and little memory."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.errors import LogError, McaprlError
from mcaprl.recorder.dataset.format_registry import FORMATS, write_format
from mcaprl.recorder.dataset.formats import columns
from mcaprl.recorder.dataset.formats.parquet import _row_groups
from tests.support.damage.datasets import dataset, write_all

h5py = pytest.importorskip("h5py", reason="needs the extra interop")
pytest.importorskip("pyarrow", reason="needs the extra interop")

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def _usual(rows: int = 2) -> dict[str, Any]:
    return {
        "observations": np.zeros((rows, 3)),
        "actions": np.zeros(rows, np.int64),
        "rewards": np.zeros(rows),
        "terminals": np.arange(rows) == rows - 1,
    }


def _fails(path: Path, message: str, **options: Any) -> None:
    with pytest.raises(McaprlError, match=message) as caught:
        mcaprl.open(path, **options)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (18446744073709551616,), }", "shape"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", "shape"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (7,), }", "another size"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", "Python objects"),
        ("(" * 3000, "not a readable"),
        (f"{{'descr': '<f8', 'x': '{'a' * 20000}'}}", "not a readable"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': (1e400,), }", "not a readable"),
    ],
)
def test_headers_of_npz_files_are_checked(tmp_path: Path, header: str, message: str) -> None:
    path = tmp_path / "odd.npz"
    np.savez(path, **_usual(), allow_pickle=False)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = header.encode()
    members["rewards.npy"] = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
    members["rewards.npy"] += bytes(16)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    _fails(path, rf"odd\.npz.*{message}")


def test_two_arrays_of_an_npz_file_with_the_same_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.npz"
    np.savez(path, **_usual(), allow_pickle=False)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("rewards.npy", archive.read("rewards.npy"))
    _fails(path, "two arrays with the name 'rewards'")


def test_arrays_that_nobody_needs_are_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({2**40},), }}".encode()
    bomb = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    np.savez(path, **_usual(), allow_pickle=False)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("x.npy", bomb)
    with pytest.warns(UserWarning, match="not read: x$"):
        assert len(mcaprl.open(path)) == 2


@pytest.fixture
def small_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "UNPACKED_ALLOWANCE_BYTES", 1 << 20)


@pytest.mark.usefixtures("small_budget")
def test_arrays_that_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    rows = 400_000
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in _usual().items():
            with archive.open(f"{name}.npy", "w") as file:
                is_bomb = name == "observations"
                shape = (rows, 3) if is_bomb else values.shape
                described = np.lib.format.dtype_to_descr(values.dtype)
                header = {"descr": described, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                if not is_bomb:
                    file.write(values.tobytes())
                    continue
                for _ in range(rows // 1000):
                    file.write(bytes(24_000))
                file.write(bytes(24 * (rows % 1000)))
    _fails(path, "observations has shape .* too large for the .* that are stored")


@pytest.mark.usefixtures("small_budget")
def test_hdf5_arrays_that_share_their_storage_count_together(tmp_path: Path) -> None:
    path = tmp_path / "bomb.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in _usual().items():
            file[name] = values
        zeros = np.zeros((1 << 18,), np.uint8)
        big = file.create_dataset("big", data=zeros, compression=9, chunks=zeros.shape)
        for number in range(400):
            file[f"infos/x{number}"] = big
    _fails(path, "too large for the")


@pytest.mark.usefixtures("small_budget")
def test_hdf5_groups_that_contain_themselves_are_refused(tmp_path: Path) -> None:
    for name in ("observations", "infos", "metadata"):
        path = tmp_path / f"{name}.hdf5"
        with h5py.File(path, "w") as file:
            for key, values in _usual().items():
                if key != name:
                    file[key] = values
            file.create_group(name)
            file[f"{name}/again"] = file[name]
        _fails(path, "nested too deeply")
    with h5py.File(path, "w") as file:
        for key, values in _usual().items():
            file[key] = values
        inner = file.create_group("x0")
        for level in range(1, 30):
            group = file.create_group(f"x{level}")
            group["a"] = group["b"] = inner
            inner = group
    _fails(path, "too large for the")


@pytest.mark.parametrize("where", ["external", "virtual", "file"])
def test_hdf5_arrays_in_other_files_are_refused(tmp_path: Path, where: str) -> None:
    path = tmp_path / "odd.hdf5"
    np.zeros(2).tofile(tmp_path / "other.bin")
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["rewards"] = np.zeros(2)
    with h5py.File(path, "w") as file:
        for name, values in _usual().items():
            if name != "rewards":
                file[name] = values
        if where == "external":
            file["rewards"] = h5py.ExternalLink("other.hdf5", "rewards")
        elif where == "file":
            external = [(str(tmp_path / "other.bin"), 0, 16)]
            file.create_dataset("rewards", (2,), np.float64, external=external)
        else:
            layout = h5py.VirtualLayout((2,), np.float64)
            layout[:] = h5py.VirtualSource(tmp_path / "other.hdf5", "rewards", shape=(2,))
            file.create_virtual_dataset("rewards", layout)
    _fails(path, "rewards is stored in another file")


def test_tables_of_parquet_must_agree(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    mcaprl.Dataset.to_parquet(dataset(), tmp_path / "set")

    def changed(file: str, column: str, values: Any) -> None:
        path = tmp_path / "set" / file
        table = parquet.read_table(path)
        number = table.column_names.index(column)
        array = pyarrow.array(values, table.schema.field(column).type)
        parquet.write_table(table.set_column(number, table.field(number), array), path)

    changed("episodes.parquet", "length", [2**62, 2**62, 2])
    _fails(tmp_path / "set", "contain different or reordered steps")
    changed("episodes.parquet", "length", [4, 3, 2])
    changed("transitions.parquet", "terminated", [k in (1, 3, 8) for k in range(9)])
    _fails(tmp_path / "set", "terminated of row 1 is set, but its episode goes on")
    changed("transitions.parquet", "terminated", [k in (3, 8) for k in range(9)])
    changed("transitions.parquet", "behavior_prob", [2.0] + [0.5] * 8)
    _fails(tmp_path / "set", "behavior_prob: row 0 is 2.0")
    changed("transitions.parquet", "behavior_prob", [0.5] * 9)
    changed("transitions.parquet", "log_time_ns", [0, 5, 4, *range(6, 12)])
    _fails(tmp_path / "set", "log_time_ns of episode 0 falls from 5 to 4")


@pytest.mark.usefixtures("small_budget")
def test_parquet_columns_that_unpack_to_too_much_are_refused(tmp_path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    mcaprl.Dataset.to_parquet(dataset(), tmp_path / "set")
    path = tmp_path / "set/transitions.parquet"
    table = parquet.read_table(path)
    column = pyarrow.chunked_array([pyarrow.nulls(4_000_000, pyarrow.int64()).fill_null(0)])
    schema = pyarrow.schema([("episode", pyarrow.int64())], metadata=table.schema.metadata)
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        writer.write_table(pyarrow.Table.from_arrays([column], schema=schema))
    assert path.stat().st_size < 100_000
    _fails(tmp_path / "set", "episode has shape .* too large for the")


@pytest.fixture
def nested_table(tmp_path: Path) -> Path:
    """Write a table with lists, texts, missing values and statistics in two row groups."""
    import pyarrow
    from pyarrow import parquet

    values = {"x": [0.5, None, 2.0], "y": [[1, 2], [], [3]], "z.a": ["a", "b", "a"]}
    more = {"w": [{"u": [True], "v": b"1"}] * 3, "f": pyarrow.array([1.0, 2.0, 3.0], "float32")}
    path = tmp_path / "nested.parquet"
    with parquet.ParquetWriter(path, pyarrow.table({**values, **more}).schema) as writer:
        for _ in range(2):
            writer.write_table(pyarrow.table({**values, **more}))
    return path


def test_sizes_in_the_footer_of_parquet_are_those_of_pyarrow(nested_table: Path) -> None:
    from pyarrow import parquet

    metadata = parquet.ParquetFile(nested_table).metadata
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    expected = [
        (column.path_in_schema, column.num_values, column.total_uncompressed_size)
        for group in groups
        for column in (group.column(number) for number in range(group.num_columns))
    ]
    found = _row_groups(nested_table)
    assert [rows for rows, _ in found] == [3, 3]
    assert expected == [
        (".".join(each.words), each.values, each.stored_bytes)
        for _, columns in found
        for each in columns
    ]


def test_no_damaged_byte_in_the_footer_of_parquet_ends_the_process(nested_table: Path) -> None:
    """PyArrow aborts the process if it is asked for columns with some damaged statistics."""
    code = (
        "import struct, sys\n"
        "from pathlib import Path\n"
        "from mcaprl.errors import LogError\n"
        "from mcaprl.recorder.dataset.formats.parquet import read_table\n"
        "path = Path(sys.argv[1])\n"
        "data, refused = path.read_bytes(), 0\n"
        "start = len(data) - 8 - struct.unpack('<I', data[-8:-4])[0]\n"
        "for place in range(start, len(data)):\n"
        "    for flip in (1, 16, 255):\n"
        "        path.write_bytes(data[:place] + bytes([data[place] ^ flip]) + data[place + 1:])\n"
        "        try:\n"
        "            read_table(path)\n"
        "        except LogError:\n"
        "            refused += 1\n"
        "print(3 * (len(data) - start), refused)\n"
    )
    command = [sys.executable, "-c", code, str(nested_table)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    cases, refused = map(int, done.stdout.split())
    assert cases > 3000
    assert refused > 1000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fps": 10**400}, "damaged LeRobot dataset"),
        ({"fps": 1e12}, "step_duration_ns is 0"),
        ({"fps": 1e-300}, "damaged LeRobot dataset|step_duration_ns"),
        ({"fps": "fast"}, "damaged LeRobot dataset"),
        ({"codebase_version": None}, "version None"),
        ({"features": []}, "damaged LeRobot dataset"),
    ],
)
def test_descriptions_of_lerobot_are_checked(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    _, path = write_all(tmp_path)["lerobot"]
    file = path / "meta/info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    _fails(path, message)
    file.write_text("[" * 100_000)
    _fails(path, "damaged LeRobot dataset", format="lerobot")


def _lerobot_column(path: Path, name: str, values: Any) -> None:
    import pyarrow
    from pyarrow import parquet

    (file,) = (path / "data").glob("*/*.parquet")
    table = parquet.read_table(file)
    number = table.column_names.index(name)
    parquet.write_table(table.set_column(number, name, pyarrow.array(values)), file)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("next.done", [0, 2, *[0] * 7], "next.done .*row 1 is 2"),
        ("next.reward", [0.0, np.nan, *[0.0] * 7], "episode 0: rewards: row 1 is nan"),
        ("action", [0.5, *[0.0] * 8], "action is float64 .*row 0 is 0.5"),
        ("timestamp", [0.0, np.inf, *[0.0] * 7], "timestamp of row 1 is inf"),
        ("timestamp", [0.1, 0.05, 0.2, 0.3, *[0.0] * 5], "log_time_ns falls"),
    ],
)
def test_values_of_lerobot_are_checked(
    tmp_path: Path, name: str, values: Any, message: str
) -> None:
    _, path = write_all(tmp_path)["lerobot"]
    _lerobot_column(path, name, values)
    _fails(path, message)


def test_metadata_with_a_step_of_no_time_is_refused(tmp_path: Path) -> None:
    data = dataset()
    for step_duration_ns in ("0", "-1", str(2**62)):
        metadata = data.metadata | {"step_duration_ns": step_duration_ns}
        forged = mcaprl.Dataset(data._transitions, type(data._description).from_strings(metadata))
        path = tmp_path / f"set{step_duration_ns}-v0"
        write_format(forged, path, FORMATS["parquet"])
        _fails(path, "step_duration_ns", format="parquet")


def _timed() -> mcaprl.Dataset:
    """Return the dataset with probabilities, and with times."""
    data = dataset().with_behavior_probs(np.full(9, 0.5))
    metadata = {name: text for name, text in data.metadata.items() if name != "times"}
    return mcaprl.Dataset(data._transitions, type(data._description).from_strings(metadata))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("behavior_probs", lambda values: values * 0 - 1, "behavior_probs: row 0 is -1.0"),
        ("behavior_probs", lambda values: values * 0 + np.inf, "behavior_probs: row 0 is inf"),
        ("log_time_ns", lambda values: values[::-1], "log_time_ns falls from"),
        ("terminations", lambda values: values * 0.5, "terminations are not flags: row 3 is 0.5"),
        ("terminations", lambda values: values[1:], "terminations"),
        ("episode_lengths", lambda values: values * [1, 1, -1], "episode_lengths"),
        ("final_observations", lambda values: values[1:], "final_observations does not have"),
        ("final_observations", lambda values: values[:, 1:], "final_observations does not have"),
        ("rewards", lambda values: values.astype("V8"), "rewards has dtype"),
        ("rewards", lambda values: values.astype(complex), "rewards has dtype complex128"),
    ],
)
def test_values_of_an_own_archive_are_checked(
    tmp_path: Path, name: str, change: Any, message: str
) -> None:
    path = tmp_path / "own.npz"
    _timed().to_npz(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **arrays | {name: change(arrays[name])}, allow_pickle=False)
    _fails(path, message)


FLAT: list[tuple[str, Any, str]] = [
    ("rewards", np.array([b"1", b"2"]), "rewards has dtype"),
    ("rewards", np.array([0, np.nan]), "rewards: row 1 is nan, which is not finite"),
    ("rewards", np.array([-np.inf, 0]), "rewards: row 0 is -inf, which is not finite"),
    ("rewards", np.array([1j, 0]), "rewards has dtype complex128|compound type"),
    ("rewards", np.zeros((2, 2)), r"rewards has shape \(2, 2\)"),
    ("rewards", np.float64(3), r"rewards has shape \(\)"),
    ("actions", np.array([[0.0], [np.inf]]), "actions: row 1 is inf, which is not finite"),
    ("actions", np.array([0, 2**63], np.uint64), "action 9223372036854775808 in row 1 is too"),
    ("actions", np.array([0, -2]), "action -2 in row 1 is negative"),
    ("behavior_probs", np.array([0.5, 1.5]), r"behavior_probs: row 1 is 1.5.*\(0, 1\]"),
    ("behavior_probs", np.array([0.5]), "behavior_probs has shape"),
    ("observations", np.array([[b"a"], [b"b"]]), "observations has dtype"),
    ("next_observations", np.zeros((2, 4)), "does not have the keys and shapes"),
]


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@pytest.mark.parametrize(("name", "values", "message"), FLAT)
def test_impossible_values_of_flat_arrays_are_refused_by_row(
    tmp_path: Path, suffix: str, name: str, values: Any, message: str
) -> None:
    arrays, path = _usual() | {name: values}, tmp_path / f"odd{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays, allow_pickle=False)
    else:
        with h5py.File(path, "w") as file:
            for key, array in arrays.items():
                file[key] = array
    _fails(path, message)


def test_rows_are_counted_in_the_file(tmp_path: Path) -> None:
    arrays = _usual(6) | {"terminals": np.array([0, 0, 1, 0, 0, 1])}
    arrays["rewards"] = np.array([0, 0, 0, 0, np.nan, 0])
    np.savez(tmp_path / "odd.npz", **arrays, allow_pickle=False)
    _fails(tmp_path / "odd.npz", "rewards: row 4 is nan")


def test_a_named_pipe_is_not_opened(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe.hdf5")
    with pytest.raises(LogError):
        mcaprl.open(tmp_path / "pipe.hdf5", format="npz")
    for form in FORMATS.values():
        assert not form.matches(tmp_path / "pipe.hdf5")
