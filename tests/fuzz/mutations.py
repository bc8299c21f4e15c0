"""Damage for files: of bytes, and of what the bytes mean, so that checksums and parsers do not stop it early."""

from __future__ import annotations

import copy
import json
import pickle
import random
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

#: Values that a field may hold after it has been damaged.
ODD_VALUES = (
    float("nan"), float("inf"), -float("inf"), 0, -1, 1, 2**31, -(2**31) - 1, 2**63, 1e308, -1e9, 1e-300,
    "", "x", "\0", "9" * 40, None, True, [], {}, [[]], [None], {"x": None},
)  # fmt: skip
_SQL_VALUES = (None, -1, 0, 2**62, 1e308, float("inf"), "", "x", b"", b"\x00" * 8, b"GP\x00\x01", "green")


def bytes_damaged(data: bytes, rng: random.Random) -> bytes:
    """Flipped bits, a cut, an overwritten, repeated or removed stretch, a huge number, or nothing at all."""
    if not data:
        return b"\0"
    place = rng.randrange(len(data))
    span = min(len(data) - place, rng.choice((1, 4, 16, 256)))
    kind = rng.randrange(8)
    if kind == 0:
        return data[:place]
    if kind == 1:
        return data[:place] + rng.randbytes(span) + data[place + span :]
    if kind == 2:
        return data[:place] + data[place + span :]
    if kind == 3:
        return data[: place + span] * 2 + data[place:]
    if kind == 4:
        return data[:place] + rng.choice((b"\xff", b"\x7f", b"\x00")) * span + data[place + span :]
    if kind == 5 and rng.random() < 0.2:
        return b""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def raw(path: Path, rng: random.Random) -> None:
    """Damage the bytes of a file."""
    path.write_bytes(bytes_damaged(path.read_bytes(), rng))


def tfrecord(path: Path, rng: random.Random) -> None:
    """Damage the payload of the first record and give it the right checksums."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<Q", data)
    payload, rest = bytes_damaged(data[12 : 12 + length], rng), data[16 + length :]
    head = struct.pack("<Q", len(payload))
    path.write_bytes(head + _masked(head) + payload + _masked(payload) + rest)


def _masked(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def _spots(tree: Any, found: list[tuple[Any, Any]], rng: random.Random) -> None:
    """Containers and keys of a tree; of long lists a few items, so that every level is hit about equally often."""
    if isinstance(tree, dict):
        items: Any = list(tree.items())
    elif isinstance(tree, list):
        rows = range(len(tree)) if len(tree) < 6 else rng.sample(range(len(tree)), 5)
        items = [(row, tree[row]) for row in rows]
    else:
        return
    for key, value in items:
        found.append((tree, key))
        _spots(value, found, rng)


def tree_damaged(tree: Any, rng: random.Random) -> Any:
    """Replace, remove, or swap parts of nested dictionaries, lists and arrays."""
    for _ in range(rng.choice((1, 1, 1, 3, 8))):
        spots: list[tuple[Any, Any]] = []
        _spots(tree, spots, rng)
        if not spots:
            return rng.choice(ODD_VALUES)
        where, key = rng.choice(spots)
        action = rng.randrange(6)
        if action == 0:
            del where[key]
        elif action == 1:
            other, name = rng.choice(spots)
            if name in other if isinstance(other, dict) else name < len(other):
                where[key] = copy.deepcopy(other[name])
        elif isinstance(where[key], np.ndarray):
            where[key] = _array_damaged(where[key], rng)
        else:
            where[key] = copy.deepcopy(rng.choice(ODD_VALUES))
    return tree


def _array_damaged(array: np.ndarray, rng: random.Random) -> Any:
    kind = rng.randrange(6)
    if kind == 0 and array.size:
        out = array.astype(np.float64) if array.dtype.kind in "fiub" else array.astype(object)
        out.reshape(-1)[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, -1e30, 1e300))
        return out
    if kind == 1:
        return (
            array[..., : rng.randrange(max(array.shape[-1] if array.ndim else 1, 1))] if array.ndim else None
        )
    if kind == 2:
        return array[: rng.randrange(len(array))] if array.ndim and len(array) else None
    if kind == 3:
        return array.astype(str) if rng.random() < 0.5 else array.astype(object)
    if kind == 4:
        return np.zeros(rng.choice(((0,), (3,), (2, 2), (1, 91, 3, 1))))
    return rng.choice(ODD_VALUES)


def json_tree(path: Path, rng: random.Random) -> None:
    """Damage the content of a JSON file."""
    path.write_text(json.dumps(tree_damaged(json.loads(path.read_text()), rng)))


def pickle_tree(path: Path, rng: random.Random) -> None:
    """Damage the content of a pickle."""
    path.write_bytes(pickle.dumps(tree_damaged(pickle.loads(path.read_bytes()), rng)))


def sqlite_cells(path: Path, rng: random.Random) -> None:
    """Damage cells, columns or tables of a SQLite file."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=MEMORY")
        tables = [
            name
            for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            if not name.startswith(("sqlite_", "rtree_"))
        ]
        for _ in range(rng.choice((1, 1, 2, 5))):
            table = rng.choice(tables)
            columns = [row[1] for row in connection.execute(f'PRAGMA table_info("{table}")')]
            rows = [row for (row,) in connection.execute(f'SELECT rowid FROM "{table}"')]
            if not columns:
                continue
            column = rng.choice(columns)
            kind = rng.randrange(8)
            try:
                if kind == 0:
                    connection.execute(f'DELETE FROM "{table}"')
                elif kind == 1 and rows:
                    connection.execute(f'DELETE FROM "{table}" WHERE rowid = ?', (rng.choice(rows),))
                elif kind == 2:
                    connection.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO odd')
                elif kind == 3:
                    connection.execute(f'UPDATE "{table}" SET "{column}" = ?', (rng.choice(_SQL_VALUES),))
                elif rows:
                    connection.execute(
                        f'UPDATE "{table}" SET "{column}" = ? WHERE rowid = ?',
                        (rng.choice(_SQL_VALUES), rng.choice(rows)),
                    )
            except sqlite3.Error:  # a constraint of the sample; another damage is as good
                continue


def arrow_columns(path: Path, rng: random.Random) -> None:
    """Damage columns of a parquet or feather file."""
    import pyarrow as pa
    import pyarrow.feather
    import pyarrow.parquet

    parquet = path.suffix == ".parquet"
    table = pa.parquet.read_table(path) if parquet else pa.feather.read_table(path)
    columns = table.to_pydict()
    for _ in range(rng.choice((1, 1, 3))):
        name = rng.choice(list(columns))
        values = columns[name]
        kind = rng.randrange(6)
        if kind == 0 and len(columns) > 1:
            del columns[name]
        elif kind == 1:
            columns[name] = [None] * len(values)
        elif kind == 2:
            columns[name] = [str(value) for value in values]
        elif kind == 3:
            columns = {key: column[: rng.choice((0, 1, 5))] for key, column in columns.items()}
        elif values:
            odd = [value for value in ODD_VALUES if isinstance(value, type(values[0]))] or [None]
            columns[name] = list(values)
            for _ in range(rng.choice((1, 5))):
                columns[name][rng.randrange(len(values))] = rng.choice([*odd, None])
    try:
        damaged = pa.table(columns)
    except (pa.ArrowException, OverflowError, TypeError, ValueError):
        raw(path, rng)
        return
    write: Callable[..., None] = pa.parquet.write_table if parquet else pa.feather.write_feather
    write(damaged, path)
