"""Run folders: configuration, data, versions, machine and outputs of a run.

A run folder contains ``config.yaml`` (the complete configuration with defaults), ``run.json`` (all other information
that reproduces the run), outputs (``metrics.jsonl``, ``checkpoints/``, ``episodes.csv``, reports), and ``seal.json``
(:mod:`drivax.seal`).
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from drivax import kernels, settings
from drivax.errors import DataError, UsageError
from drivax.files import check_output, inside, replace_folder, restore_folder, write_text
from drivax.plugins import is_dotted
from drivax.reading import MOST_TEXT, check_size, explain_damage, read_json, read_text
from drivax.scenario.store import ScenarioSet
from drivax.seal import allow_edited, check_seal, edited_files, note_edited, require_entries, seal, unseal
from drivax.tracking.sinks import read_rows

CONFIG_FILE = "config.yaml"
RUN_FILE = "run.json"
#: Prefix of policies that are part of the package.
ZOO = "zoo:"
_ZOO_FOLDER = Path(__file__).resolve().parent.parent / "zoo"
_RERUN = "run the command again"
#: Types of the entries of ``run.json`` that are read again.
_ENTRIES: dict[str, Any] = {
    **dict.fromkeys(("kind", "planner", "traffic", "started", "command", "weights"), str),
    **dict.fromkeys(("own_metrics", "networks_from", "versions", "divergence"), dict), "data": list | dict,
    **dict.fromkeys(("trained_on", "edited", "critics", "runs", "deviation"), list),
    **dict.fromkeys(("seeds", "seed", "devices", "episodes"), int),
    "validation": str | dict, "sealed": bool,
}  # fmt: skip
_TRAINING_KINDS = ("training", "seeds")
#: Groups of kinds that replace each other; all others form a group.
_GROUPS = {"training": "training", "seeds": "training", "episodes": "episodes"}
#: Kinds of runs whose data sets have hashes; tables of other programs may lack them.
_HASHED_KINDS = (*_TRAINING_KINDS, "policy", "study", "ensemble")
#: Largest number of seeds that is read, far more than a device trains; resuming creates a folder for each.
_MOST_SEEDS = 10_000
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
            overwrite: See :meth:`check`.
            info: Further entries of ``run.json``, plain JSON values.

        Raises:
            UsageError: The folder exists and cannot be replaced.
        """
        path = Path(path)
        cls.check(path, overwrite, info.get("kind"))
        info = describe_run(data) | info | {"sealed": True}
        with replace_folder(path) as partial:
            write_text(partial / CONFIG_FILE, settings.dump(config))
            write_text(partial / RUN_FILE, _json(info))
            seal(partial, CONFIG_FILE, RUN_FILE)
        return cls(path, info)

    @staticmethod
    def check(path: Path, overwrite: bool, kind: str | None = None) -> None:
        """Check, before any work, that a run can be written to a folder.

        With ``overwrite``, a run folder is replaced; a training run only by a training run (``kind``), recorded
        episodes only by recorded episodes, and other runs only by other runs, as far as both kinds are known.

        Raises:
            UsageError: The folder exists and cannot be replaced.
        """
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return
        if not (path / RUN_FILE).is_file():
            raise UsageError("output exists and is not a run folder", file=path, cure="choose another name")
        present_kind = _kind(path)
        if len({_GROUPS.get(name, "other") for name in (kind, present_kind) if name is not None}) > 1:
            problem = f"output folder contains a run of kind {present_kind}, not {kind}"
            raise UsageError(problem, file=path, cure="choose another name")
        check_output(path, overwrite, folder=True)

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open a run folder.

        Raises:
            DataError: The folder, its ``run.json`` or its seal is missing, damaged or edited.
        """
        path, cure = Path(path), "give a folder written by drivax evaluate or drivax train"
        file = path / RUN_FILE
        if not file.is_file():
            restore_folder(path)
        if not file.is_file():
            problem = f"not a run folder: no {RUN_FILE}" if path.is_dir() else "run folder not found"
            raise DataError(problem, file=path, cure=cure)
        check_seal(file)
        info = read_json(file, _RERUN)
        with explain_damage(file, _RERUN):
            _check_info(info)
            note_edited(*map(str, info.get("edited") or ()))
        run = cls(path, info)
        if run.is_sealed:
            require_entries(path, CONFIG_FILE)
        return run

    @property
    def kind(self) -> str | None:
        """Kind of the run: ``training``, ``seeds``, ``evaluation``, ``policy``, ..."""
        return self.info.get("kind")

    @property
    def is_sealed(self) -> bool:
        """Whether drivax sealed the folder, by its ``run.json``; earlier versions and other programs did not."""
        return self.info.get("sealed", False)

    def config(self, cls: type[Record], overrides: Sequence[str] = (), trust: Collection[str] = ()) -> Record:
        """Return the run's configuration as a record, with overrides as on a command line.

        ``trust`` are the modules outside drivax whose code the configuration may name.

        Raises:
            DataError: ``config.yaml`` is missing or edited.
            UsageError: The configuration does not match ``cls``, or names code that is not trusted.
        """
        file = require_file(self.path / CONFIG_FILE, _RERUN)
        return settings.load(cls, file, overrides, trust=trust)

    @property
    def settings(self) -> dict[str, Any]:
        """Content of ``config.yaml`` as plain values; empty if there is no such file."""
        file = self.path / CONFIG_FILE
        check_seal(file)
        values = settings.parse_yaml(read_text(file, _RERUN), file) if file.is_file() else {}
        return values if isinstance(values, dict) else {}

    def note(self, **info: Any) -> RunFolder:
        """Add entries to ``run.json``, and return the updated run folder."""
        updated_info = self.info | info
        unseal(self.path, RUN_FILE)
        write_text(self.path / RUN_FILE, _json(updated_info), follow=False)
        seal(self.path, RUN_FILE)
        return RunFolder(self.path, updated_info)

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints.

        Raises:
            DataError: It is a symbolic link.
        """
        return inside(self.path, "checkpoints")

    @property
    def metrics(self) -> Path:
        """File of the logged metrics."""
        return self.path / "metrics.jsonl"

    def read_metrics(self) -> list[dict[str, Any]]:
        """Return the rows of ``metrics.jsonl``.

        Raises:
            DataError: The file is missing, a row is damaged, or the rows may not fit in memory.
        """
        rows = self.metric_rows()
        check_size(self.metrics, "use RunFolder.metric_rows, which yields one row at a time", MOST_TEXT)
        return list(rows)

    def metric_rows(self) -> Iterator[dict[str, Any]]:
        """Yield the rows of ``metrics.jsonl``; only one row at a time is in memory.

        Raises:
            DataError: The file is missing, or a row is damaged.
        """
        return read_rows(require_file(self.metrics, "train again"))


def require_file(path: Path, cure: str) -> Path:
    """Return the path of a file.

    Raises:
        DataError: The file is missing or edited.
    """
    check_seal(path)
    if not path.is_file():
        raise DataError("file not found", file=path, cure=cure)
    return path


def _check_info(info: Any) -> None:
    """Check the types of the entries of ``run.json`` that are read again."""
    if not isinstance(info, dict):
        raise ValueError("not a JSON object")
    for name, kind in _ENTRIES.items():
        if not isinstance(info.get(name), kind | None):
            raise ValueError(f"{name} is not of type {getattr(kind, '__name__', kind)}")
    _check_data(info)
    validation, divergence = info.get("validation"), info.get("divergence")
    for recording in validation["recordings"] if isinstance(validation, dict) else ():
        if [*map(type, recording)] != [str, str]:
            raise ValueError("a recording that is not named by its data set and its segment")
    if divergence is not None and [type(divergence[name]) for name in ("step", "problem")] != [int, str]:
        raise ValueError("a divergence without its step or problem")
    if info.get("seeds") is not None and not 1 <= info["seeds"] <= _MOST_SEEDS:
        raise ValueError(f"{info['seeds']} seeds")


def _check_data(info: Mapping[str, Any]) -> None:
    """Check the data sets in ``run.json``."""
    is_hashed = info.get("kind") in _HASHED_KINDS
    hash_type: Any = str if is_hashed else str | None
    if is_hashed and isinstance(info.get("data"), dict):
        raise ValueError("data is not a list")
    for data in (info.get("data"), info.get("trained_on"), (info.get("networks_from") or {}).get("data")):
        for entry in [data] if isinstance(data, dict) else data or ():
            if not isinstance(entry, dict) or not isinstance(entry.get("hash"), hash_type):
                raise ValueError("a data set without its hash")


def _json(info: Mapping[str, Any]) -> str:
    return json.dumps(info, indent=1) + "\n"


def seed_folders(path: str | Path) -> list[Path]:
    """Return the run folders of a path: those of its seeds for a run with ``--seeds``, otherwise the path itself.

    Raises:
        DataError: The run of several seeds has no seed folder.
    """
    path = Path(path)
    if _kind(path) != "seeds":
        return [path]
    folders = (file.parent for file in path.glob("seed-*/" + RUN_FILE))
    seeds = {f: int(match[1]) for f in folders if (match := re.fullmatch(r"seed-(-?\d+)", f.name))}
    if not seeds:
        # A training run that was killed at its start leaves such a folder.
        cure = "continue the training with --resume"
        raise DataError("no folder seed-N in a run of several seeds", file=path, cure=cure)
    return sorted(seeds, key=seeds.__getitem__)


def _kind(path: Path) -> str | None:
    """Return the kind of the run in a folder, or None if the run cannot be read or has no kind."""
    with contextlib.suppress(DataError, OSError), allow_edited():
        return RunFolder.open(path).kind
    return None


def run_and_step(name: str) -> tuple[str, int | None]:
    """Split ``RUN@STEP``; the step is None without ``@STEP``, or if a folder has the whole name.

    Raises:
        UsageError: The step is not a number.
    """
    run, separator, step = name.rpartition("@")
    if not separator or "/" in step or Path(name).is_dir():
        return name, None
    if step.isdecimal():
        return run, int(step)
    cure = "write RUN@STEP, for example runs/a@100000"
    raise UsageError(f"{step!r} is not a checkpoint step", cure=cure)


def zoo() -> list[str]:
    """Return the names (``zoo:NAME``) of trained policies that are part of the package."""
    return sorted(ZOO + path.parent.name for path in _ZOO_FOLDER.glob("*/run.json"))


def policy_folder(name: str | Path) -> Path:
    """Return the folder of a ``zoo:NAME`` policy, or the path itself.

    Raises:
        UsageError: The name is unknown.
    """
    if not str(name).startswith(ZOO):
        return Path(name)
    if str(name) not in zoo():
        raise UsageError(f"no policy {str(name)!r} in the zoo", cure=f"use {', '.join(zoo())}")
    return _ZOO_FOLDER / str(name).removeprefix(ZOO)


def is_policy(name: str | Path, known: Container[str] = ()) -> bool:
    """Return whether a name is that of a trained policy: ``zoo:NAME``, or a folder.

    No folder shadows ``module:name``, or the ``known`` names of planners or traffic models.
    """
    is_name = str(name) in known or is_dotted(str(name))
    return str(name).startswith(ZOO) or (Path(name).is_dir() and not is_name)


def policy_training_sets(planner: str, known: Container[str] = ()) -> list[dict[str, Any]]:
    """Return the training sets of a policy (``RUN``, ``RUN@STEP`` or ``zoo:NAME``), including pretraining.

    Other planners, among them the ``known`` ones, have none.
    """
    run = run_and_step(planner)[0]
    path = policy_folder(run)
    info = RunFolder.open(path).info if is_policy(run, known) and (path / RUN_FILE).is_file() else {}
    return training_sets(info) if info.get("kind") in ("training", "policy") else []


def training_sets(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the data sets in the ``run.json`` of a training run without duplicates, its own sets first."""
    by_hash: dict[str, dict[str, Any]] = {}
    networks_from = info.get("networks_from") or {}
    for entry in (*(info.get("data") or ()), *(networks_from.get("data") or ())):
        by_hash.setdefault(entry["hash"], entry)
    return list(by_hash.values())


def describe_run(data: Sequence[ScenarioSet] = ()) -> dict[str, Any]:
    """Return command, start, versions, commit, data, machine and edited inputs of this process as JSON values."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "git": git_state(Path(__file__).resolve().parent),
        "data": [{"path": str(d.path.resolve()), "hash": d.hash, "scenarios": len(d)} for d in data],
        "machine": machine(),
        **({"edited": edited} if (edited := edited_files()) else {}),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect results."""
    result = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            result[name] = metadata.version(name)
    return result


def machine() -> dict[str, Any]:
    """Describe the machine; this asks JAX for its devices, which initialises the accelerator."""
    import jax

    devices = jax.devices()
    return {
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cpu_count": os.cpu_count(),
        "device": devices[0].device_kind,
        "devices": len(devices),
        "backend": jax.default_backend(),
        "kernels": kernels.state(),
    }


def kernels_difference(info: Mapping[str, Any]) -> str | None:
    """Describe the native kernels of a run (by its ``run.json``) and of this process; None if they are the same."""
    run_machine = info.get("machine")
    run_state = run_machine.get("kernels", "none") if isinstance(run_machine, dict) else "none"
    before, now = (
        "none" if str(state).startswith("none") else str(state) for state in (run_state, kernels.state())
    )
    return f"the run used native kernels {before}, this process {now}" if before != now else None


def git_state(folder: Path) -> dict[str, Any] | None:
    """Return the commit of the checkout that contains a folder, and whether package or presets are modified.

    The result is None outside a checkout of this package.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie in another repository, which does not track this file.
        this_file = Path(__file__).resolve()
        git("ls-files", "--error-unmatch", str(this_file))
        root = git("rev-parse", "--show-toplevel")
        changes = git("status", "--porcelain", "--", str(this_file.parents[1]), f"{root}/configs")
        return {"commit": git("rev-parse", "HEAD"), "changed": bool(changes)}
    except (OSError, subprocess.SubprocessError):
        return None
