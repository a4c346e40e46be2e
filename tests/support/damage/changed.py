"""Changes of the content of files of all kinds, with a random generator.

`changed(data, chance)` recognizes the content: JSON, text, zip and npz archives, .npy arrays,
safetensors, MCAP, SQLite, HDF5 and Parquet. Half of the changes keep the form of the file and put a
hostile value, a wrong type or a missing part in it, so that they are not refused at once.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import re
import sqlite3
import struct
import zipfile
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

import numpy as np

_LONG = "long" * 5000
NUMBERS = (
    "0 -1 1 2 0.5 -0.0 255 256 65536 2147483648 4294967296 9223372036854775807 9223372036854775808"
    f" 18446744073709551616 1e9 1e300 1e400 -1e300 1e-320 {'9' * 400} {'9' * 5000}"
).split()
VALUES = (
    *NUMBERS,
    *NUMBERS,
    *("NaN", "Infinity", "-Infinity", "null", "true", "false", "[]", "{}", "[[[0]]]", '{"a": {}}'),
    *('""', '"x"', '"0"', '"-1"', '"nan"', '"../../etc"', '"/dev/stdin"', '"\\u0000"', '"\\ud800"'),
    *(f'"{_LONG}"', '"Ünïcode 𝄞\\n"', "[1, [2]]", "[null, 1]", '[1, "a"]', '{"": 1}'),
    f"{'[' * 700}{']' * 700}",
    f"{'[' * 20000}{']' * 20000}",
    f"[{', '.join('0' for _ in range(3000))}]",
)
"""Values of JSON, some of which only Python's parser accepts."""
WORDS = (
    *VALUES,
    *(".inf", "-.inf", ".nan", "~", "yes", "2024-13-45", "2024-01-01", "2024-01-01 10:00:00Z"),
    *("!!int abc", "!!float abc", "!!binary x", "!!timestamp x", "!!bool x", "!!set {a, b}"),
    *("!!python/object/apply:os.getpid []", "!!omap [a: 1]", "&a [*a]", "*missing", "&b {<<: *b}"),
    *("{<<: 5}", "{? [a]: b}", "{a: 1, a: 2}", "0x10", "0o17", "1_000", "1:30:00", "- -", "'", '"'),
    *(": ", "|", ">", "%", "@", "`", "\t", "\0", "\x1b[31m", "\u2028", "\r", "#", "---", "..."),
    *("()", "(" * 300, f"x{'.b' * 1900}", f"x{'()' * 1900}", "next(next(x))", "x[0]", "x[999999]"),
    *("x[-1]", "x[::0]", "1 if x else", "lambda: 0", "not " * 900, "1" + "+1" * 3000, "2 ** 99999"),
    *("9 ** 9 ** 9 ** 9", "1 / 0", "x % 0", "x // 0", "-" * 2000 + "1", "{x}", "*x", "x := 1"),
    *("1 << 99", "'a' * 9", "b''", "1j", "...", "__class__", "x < y < z", "x @ y", "[x] * 9999999"),
)
"""Texts that replace a word of a text."""
_MARK = "\x01mark\x01"
_WORD = re.compile(r'"(?:[^"\\\n]|\\.)*"|[^\s"\[\]{},:()]+')
_PRINTABLE = re.compile(rb"[ -~]{3,}")
_SIZES = (0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)

Change = Callable[[bytes, random.Random], bytes]


def changed(data: bytes, chance: random.Random) -> bytes:
    """Return the content of a file with one change, or a few."""
    # Libraries that change a form may crash or take any memory if the bytes are damaged.
    are_bytes = sorted(chance.random() > 0.75 for _ in range(chance.choice((1, 1, 1, 2, 3))))
    for is_bytes in are_bytes:
        try:
            data = (changed_bytes if is_bytes else _change_of(data))(data, chance)
        # The first change may have removed what the second one changes.
        except Exception:
            data = changed_bytes(data, chance)
    return data


def _change_of(data: bytes) -> Change:
    for start, change in (
        (b"\x89MCAP", changed_mcap),
        (b"PK\3\4", changed_archive),
        (b"\x93NUMPY", changed_array),
        (b"SQLite format 3", changed_database),
        (b"\x89HDF", changed_hdf5),
        (b"PAR1", changed_parquet),
    ):
        if data.startswith(start):
            return change
    if data[8:9] == b"{" and struct.unpack_from("<Q", data)[0] < len(data):
        return changed_tensors
    if data[:1] in (b"{", b"["):
        return changed_json
    return changed_text if _is_text(data) else changed_bytes


def _is_text(data: bytes) -> bool:
    with suppress(UnicodeDecodeError):
        return "\0" not in data.decode()
    return False


def changed_bytes(data: bytes, chance: random.Random) -> bytes:
    """Flip, insert, delete or overwrite bytes, or truncate the data."""
    new = bytearray(data)
    place = chance.randrange(len(new) + 1)
    match chance.randrange(7):
        case 0:
            for _ in range(chance.choice((1, 3, 20))):
                if new:
                    new[chance.randrange(len(new))] ^= 1 << chance.randrange(8)
        case 1:
            return bytes(new[:place])
        case 2:
            new[place:place] = new[place : place + 200]
        case 3:
            del new[place : place + chance.choice((1, 8, 200))]
        case 4:
            new[place : place + 8] = struct.pack("<Q", chance.choice(_SIZES))
        case 5:
            # The lengths of texts are often stored beside them, so they stay as they are.
            found = list(_PRINTABLE.finditer(data))
            for match in found and [chance.choice(found)]:
                texts = ("[" * 99, "../" * 9, "\xff" * 9, "%s" * 9, "\0" * 9)
                text = chance.choice((*NUMBERS, *texts))
                start = chance.randrange(match.start(), match.end())
                end = min(match.end(), start + len(text))
                new[start:end] = text.encode("latin-1")[: end - start]
        case _:
            new[place : place + 16] = bytes(chance.choice((0, 255)) for _ in range(16))
    return bytes(new)


def changed_text(data: bytes, chance: random.Random) -> bytes:
    """Replace a word, or delete, repeat or exchange words or lines."""
    text = data.decode()
    words, lines = list(_WORD.finditer(text)), text.splitlines(keepends=True)
    kind = chance.randrange(10)
    if kind < 7 and words:
        one, other = chance.choice(words), chance.choice(words)
        new = chance.choice(WORDS) if kind < 5 else other.group() if kind < 6 else ""
        return (text[: one.start()] + new + text[one.end() :]).encode("utf-8", "surrogatepass")
    if not lines:
        return chance.choice(WORDS).encode()
    place = chance.randrange(len(lines))
    if kind == 7:
        del lines[place]
    elif kind == 8:
        lines.insert(chance.randrange(len(lines) + 1), lines[place])
    else:
        lines[place] = " " * chance.randrange(8) + lines[place].lstrip()
    return "".join(lines).encode()


def changed_json(data: bytes, chance: random.Random) -> bytes:
    """Replace, remove, repeat or wrap a value of a JSON text."""
    found = json.loads(data)
    root: dict[str, Any] = {"": found}
    parent: Any = root
    key, inner = "", found
    while isinstance(inner, dict | list) and inner and chance.random() < 0.85:
        parent = inner
        key = chance.choice(list(inner) if isinstance(inner, dict) else range(len(inner)))
        inner = inner[key]
    value = chance.choice(VALUES)
    kind = chance.randrange(10)
    if kind == 0 and parent is not root:
        del parent[key]
    elif kind == 1 and isinstance(parent, dict):
        parent[_MARK + key] = inner
    elif kind == 2:
        value, parent[key] = json.dumps([inner, inner]), _MARK
    elif kind == 3 and isinstance(parent, dict):
        parent[chance.choice(["", "x", "a.b", _LONG, "name", "type"])] = _MARK
    else:
        parent[key] = _MARK
    text = json.dumps(root[""])
    # A marked key becomes a key that is there twice.
    marked = json.dumps(_MARK)
    return text.replace(marked, value).replace(marked[:-1], '"').encode()


def changed_archive(data: bytes, chance: random.Random) -> bytes:
    """Change, remove, repeat, rename or pickle one member of a zip file; CRCs stay correct."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        chosen, kind = chance.choice(old.namelist()), chance.randrange(12)
        for name in old.namelist():
            content = old.read(name)
            if name == chosen:
                if kind == 0:
                    continue
                if kind == 1:
                    name = chance.choice(("x", "../x", "/x", name + ".npy", "data.pkl"))
                elif kind == 2:
                    content = _executed()
                else:
                    content = changed(content, chance)
            new.writestr(name, content)
    return out.getvalue()


class _Executed:
    """Object that ends the process when it is unpickled."""

    def __reduce__(self) -> Any:
        return os._exit, (77,)


def _executed() -> bytes:
    return pickle.dumps(_Executed(), 2)


def _arrays(chance: random.Random, rows: int) -> np.ndarray[Any, Any]:
    """Return an array of a type or shape that is seldom expected."""
    rows = chance.choice((rows, rows, rows, rows, 0, 1, rows + 1))
    values: Any = chance.choice(
        (np.nan, np.inf, -1, 0, 2, 0.5, 1e300, 2**62, 2**63, True, "text", b"bytes", 1j, "2024")
    )
    shape = chance.choice(((), (rows,), (rows,), (rows,), (rows, 1), (rows, 2), (rows, 0, 3)))
    array = np.full(shape, values)
    with suppress(ValueError, TypeError, OverflowError):
        kinds = (None, "f2", "f8", "i1", "u8", "?", ">f4", "S3", "U3", "M8[ns]", "m8[s]", "V4")
        kind = chance.choice(kinds)
        array = array if kind is None else array.astype(kind)
    return array


def changed_array(data: bytes, chance: random.Random) -> bytes:
    """Change the header of a .npy file, or replace the array."""
    if chance.random() < 0.4:
        rows = len(np.atleast_1d(np.load(io.BytesIO(data), allow_pickle=False)))
        out = io.BytesIO()
        np.save(out, _arrays(chance, rows), allow_pickle=False)
        return out.getvalue()
    (length,) = struct.unpack_from("<H", data, 8)
    header = changed_text(data[10 : 10 + length], chance)[:65000]
    if chance.random() < 0.2:
        header = header.replace(b"<", b"|").replace(b"f", b"O")
    return data[:8] + struct.pack("<H", len(header)) + header + data[10 + length :]


def changed_tensors(data: bytes, chance: random.Random) -> bytes:
    """Change the header of a safetensors file, also the JSON texts in it, or the values."""
    (length,) = struct.unpack_from("<Q", data)
    header, values = json.loads(data[8 : 8 + length]), data[8 + length :]
    kind = chance.randrange(4)
    if kind == 0:
        value = chance.choice((np.nan, np.inf, -np.inf, 1e30, 0, -1))
        values = np.full(len(values) // 4 + 1, value, np.float32).tobytes()[: len(values)]
    elif kind == 1 and header.get("__metadata__"):
        name = chance.choice(list(header["__metadata__"]))
        text = changed_json(header["__metadata__"][name].encode(), chance)
        header["__metadata__"][name] = text.decode("utf-8", "replace")
    text = json.dumps(header).encode()
    if kind > 1:
        text = changed_json(text, chance)
    return struct.pack("<Q", len(text)) + text + values


def changed_mcap(data: bytes, chance: random.Random) -> bytes:
    """Change a field of a schema, channel, message, attachment or metadata record.

    The file is written again, so its indexes and CRCs are correct.
    """
    from mcap.reader import make_reader

    reader = make_reader(io.BytesIO(data))
    found: list[tuple[Any, Any, Any]] = list(reader.iter_messages(log_time_order=False))
    records = list(reader.iter_metadata())
    schemas = list({each[0].id: each[0] for each in found if each[0] is not None}.values())
    channels = list({each[1].id: each[1] for each in found}.values())
    messages = [each[2] for each in found]
    changeable: list[Any] = [messages, channels, schemas, records]
    record = chance.choice(chance.choice([each for each in changeable if each]))
    name = chance.choice([name for name in vars(record) if name not in ("id", "channel_id")])
    setattr(record, name, _changed_field(getattr(record, name), chance))
    dropped = chance.choice(messages) if chance.random() < 0.1 else None
    return _written(reader.get_header().profile, found, records, dropped)


def _changed_field(value: Any, chance: random.Random) -> Any:
    match value:
        case int():
            return chance.choice((0, 1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, value + 1, value - 1))
        case bytes():
            return changed(value, chance)
        case str():
            return changed(value.encode(), chance).decode("utf-8", "replace")
        case dict() if value:
            name = chance.choice(list(value))
            new = changed(value[name].encode(), chance).decode("utf-8", "replace")
            return {key: old for key, old in value.items() if key != name} | (
                {} if chance.random() < 0.2 else {name: new}
            )
    return value


def _written(profile: str, found: list[tuple[Any, Any, Any]], records: Any, dropped: Any) -> bytes:
    from mcap.writer import CompressionType, Writer

    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE)
    writer.start(profile=profile)
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    for record in records:
        writer.add_metadata(record.name, record.metadata)
    for schema, channel, message in found:
        if schema is not None and schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            number = schemas.get(channel.schema_id, 0)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        if message is not dropped:
            writer.add_message(
                channels[channel.id],
                max(message.log_time, 0),
                message.data,
                max(message.publish_time, 0),
                message.sequence % 2**32,
            )
    writer.finish()
    return out.getvalue()


def changed_database(data: bytes, chance: random.Random) -> bytes:
    """Set the values of a column of an SQLite database in some rows, or drop a table."""
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        query = "SELECT name FROM sqlite_master WHERE type = 'table'"
        table = chance.choice([name for (name,) in base.execute(query)])
        if chance.random() < 0.1:
            base.execute(f"DROP TABLE {table}")
        else:
            columns = [row[1] for row in base.execute(f"PRAGMA table_info({table})")]
            column = chance.choice(columns)
            old = base.execute(f"SELECT {column} FROM {table}").fetchone()
            values: list[Any] = [None, 0, -1, 2**62, 1e300, "text", "", b"\xff\0", b"", _LONG]
            match old:
                case (str(text),):
                    values += [changed_text(text.encode(), chance).decode("utf-8", "replace")] * 9
                case (bytes(blob),):
                    values += [changed_bytes(blob, chance)] * 9
            base.execute(
                f"UPDATE {table} SET {column} = ? WHERE rowid % ? = 0",
                (chance.choice(values), chance.choice((1, 2, 3))),
            )
        base.commit()
        return base.serialize()


def changed_hdf5(data: bytes, chance: random.Random) -> bytes:
    """Replace, remove, rename or link a dataset, group or attribute of an HDF5 file."""
    import h5py

    out = io.BytesIO(data)
    with h5py.File(out, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        node = file[chance.choice([*names, "/"])]
        attributes = list(node.attrs)
        if attributes and chance.random() < 0.5:
            _change_attribute(node, chance.choice(attributes), chance)
            return _closed(file, out)
        name = node.name if node.name != "/" else f"/{names[0]}"
        rows = len(node) if isinstance(node, h5py.Dataset) and node.shape else 3
        kind = chance.randrange(8)
        if kind == 0:
            file.move(name, chance.choice(("/x", "/data", "/demo_x", name + "2", "/episode_9")))
            return _closed(file, out)
        del file[name]
        if kind < 5:
            file[name] = _storable(_arrays(chance, rows))
        elif kind == 5:
            file[name] = chance.choice(
                (h5py.SoftLink("/"), h5py.SoftLink(name), h5py.ExternalLink("/etc/passwd", "/"))
            )
        elif kind == 6:
            file[name] = file["/"]
        return _closed(file, out)


def _storable(array: np.ndarray[Any, Any]) -> Any:
    """Return an array of a type that HDF5 has."""
    return array.astype("S") if array.dtype.kind in "UMm" else array


def _change_attribute(node: Any, name: str, chance: random.Random) -> None:
    value = node.attrs[name]
    if isinstance(value, bytes | str) and chance.random() < 0.6:
        text = value if isinstance(value, bytes) else value.encode()
        node.attrs[name] = changed(text, chance).replace(b"\0", b"")[:60000]
    elif chance.random() < 0.2:
        del node.attrs[name]
    else:
        node.attrs[name] = _storable(_arrays(chance, 3))


def _closed(file: Any, out: io.BytesIO) -> bytes:
    file.close()
    return out.getvalue()


def changed_parquet(data: bytes, chance: random.Random) -> bytes:
    """Replace or remove a column of a Parquet file, or change its metadata."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    table = parquet.read_table(arrow.BufferReader(data))
    metadata = dict(table.schema.metadata or {})
    place, kind = chance.randrange(len(table.column_names)), chance.randrange(8)
    name = table.column_names[place]
    if kind < 2 and metadata:
        key = chance.choice(list(metadata))
        metadata[key] = changed(metadata[key], chance)
    elif kind == 2:
        table = table.drop_columns([name])
    elif kind == 3:
        table = table.rename_columns({name: "x"})
    elif kind == 4:
        table = table.take(chance.choices(range(max(len(table), 1)), k=len(table)))
    else:
        table = table.set_column(place, name, arrow.array(_column(chance, len(table))))
    out = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata(metadata), out)
    return out.getvalue()


def _column(chance: random.Random, rows: int) -> list[Any]:
    value: Any = chance.choice(
        (
            None,
            0,
            -1,
            2**62,
            0.5,
            float("nan"),
            float("inf"),
            True,
            "text",
            b"bytes",
            [1, 2],
            [[0.5]],
        )
    )
    column = [value] * rows
    if chance.random() < 0.3 and rows:
        column[chance.randrange(rows)] = None
    return column
