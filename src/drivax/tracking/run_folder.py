"""Run folders: configuration, data, versions and machine of a run, and its outputs.

A run folder holds ``config.yaml`` (the whole configuration, defaults included), ``run.json`` (all other information
needed to reproduce the run), and outputs: ``metrics.jsonl``, ``checkpoints/``, ``episodes.csv``, reports.
"""

from __future__ import annotations

import contextlib
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
from drivax.files import check_output, replace_folder, write_text
from drivax.scenario.store import ScenarioSet
from drivax.tracking.sinks import read_rows

CONFIG_FILE = "config.yaml"
RUN_FILE = "run.json"
#: Prefix of the policies that come with the package.
ZOO = "zoo:"
_ZOO_FOLDER = Path(__file__).resolve().parent.parent / "zoo"
_TRAININGS = ("training", "seeds")
_PACKAGES = ("drivax", "jax", "jaxlib", "flax", "optax", "numpy")

Record = TypeVar("Record")


@dataclass(frozen=True)
class RunFolder:
    """A run folder and the content of its ``run.json``."""

    path: Path
    info: dict[str, Any]

    @classmethod
    def create(
        cls, path: str | Path, config: Any, data: Sequence[ScenarioSet] = (), overwrite: bool = False,
        **info: Any,
    ) -> RunFolder:  # fmt: skip
        """Create a folder with ``config.yaml`` and ``run.json`` atomically.

        Args:
            path: Folder to create.
            config: Configuration record.
            data: Scenario sets that the run reads.
            overwrite: See :meth:`check`, which may raise UsageError.
            info: Further entries of ``run.json``, plain JSON values.
        """
        path = Path(path)
        cls.check(path, overwrite, info.get("kind"))
        info = describe_run(data) | info
        with replace_folder(path) as partial:
            write_text(partial / CONFIG_FILE, settings.dump(config))
            write_text(partial / RUN_FILE, _json(info))
        return cls(path, info)

    @staticmethod
    def check(path: Path, overwrite: bool, kind: str | None = None) -> None:
        """Raise UsageError, before any work is done, if a run cannot be written to a folder.

        Only run folders are replaced, with ``overwrite``; a training (``kind``) only by a training, and nothing else.
        """
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return
        if not (path / RUN_FILE).is_file():
            raise UsageError("output exists and is not a run folder", file=path, cure="choose another name")
        present = _kind(path)
        if kind is not None and present is not None and (present in _TRAININGS) != (kind in _TRAININGS):
            problem = f"output folder contains a run of kind {present}, not {kind}"
            raise UsageError(problem, file=path, cure="choose another name")
        check_output(path, overwrite, folder=True)

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open a run folder; raises DataError if it or its ``run.json`` is missing or damaged."""
        path, cure = Path(path), "give a folder written by drivax evaluate or drivax train"
        file = path / RUN_FILE
        if not file.is_file():
            problem = f"not a run folder: no {RUN_FILE}" if path.is_dir() else "run folder not found"
            raise DataError(problem, file=path, cure=cure)
        try:
            info = json.loads(file.read_bytes())
        except ValueError as error:
            raise DataError(f"not valid JSON ({error})", file=file, cure="run the command again") from error
        if not isinstance(info, dict):
            raise DataError("not a JSON object", file=file, cure="run the command again")
        return cls(path, info)

    @property
    def kind(self) -> str | None:
        """Kind of the run: ``training``, ``seeds``, ``evaluation``, ``policy``, ..."""
        return self.info.get("kind")

    def config(self, cls: type[Record], overrides: Sequence[str] = ()) -> Record:
        """Return the run's configuration as a record, with overrides as on a command line.

        Raises DataError if ``config.yaml`` is missing, UsageError if it does not fit ``cls``.
        """
        return settings.load(cls, existing(self.path / CONFIG_FILE, "run the command again"), overrides)

    @property
    def settings(self) -> dict[str, Any]:
        """Content of ``config.yaml`` as plain values; empty without the file."""
        file = self.path / CONFIG_FILE
        values = settings.parse_yaml(file.read_text(encoding="utf-8"), file) if file.is_file() else {}
        return values if isinstance(values, dict) else {}

    def note(self, **info: Any) -> RunFolder:
        """Add entries to ``run.json``, and return the folder with them."""
        merged = self.info | info
        write_text(self.path / RUN_FILE, _json(merged))
        return RunFolder(self.path, merged)

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics(self) -> Path:
        """File of the logged metrics."""
        return self.path / "metrics.jsonl"

    def read_metrics(self) -> list[dict[str, Any]]:
        """Return the rows of ``metrics.jsonl`` as :func:`read_rows`; raises DataError if there is none."""
        return list(read_rows(existing(self.metrics, "train again")))


def existing(path: Path, cure: str) -> Path:
    """Return the path of a file; raises DataError if there is none."""
    if not path.is_file():
        raise DataError("file not found", file=path, cure=cure)
    return path


def _json(info: Mapping[str, Any]) -> str:
    return json.dumps(info, indent=1) + "\n"


def seed_folders(path: str | Path) -> list[Path]:
    """Return the run folders behind a path: one per seed for a run with ``--seeds``, otherwise the path itself."""
    path = Path(path)
    if _kind(path) != "seeds":
        return [path]
    folders = (file.parent for file in path.glob("seed-*/" + RUN_FILE))
    return sorted(folders, key=lambda folder: int(folder.name.removeprefix("seed-")))


def _kind(path: Path) -> str | None:
    """Return the kind of the run in a folder; None if it cannot be read."""
    with contextlib.suppress(DataError, OSError):
        return RunFolder.open(path).kind
    return None


def run_and_step(name: str) -> tuple[str, int | None]:
    """Split ``RUN@STEP`` or ``RUN``, which leaves the step None; raises UsageError if the step is not a number."""
    run, at, step = name.partition("@")
    if at and not step.isdecimal():
        raise UsageError(
            f"{step!r} is not a checkpoint step", cure="write RUN@STEP, for example runs/a@100000"
        )
    return run, int(step) if at else None


def zoo() -> list[str]:
    """Return the names of the trained policies that come with the package: ``zoo:NAME``."""
    return sorted(ZOO + path.parent.name for path in _ZOO_FOLDER.glob("*/run.json"))


def policy_folder(name: str | Path) -> Path:
    """Return the folder of a policy of the zoo, or the path itself; raises UsageError for an unknown ``zoo:NAME``."""
    if not str(name).startswith(ZOO):
        return Path(name)
    if name not in zoo():
        raise UsageError(f"there is no policy {str(name)!r} in the zoo", cure=f"use {', '.join(zoo())}")
    return _ZOO_FOLDER / str(name).removeprefix(ZOO)


def is_policy(name: str | Path) -> bool:
    """Whether a name is that of a trained policy: ``zoo:NAME``, or a folder."""
    return str(name).startswith(ZOO) or Path(name).is_dir()


def learned_from(planner: str) -> list[dict[str, Any]]:
    """Return the training sets of a policy (``RUN``, ``RUN@STEP`` or ``zoo:NAME``), including pretraining."""
    folder = planner.partition("@")[0]
    path = policy_folder(folder) if is_policy(folder) else Path(folder)
    info = RunFolder.open(path).info if (path / RUN_FILE).is_file() else {}
    return trained_on(info) if info.get("kind") in ("training", "policy") else []


def trained_on(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the distinct data sets in a training's ``run.json``, its own first."""
    by_hash: dict[str, dict[str, Any]] = {}
    for entry in (*info.get("data", ()), *info.get("networks_from", {}).get("data", ())):
        by_hash.setdefault(entry["hash"], entry)
    return list(by_hash.values())


def describe_run(data: Sequence[ScenarioSet] = ()) -> dict[str, Any]:
    """Describe this process, its program, data and machine as plain JSON values."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "git": git_state(Path(__file__).resolve().parent),
        "data": [{"path": str(d.path.resolve()), "hash": d.hash, "scenarios": len(d)} for d in data],
        "machine": machine(),
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    installed = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    return installed


def machine() -> dict[str, Any]:
    """Describe the machine; asks JAX for its devices, which starts the accelerator."""
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
    """Return the commit of the checkout around a folder, and whether package or presets are modified, if any."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie in another repository: only a checkout that tracks this file counts.
        this_file = Path(__file__).resolve()
        git("ls-files", "--error-unmatch", str(this_file))
        root = git("rev-parse", "--show-toplevel")
        changed = git("status", "--porcelain", "--", str(this_file.parents[1]), f"{root}/configs")
        return {"commit": git("rev-parse", "HEAD"), "changed": bool(changed)}
    except (OSError, subprocess.SubprocessError):
        return None
