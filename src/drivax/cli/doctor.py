"""``drivax doctor``: installed packages of this machine, or contents and problems of a path."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from drivax import kernels
from drivax.cli import console
from drivax.datasets.doctor import Diagnosis, Part, diagnose
from drivax.errors import EXTRAS, UsageError, not_installed
from drivax.files import count_text, format_bytes, free_bytes
from drivax.table import Cell, Column, Table
from drivax.tracking.run_folder import zoo

if TYPE_CHECKING:
    from rich.table import Table as RichTable

#: Program that lists the devices; in a separate process, since a broken accelerator may hang or crash JAX.
_LIST_DEVICES = "import jax, json; print(json.dumps([[d.platform, d.device_kind] for d in jax.devices()]))"


@dataclass(frozen=True)
class Doctor:
    """Show installed packages, or identify a file or folder of data and its problems.

    With PATH: data set, flavour, version, number of recordings and scenarios, missing files, and a substitute for
    formats that drivax does not read. The exit status is 1 if nothing can be converted.

    Example: drivax doctor womd/training

    Example: drivax doctor --digest
    """

    path: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PATH]")] = None
    """File or folder to identify; this machine by default."""
    digest: bool = False
    """Simulate standard episodes, and print a digest of them, which is equal on machines with the same results."""


def run(args: Doctor) -> int:
    """Print the findings."""
    if args.digest:
        if args.path is not None:
            raise UsageError("--digest is about this machine, not about a path", cure="leave out one of them")
        console().print(_table(digests()))
        return 0
    if args.path is None:
        console().print(_table(machine()))
        return 0
    diagnosis = diagnose(args.path)
    console().print(_table(findings(diagnosis)))
    return 0 if diagnosis.convertible else 1


def machine() -> Iterator[tuple[str, str]]:
    """Yield installed packages and resources of the machine, as (name, value)."""
    yield "drivax", metadata.version("drivax")
    yield "python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    yield "jax", metadata.version("jax")
    yield "devices", devices()
    yield "native kernels", kernels.state()
    for extra, (purpose, modules) in EXTRAS.items():
        missing = [module for module in modules if not _is_installed(module)]
        yield f"{extra} ({purpose})", str(not_installed(extra, missing)) if missing else "installed"
    yield "policies", ", ".join(zoo())
    yield "cores", str(os.cpu_count())
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    yield "memory", format_bytes(memory)
    yield "disk", f"{format_bytes(free_bytes(Path.cwd()))} free here"


def digests() -> Iterator[tuple[str, str]]:
    """Yield versions, device, and digests of standard episodes, as (name, value)."""
    import jax

    from drivax.evaluation.digest import standard_digests

    device = jax.devices()[0]
    yield "drivax", metadata.version("drivax")
    yield "jax", f"{metadata.version('jax')} on {device.platform}: {device.device_kind}"
    yield from standard_digests()


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package around it is missing
        return False


def devices(timeout_s: float = 60.0) -> str:
    """Return the devices of JAX, or its error."""
    try:
        command = [sys.executable, "-P", "-c", _LIST_DEVICES]  # imports nothing from the current folder
        result = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
        if result.returncode == 0:
            kinds = json.loads(result.stdout.splitlines()[-1])
            return ", ".join(kind if kind == backend else f"{backend}: {kind}" for backend, kind in kinds)
    except subprocess.TimeoutExpired:
        return f"JAX does not answer (within {timeout_s:.0f} s); check the driver, or set JAX_PLATFORMS=cpu"
    except (ValueError, IndexError):
        return "JAX starts, but its list of devices cannot be read"
    message = (result.stderr.strip() or "no message").splitlines()[-1]
    return f"JAX does not start: {message}"


def findings(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    """Yield the lines of a diagnosis as (name, value)."""
    yield "path", str(diagnosis.path)
    for part in diagnosis.parts:
        yield from _part_rows(part, diagnosis.files[part.format])
    yield from (("shards", sentence) for sentence in diagnosis.shards)
    if diagnosis.parts:
        others = []
        if diagnosis.companions:
            others.append(f"{diagnosis.companions:,} that belong to them (maps, poses, tables)")
        if diagnosis.ignored:
            others.append(f"{diagnosis.ignored:,} of unknown format, ignored")
        if others:
            yield "other files", ", ".join(others)
        yield "input", format_bytes(diagnosis.input_bytes)
    yield from (("note", note) for note in diagnosis.notes)
    for problem in diagnosis.problems:
        # The path is printed above; name only files inside it.
        file = None if problem.file == diagnosis.path else problem.file
        prefix = f"{file}: " if file is not None else ""
        yield "problem", f"{prefix}{problem.problem}"
        if problem.cure:
            yield "fix", problem.cure
    if diagnosis.convertible:
        yield (
            "after convert",
            f"about {count_text(diagnosis.scenarios, 'scenario')}, {format_bytes(diagnosis.set_bytes)}"
            f" ({format_bytes(diagnosis.free_bytes)} free)",
        )
        yield "next", f"drivax convert {diagnosis.path} OUT"
    else:
        yield "verdict", "cannot be converted"


def _part_rows(part: Part, files: int) -> Iterator[tuple[str, str]]:
    """Yield the lines of a part as (name, value); ``files`` is the number of files of its format."""
    description = part.description
    version = "" if description.version is None else f", version {description.version}"
    yield "data set", f"{description.dataset}: {description.flavour}{version}"
    contents = count_text(part.sample_size if part.whole else files, "file")
    if not part.whole:
        contents += f" ({part.sample_size:,} of them inspected)"
    if description.recordings is not None:
        contents += f", {count_text(description.recordings, 'recording')}"
        contents += "" if part.whole else " in those"
    yield "format", f"{part.format}: {contents}"
    yield from (("note", note) for note in description.notes)
    yield from (("missing", name) for name in description.missing)


def _table(rows: Iterator[tuple[str, str]]) -> RichTable:
    columns = (Column("", label=True), Column("", left=True))
    return Table("doctor", columns, tuple((Cell(name), Cell(value)) for name, value in rows)).rich()
