"""Run folders: what was run, on which data, with which versions, on which machine.

A run folder holds ``config.yaml`` (the whole configuration, defaults included), ``run.json`` (everything else that a
reader needs to believe or repeat the run), and what the run produces: ``metrics.jsonl``, ``checkpoints/``,
``episodes.csv``, reports.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from drivax import settings
from drivax.errors import DataError, UsageError
from drivax.files import replace_folder, write_text
from drivax.scenario.store import ScenarioSet
from drivax.tracking.zoo import is_policy, policy_folder

CONFIG_FILE = "config.yaml"
RUN_FILE = "run.json"
_TRAININGS = ("training", "seeds")
_PACKAGES = ("drivax", "jax", "jaxlib", "flax", "optax", "numpy")

Record = TypeVar("Record")


@dataclass(frozen=True)
class RunFolder:
    """An existing run folder.

    Attributes:
        path: The folder.
        info: Content of ``run.json``.
    """

    path: Path
    info: dict[str, Any]

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: Any,
        data: Sequence[ScenarioSet] = (),
        overwrite: bool = False,
        **notes: Any,
    ) -> RunFolder:
        """Make the folder and write ``config.yaml`` and ``run.json``; the folder appears with both in it.

        Args:
            path: Folder to create.
            config: Configuration record (a dataclass).
            data: The scenario sets that the run reads.
            overwrite: Replace an existing run folder; other folders are never replaced.
            notes: More facts for ``run.json``, plain JSON values.

        Raises:
            UsageError: ``path`` exists.
        """
        path = Path(path)
        refuse_existing(path, overwrite, notes.get("kind"))
        info = describe_run(data) | notes
        with replace_folder(path) as partial:
            write_text(partial / CONFIG_FILE, settings.dump(config))
            write_text(partial / RUN_FILE, json.dumps(info, indent=1) + "\n")
        return cls(path, info)

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open a run folder.

        Raises:
            DataError: It is no run folder, or ``run.json`` is damaged.
        """
        path = Path(path)
        for name in (CONFIG_FILE, RUN_FILE):
            if not (path / name).is_file():
                raise DataError(
                    f"is no run folder (no {name})", file=path, cure="name a folder that a run wrote"
                )
        try:
            info = json.loads((path / RUN_FILE).read_bytes())
        except ValueError as error:
            raise DataError(f"is damaged ({error})", file=path / RUN_FILE, cure="run again") from error
        return cls(path, info)

    def config(self, cls: type[Record], overrides: Sequence[str] = ()) -> Record:
        """The run's configuration as a record, with settings replaced as on a command line.

        Raises:
            UsageError: ``config.yaml`` does not fit ``cls``.
        """
        return settings.load(cls, self.path / CONFIG_FILE, overrides)

    def note(self, **notes: Any) -> RunFolder:
        """The run with more facts in ``run.json`` (an end time, a result)."""
        info = self.info | notes
        write_text(self.path / RUN_FILE, json.dumps(info, indent=1) + "\n")
        return RunFolder(self.path, info)

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics(self) -> Path:
        """File of the logged metrics."""
        return self.path / "metrics.jsonl"


def seed_folders(path: str | Path) -> list[Path]:
    """The run folders that a path stands for: those that ``drivax train --seeds`` wrote inside it, or itself."""
    path = Path(path)
    if _kind(path) != "seeds":
        return [path]
    found = path.glob("seed-*/" + RUN_FILE)
    return sorted((file.parent for file in found), key=lambda folder: int(folder.name.removeprefix("seed-")))


def _kind(path: Path) -> str | None:
    """The kind of the run in a folder; None where none can be read: whoever opens it tells what is wrong."""
    try:
        info = json.loads((path / RUN_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    return info.get("kind") if isinstance(info, dict) else None


def run_and_step(name: str) -> tuple[str, int | None]:
    """What ``RUN@STEP`` names, or ``RUN``, which leaves the step open.

    Raises:
        UsageError: The step is no number.
    """
    run, at, step = name.partition("@")
    if at and not step.isdecimal():
        raise UsageError(f"{step!r} is no step of a checkpoint", cure="write RUN@STEP, as runs/a@100000")
    return run, int(step) if at else None


def learned_from(planner: str) -> list[dict[str, Any]]:
    """The data sets that a trained policy (``RUN``, ``RUN@STEP`` or ``zoo:NAME``) learned from; none of any other.

    Those of the runs that its networks come from are among them.
    """
    folder = planner.partition("@")[0]
    path = policy_folder(folder) if is_policy(folder) else Path(folder)
    info = RunFolder.open(path).info if (path / RUN_FILE).is_file() else {}
    return trained_on(info) if info.get("kind") in ("training", "policy") else []


def trained_on(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The data sets that a training's ``run.json`` names, its own first, each once."""
    known: dict[str, dict[str, Any]] = {}
    for entry in (*info.get("data", ()), *info.get("networks_from", {}).get("data", ())):
        known.setdefault(entry["hash"], entry)
    return list(known.values())


def describe_run(data: Sequence[ScenarioSet] = ()) -> dict[str, Any]:
    """Facts about this process, its program, its data and its machine, as plain JSON values."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "git": git_state(Path(__file__).resolve().parent),
        "data": [{"path": str(d.path.resolve()), "hash": d.hash, "scenarios": len(d)} for d in data],
        "machine": machine(),
    }


def versions() -> dict[str, str]:
    """Versions of python and of the packages that decide numbers."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """The machine; asks JAX for its devices, which starts the accelerator."""
    import jax

    devices = jax.devices()
    return {
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cpu_count": os.cpu_count(),
        "device": devices[0].device_kind,
        "devices": len(devices),
        "backend": jax.default_backend(),
    }


def git_state(folder: Path) -> dict[str, Any] | None:
    """Commit of the checkout that ``folder`` belongs to, and whether package or presets are others; None without one.

    What lies beside them, as a run folder may, changes nothing of what runs.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie inside a foreign repository: only a checkout that tracks this file counts.
        own = Path(__file__).resolve()
        git("ls-files", "--error-unmatch", str(own))
        top = git("rev-parse", "--show-toplevel")
        changed = git("status", "--porcelain", "--", str(own.parents[1]), f"{top}/configs")
        return {"commit": git("rev-parse", "HEAD"), "changed": bool(changed)}
    except (OSError, subprocess.SubprocessError):
        return None


def refuse_existing(path: Path, overwrite: bool, kind: str | None = None) -> None:
    """Refuses a folder that a run may not be written to, before any work is done.

    Args:
        path: The folder.
        overwrite: Whether a run may be replaced.
        kind: What is to be written; a training is replaced by nothing but a training, and replaces nothing else.

    Raises:
        UsageError: It exists and is no run folder, or one of another kind, or ``overwrite`` is not given.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not (path / RUN_FILE).is_file():
        raise UsageError("exists and is no run folder", file=path, cure="choose another name")
    there = _kind(path)
    if kind is not None and there is not None and (there in _TRAININGS) != (kind in _TRAININGS):
        raise UsageError(f"holds a run of kind {there}, not {kind}", file=path, cure="choose another name")
    if not overwrite:
        raise UsageError(
            "exists already", file=path, cure="choose another name, --resume it or pass --overwrite"
        )
