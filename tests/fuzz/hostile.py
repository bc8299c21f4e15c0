"""Hostile payloads at every place where drivax reads a file: none runs, hangs, or exhausts memory.

    python -m fuzz.hostile --places set,run --out summary.json       (from the folder tests)

A payload replaces one file of a sample. Each reading has 30 s and 2 GB beyond what the process has before; it must end
in one line, or read the file as data. "Out of memory" is no such line. Exit status 1 when one does not. Files of
drivax are read with ``--edited``, because their seals would refuse a payload before its reader sees it.
"""

from __future__ import annotations

import argparse
import importlib
import io
import json
import os
import pickle
import shutil
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from drivax.datasets.conversion import Conversion, convert_file
from drivax.datasets.formats import READERS, detect
from drivax.datasets.reader import BadRecord
from drivax.errors import DrivaxError
from drivax.reading import MOST_TEXT
from drivax.seal import allow_edited
from fuzz import own_files
from fuzz.limits import attempt, complaint, lift_memory, limit_memory

#: Created by payloads that run.
CANARY = Path(tempfile.gettempdir()) / f"drivax-canary-{os.getpid()}"


class Runs:
    """An object whose pickle creates :data:`CANARY` when it is loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (CANARY,)


def npy(descr: str, shape: str, data: bytes = b"", version: bytes = b"\1\0") -> bytes:
    """A ``.npy`` file with any header."""
    return npy_header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}", data, version)


def npy_header(text: str, data: bytes = b"", version: bytes = b"\1\0") -> bytes:
    """A ``.npy`` file with any text as its header."""
    head = text.encode("latin1") + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H" if version == b"\1\0" else "<I", len(head)) + head + data


def archive(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED, twice: bool = False) -> bytes:
    """A zip archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as out:
        for name, data in members.items():
            for _ in range(1 + twice):
                out.writestr(name, data)
    return stream.getvalue()


def patched(data: bytes, old: bytes, offset: int, new: bytes) -> bytes:
    """Bytes with others at an offset from every occurrence of a mark."""
    out, place = bytearray(data), data.find(old)
    while place >= 0:
        out[place + offset : place + offset + len(new)] = new
        place = data.find(old, place + 1)
    return bytes(out)


def _lying(data: bytes, times: int) -> bytes:
    """An archive whose ``ego.npy`` unpacks to repeated data, and states 100 bytes."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = deflate.compress(data) + deflate.flush(zlib.Z_FULL_FLUSH)
    members = archive({"ego.npy": block * times + b"\3\0"}, zipfile.ZIP_STORED)
    deflated = patched(patched(members, b"PK\1\2", 10, b"\x08"), b"PK\3\4", 8, b"\x08")
    return patched(deflated, b"PK\1\2", 24, struct.pack("<I", 100))


def framed(payload: bytes, length: int | None = None) -> bytes:
    """A TFRecord with right checksums, also of a wrong length."""
    head = struct.pack("<Q", len(payload) if length is None else length)
    return head + _masked(head) + payload + _masked(payload)


def _masked(data: bytes) -> bytes:
    crc = google_crc32c.value(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def _laughs(words: int = 9) -> str:
    names = "abcdefghi"
    rows = [f"a: &a [{','.join(['x'] * words)}]"]
    rows += [f"{n}: &{n} [{','.join([f'*{before}'] * words)}]" for before, n in pairwise(names)]
    return "\n".join(rows)


def _shared(depth: int) -> bytes:
    """A list of two references to a list of two references, and so on."""
    lists = b"".join(b"](h%ch%ceq%c" % (row, row, row + 1) for row in range(depth))
    return b"\x80\x02](K\x01K\x02eq\x00" + lists + b"."


def _colliding(keys: int) -> bytes:
    """A dictionary whose integer keys have one hash."""
    numbers = ((number * (2**61 - 1)).to_bytes(11, "little", signed=True) for number in range(1, keys))
    return b"\x80\x02}(" + b"".join(b"\x8a\x0b" + number + b"N" for number in numbers) + b"u."


def payloads() -> Iterator[tuple[str, bytes | Callable[[Path], None]]]:
    """Names and contents of the hostile files, or what makes them."""
    zeros = bytes(64 << 20)
    bomb = archive(
        {"ego.npy": npy("'|u1'", f"({len(zeros)},)", zeros), "header.npy": b"", "scenario_id.npy": b""}
    )
    small = archive(
        {
            "header.npy": npy("'<U2'", "()", b"{\0\0\0}\0\0\0"),
            "scenario_id.npy": npy("'<f8'", "(1,)", bytes(8)),
        }
    )
    deep = 200_000
    yield from {
        "empty": b"",
        "zeros": bytes(1 << 20),
        "noise": np.random.default_rng(0).bytes(1 << 16),
        "not utf-8": b"\xff\xfe\xfd" * 99,
        "utf-16": "{}".encode("utf-16"),
        "nul text": b"a\0b\n" * 99,
        "escapes": b"\x1b]0;owned\x07\x1b[2J: \x1b[31m\n",
        "formula": b"=cmd|' /C calc'!A0,@x,+1,-1\n",
        "gzip bomb": zlib.compress(zeros, 9, 31),
        "zlib bomb": zlib.compress(zeros, 9),
        "zip bomb": bomb,
        "zip with lying size": _lying(zeros, 64),
        "zip of 4 GB": patched(bomb, b"PK\1\2", 24, struct.pack("<I", 2**32 - 2)),
        "zip encrypted": patched(patched(small, b"PK\1\2", 8, b"\1"), b"PK\3\4", 6, b"\1"),
        "zip of an unknown method": patched(patched(small, b"PK\1\2", 10, b"\x63"), b"PK\3\4", 8, b"\x63"),
        "zip lzma": archive({"ego.npy": zeros}, zipfile.ZIP_LZMA),
        "zip bzip2": archive({"ego.npy": zeros}, zipfile.ZIP_BZIP2),
        "zip of paths": archive({"../../evil.npy": npy("'<f8'", "(1,)", bytes(8)), "/tmp/evil.npy": b"x"}),
        "zip of duplicates": archive({"ego.npy": npy("'<f8'", "(1,)", bytes(8))}, twice=True),
        "zip of many": archive({f"{number}.npy": b"" for number in range(30_000)}, zipfile.ZIP_STORED),
        "zip directory": patched(small, b"PK\5\6", 12, struct.pack("<II", 2**31, 2**31)),
        "zip of objects": archive({"header.npy": npy("'|O'", "(1,)", pickle.dumps([Runs()]))}),
        "zip of a huge shape": archive({"header.npy": npy("'<f8'", f"({10**15},)")}),
        "zip of a negative shape": archive({"header.npy": npy("'<f8'", "(-1, -8)", bytes(64))}),
        "npy objects": npy("'|O'", "(1,)", pickle.dumps([Runs()])),
        "npy huge": npy("'<f8'", f"({10**15},)"),
        "npy negative": npy("'<f8'", "(-2, -4)", bytes(64)),
        "npy overflow": npy("'<f8'", f"({2**62}, 4)", bytes(64)),
        "npy zero": npy("'<U0'", f"({10**9},)"),
        "npy empty axis": npy("'<f8'", f"(0, {10**17})"),
        "npy text": npy("'<U900000000'", "(1,)"),
        "npy fields": npy(f"[('a', '<f8', ({10**12},))]", "(1,)"),
        "npy code": npy_header(f"__import__('pathlib').Path({str(CANARY)!r}).touch()"),
        "npy brackets": npy_header("(" * 60_000),
        "npy signs": npy_header("-" * 60_000 + "1"),
        "npy tokens": npy_header("{'descr': '<f8', 'shape': (1L, \"\"\""),
        "npy long": npy_header(" " * 60_000 + "{}"),
        "npy version 2": npy("'<f8'", "(1,)", b"", b"\2\0") + bytes(2**20),
        "npy version 9": npy("'<f8'", "(1,)", b"", b"\t\0"),
        "json deep list": b"[" * deep,
        "json deep object": b'{"a":' * deep,
        "json closed deep": b"[" * deep + b"]" * deep,
        "json digits": b'{"schema_version": ' + b"9" * 10_000 + b"}",
        "json not finite": b'{"a": NaN, "b": [Infinity, -Infinity]}',
        "json duplicates": b'{"kind": "evaluation", "kind": 3, "data": [], "data": {}}',
        "json null": b"null",
        "json number": b"7",
        "json lists": b'{"scenarios": [' + b"[]," * 3_000_000 + b"[]]}",
        "json text": b'"' + b"x" * (20 << 20) + b'"',
        "json list of text": b'["x", "y"]',
        "json surrogate": rb'{"kind": "\ud800", "planner": "\udfff\u0000"}',
        "json keys": b"{" + b",".join(b'"%d": {}' % number for number in range(300_000)) + b"}",
        "json objects": b'{"objects": [{"position": []}], "roads": [3], "metadata": {"sdc_track_index": 1}}',
        "json wrong types": json.dumps(
            {
                "schema_version": 3,
                "capacity": {"steps": 10**12},
                "fields": 0,
                "shards": [{"file": "/etc/passwd", "count": 10**12, "sha256": ""}],
                "scenarios": 7,
                "kind": [],
                "data": 7,
                "own_metrics": [1],
                "node": 3,
                "lane_segments": {"1": 2},
            }
        ).encode(),
        "yaml laughs": _laughs().encode(),
        "yaml itself": b"a: &a [*a]\n",
        "yaml text": b"x: &a " + b"x" * 890_000 + b"\ntask: [" + b"*a," * 49_900 + b"]\n",
        "yaml code": f"a: !!python/object/apply:os.mkdir ['{CANARY}']".encode(),
        "yaml deep": b"[" * deep,
        "yaml deep block": b"".join(b" " * n + b"a:\n" for n in range(900)),
        "yaml digits": b"a: " + b"9" * 9000,
        "yaml tags": b"a: !!timestamp x\nb: !!binary y\n",
        "yaml bool": b"a: !!bool x",
        "yaml merge": b'a: {!!merge "<<": [1]}',
        "yaml key": b"? [a, b]\n: c\n",
        "yaml long": b"a: [" + b"1, " * 400_000 + b"]",
        "yaml extends": b"extends: ../../../../etc/passwd\n",
        "yaml kinds": b"kind: evaluation\nplanner: {kind: os:system}\ntraffic: os:abort\nclaims: 7\narms: [1]\n",
        "yaml anchors": b"&a " * 5000 + b"x",
        "csv huge field": b"planner,dataset,scenario_id,segment,seed,traffic,x\n"
        + b"y" * (1 << 20)
        + b",,,,,,\n",
        "csv open quote": b'planner,dataset,scenario_id,segment,seed,traffic,x\n"' + b"a,b\n" * 500_000,
        "csv wide": b",".join(b"c%d" % number for number in range(200_000)) + b"\n" + b"," * 199_999,
        "csv numbers": b"planner,dataset,scenario_id,segment,seed,traffic,x\np,d,s,,0,log,1e999\np,d,s,,0,log,0x\n",
        "csv nul": b"planner,dataset,scenario_id,segment,seed,traffic,success\np,d,s\0,,0,log,1\n",
        "lines": b"\n".join(b"%d" % number for number in range(500_000)),
        "one line": b"x" * (30 << 20),
        "paths": b"../../../etc/passwd\n/dev/zero\n~/x\n",
        "log rows": b'{"step": "x"}\n{"step": 1e999}\n[]\n{"step": null}\n',
        "pickle code": pickle.dumps(Runs()),
        "pickle code 0": pickle.dumps(Runs(), 0),
        "pickle code in data": pickle.dumps({"tracks": {"a": Runs()}, "map_features": {}}),
        "pickle eval": b"cbuiltins\neval\n(S'1'\ntR.",
        "pickle memo": b"\x80\x02Nr\xff\xff\xff\x7f.",
        "pickle bytes": b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.",
        "pickle shared": _shared(60),
        "pickle collisions": _colliding(150_000),
        "pickle deep": b"\x80\x02" + b"(" * deep + b"t" * deep + b".",
        "pickle deep keys": b"\x80\x02}" + b"N" + b"\x85" * deep + b"Ns.",
        "pickle tuples": b"\x80\x02}("
        + b"".join(
            b"("
            + b"".join((b"J\xff\xff\xff\xff", b"J\xfe\xff\xff\xff")[n >> bit & 1] for bit in range(16))
            + b"tN"
            for n in range(1 << 15)
        )
        + b"u.",
        "pickle digits": b"L" + b"9" * 10_000 + b"L\n.",
        "pickle length": b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.",
        "pickle itself": b"\x80\x02]q\0h\0a.",
        "pickle ordinary": pickle.dumps(
            {"id": float("nan"), "tracks": {}, "map_features": {}, "metadata": []}
        ),
        "pickle scenario": pickle.dumps(
            {
                "version": "1",
                "id": "../../x",
                "length": 10**9,
                "tracks": {"e": {"state": {"position": np.zeros((91, 3))}, "type": "VEHICLE"}},
                "dynamic_map_states": {},
                "map_features": {},
                "metadata": {"ts": np.full(91, np.nan), "sdc_id": "e"},
            }
        ),
        "record of 2^63": framed(b"x", 2**63),
        "record of 2^40": framed(b"x", 2**40),
        "record empty": framed(b""),
        "record of groups": framed(b"\x0b" * deep),
        "record nested": framed(b"\x0a\xff\xff\xff\x7f" * 2000),
        "record of zeros": framed(bytes(1 << 20)),
        "sqlite head": b"SQLite format 3\0" + bytes(5000),
        "sqlite pages": b"SQLite format 3\0\x10\0\x01\x01\0\x40\x20\x20" + b"\xff" * 9000,
        "parquet": b"PAR1" + b"\x15\x04" * 999 + struct.pack("<I", 1998) + b"PAR1",
        "parquet length": b"PAR1" + bytes(64) + struct.pack("<I", 2**31 - 1) + b"PAR1",
        "feather": b"ARROW1\0\0" + b"\xff" * 999 + struct.pack("<I", 2**31 - 1) + b"ARROW1",
        "tar": b"../../evil".ljust(257, b"\0") + b"ustar\0" + bytes(300),
        "hdf": b"\x89HDF\r\n\x1a\n" + b"\xff" * 999,
        "sparse 20 GB": lambda path: (path.touch(), os.truncate(path, 20 << 30))[0],
        "folder": Path.mkdir,
        "link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "link to itself": lambda path: path.symlink_to(path),
        "link to nothing": lambda path: path.symlink_to("/nowhere"),
        "link to passwords": lambda path: path.symlink_to("/etc/passwd"),
        "pipe": os.mkfifo,
    }.items()


def _fill(begin: bytes, unit: bytes, end: bytes = b"") -> Callable[[Path], Any]:
    """Write the largest text file that is read, of equal units."""
    count = (MOST_TEXT - len(begin) - len(end)) // len(unit)
    return lambda path: path.write_bytes(begin + unit * count + end)


_HEAD = b"planner,dataset,scenario_id,segment,seed,traffic,success\n"
#: Text whose values take many times its bytes, by the end of the names of files of that kind.
LARGE: dict[str, dict[str, Callable[[Path], Any]]] = {
    ".json": {
        "json of lists": _fill(b"[", b"[[]],", b"[]]"),
        "json of objects": _fill(b"[", b'[{"":0}],', b"[]]"),
        "json of scenarios": _fill(b'{"schema_version": 3, "scenarios": [', b"{},", b"{}]}"),
        "json of numbers": _fill(b'{"objects": [', b"0.1,", b"0]}"),
    },
    ".csv": {
        "csv of short rows": _fill(_HEAD, b",\n"),
        "csv of blank rows": _fill(_HEAD, b"\n"),
        "csv of whole rows": _fill(_HEAD, b",,,,,,\n"),
        "csv of one row": _fill(_HEAD, b","),
    },
    ".txt": {"names": _fill(b"", b"ab\n"), "blank lines": _fill(b"", b"\n")},
    ".jsonl": {
        "log of short rows": _fill(b"", b'{"step":1}\n'),
        "log of blank rows": _fill(b"", b"\n"),
        "log of one row": _fill(b'{"step": 1, "a": [', b"[],", b"0]}\n"),
    },
    ".yaml": {"yaml of lists": _fill(b"a: [", b"[],", b"0]\n")},
}


def places() -> dict[str, tuple[Callable[[Path], Path | None], Callable[[Path], Any]]]:
    """Writers and readers of samples: what drivax writes, and every format."""
    result: dict[str, Any] = {
        kind: (write, lambda folder, _, r=read: r(folder)) for kind, (write, read) in own_files.KINDS.items()
    }
    for reader in READERS:
        sample = importlib.import_module(f"datasets.samples.{reader.name.replace('-', '_')}")
        result[reader.name] = (sample.write, lambda folder, path, name=reader.name: convert(path, name))
    return result


def convert(path: Path, name: str) -> list[str]:
    """Detect and convert one file of a format, and check the messages of bad records."""
    if path.is_file():
        try:
            detect(path)
        except DrivaxError as error:
            if problem := complaint(error):
                raise AssertionError(problem) from error
    errors = [
        item.error() for item in convert_file(path, Conversion(format=name)) if isinstance(item, BadRecord)
    ]
    for error in errors:
        if (problem := complaint(error)) or "assembling failed" in str(error):
            raise AssertionError(problem or str(error))
    return list(map(str, errors))


def outcome(read: Callable[..., Any], *arguments: Any) -> tuple[str, str | None]:
    """How one reading ends, and what is wrong with that."""

    def read_all() -> tuple[str, str | None]:
        with allow_edited():
            lines = read(*arguments)
        is_refused = isinstance(lines, list) and lines and isinstance(lines[0], str)
        return ("refused" if is_refused else "read"), None

    end, problem = attempt(read_all, "refused")
    if CANARY.exists():
        CANARY.unlink()
        return "executed", f"executed; {end}: {problem}"
    return end, problem


def put(payload: bytes | Callable[[Path], Any], target: Path) -> None:
    """Replace a file by a payload."""
    target.unlink()
    payload(target) if callable(payload) else target.write_bytes(payload)


def main(argv: Sequence[str] | None = None) -> int:
    """Try all payloads at the files of some places."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", default=",".join(places()))
    parser.add_argument("--every", type=int, default=1, help="try every n-th payload only")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(argv)
    ends: Counter[str] = Counter()
    wrong: list[str] = []
    slowest = 0.0
    contents = list(payloads())
    known = places()
    for place in args.places.split(","):
        write, read = known[place]
        with tempfile.TemporaryDirectory() as scratch:
            whole, folder = Path(scratch) / "whole", Path(scratch) / "hostile"
            whole.mkdir()
            main_file = write(whole)
            inside = None if main_file is None else main_file.relative_to(whole)
            # Imports what it needs before memory is limited.
            read(whole, None if inside is None else whole / inside)
            limit_memory()
            for file in sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file()):
                for number, (name, payload) in enumerate([*contents, *LARGE.get(file.suffix, {}).items()]):
                    if number % args.every:
                        continue
                    shutil.copytree(whole, folder)
                    put(payload, folder / file)
                    begin = time.monotonic()
                    kind, problem = outcome(read, folder, None if inside is None else folder / inside)
                    slowest = max(slowest, time.monotonic() - begin)
                    ends[kind] += 1
                    if problem is not None:
                        wrong.append(f"{place}: {name} as {file}: {kind}: {problem}")
                        print(wrong[-1][-1500:], flush=True)
                    shutil.rmtree(folder)
                print(place, file, json.dumps(ends), f"{slowest:.1f} s", flush=True)
            lift_memory()
    cases = sum(ends.values())
    summary = {"payloads": len(contents), "places": args.places, "cases": cases, "ends": ends}
    summary |= {"slowest_s": round(slowest, 1), "wrong": len(wrong)}
    print(json.dumps(summary))
    if args.out is not None:
        args.out.write_text(json.dumps(summary) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
