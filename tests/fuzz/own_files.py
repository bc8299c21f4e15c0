"""Damages the files that drivax writes: detected in one line, or harmless and the same content.

    python -m fuzz.own_files KIND ... --files 200 --seed 0       (from the folder tests)

Exit status 1 when a file ended in anything else. Every second sample is read with ``--edited``, so that damage reaches
the parsers; valid text of another content is accepted there, and for the user's own files (:data:`OWN_TEXT`), and
counted.

What drivax writes, and the kind that has it here:

==========================================  ==========================================================================
scenario set                                ``set``: manifest (with tags and audit), shards, checksums, lists, seals
score table                                 ``table``
evaluation                                  ``run``: configuration, ``run.json``, episodes, summary, crashes,
                                            trajectories, seal
training                                    ``training``: configuration, ``run.json``, log, TensorBoard events,
                                            checkpoints, seal
exported policy, policy of the zoo          ``policy``: configuration, ``run.json``, parameters, seal
study                                       ``study``: its file, and its run folder with the results
export                                      ``export``: GPUDrive and tf.Example files with their notes
partial folder of a killed process          ``partial``: identity, progress, lock
pages, pictures, tables as files,           never read by drivax
``bench`` and ``doctor`` output
compiled programs                           JAX reads them, of the user only (``tests/test_compilation.py``)
==========================================  ==========================================================================
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from drivax import settings
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.datasets.conversion import Conversion, convert_file
from drivax.datasets.export.writer import Export, export
from drivax.datasets.formats import survey
from drivax.datasets.reader import BadRecord
from drivax.evaluation.episode_table import Crash, EpisodeTable, Trajectories
from drivax.evaluation.runner import EvaluationConfig
from drivax.files import PartialFolder
from drivax.learning.config import TrainConfig
from drivax.learning.policies import export_policy, load_policy
from drivax.learning.training_log import TrainingLog
from drivax.metrics.catalogue import EVENTS
from drivax.report.runs import read_runs
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.select import splits
from drivax.scenario.select.selection import read_names, select_scenarios
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import MARK, allow_edited, check_seal, seal
from drivax.settings import load
from drivax.studies.definition import StudyConfig, StudyDefinition
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from fuzz import mutations
from fuzz.limits import attempt, complaint, limit_memory
from fuzz.run import MEMORY_PER_FILE, SECONDS_PER_FILE
from scenes import car, straight_road
from tiny_run import write_run as write_tiny_run

SMALL_CAPACITY = replace(
    Capacity(),
    name="small",
    agents=4,
    parked=4,
    segments=512,
    features=32,
    lanes=16,
    lights=4,
    stops=2,
    routes=2,
)
#: Text without a checksum in it, of which only the seal finds valid edits, and text of the user, which has no seal.
SEALED_TEXT = (
    "manifest.json",
    "run.json",
    "config.yaml",
    "episodes.csv",
    "crashes.json",
    "metrics.jsonl",
    "results.json",
    ".txt",
)
OWN_TEXT = ("study.yaml", "export.json")
#: Folders whose files may have another content: in a format without checksums, and those that are written again.
EDITABLE = {"gpudrive", ".out.partial"}
#: Identity and notes of a partial folder.
IDENTITY, NOTES = {"seed": 3, "sources": ["a", "b"]}, [{"shard": 0, "ids": ["x"]}, {"shard": 1, "ids": []}]


def content(value: Any) -> str:
    """A digest of nested values and arrays, without the mark of edited files."""
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value):
                digest.update(repr(key).encode())
                add(value[key])
        elif isinstance(value, list | tuple):
            digest.update(b"[%d" % len(value))
            for item in value:
                add(item)
        elif hasattr(value, "dtype"):
            array = np.asarray(value)
            digest.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
        else:
            digest.update(repr(value).replace(MARK, "").encode())

    add(value)
    return digest.hexdigest()


def write_set(folder: Path) -> Path:
    """A set of three scenarios in two shards, with lists."""
    with ScenarioWriter(
        folder / "set", SMALL_CAPACITY, {"command": "test"}, 2, shares=(34, 33, 33)
    ) as writer:
        for row in range(3):
            recording = straight_road([car(speed=2.0 + row), car(x=40.0)])
            writer.add(
                assemble(replace(recording, scenario_id=f"drive-{row}", segment=f"r-{row}"), SMALL_CAPACITY)
            )
    return folder / "set"


def read_set(folder: Path) -> Any:
    """Records, entries, and the scenarios of each list."""
    data = ScenarioSet.open(folder / "set")
    files = [folder / "set" / "splits" / f"{name}.txt" for name in splits.NAMES]
    lists = [select_scenarios(data, (), [file]) if read_names(file) else [] for file in files]
    return (
        [[s.record.tobytes(), s.id, s.tags, s.audit, s.overflow] for s in data],
        data.entries,
        data.hash,
        lists,
    )


def write_table(folder: Path) -> None:
    """A score table, and the set that it scores."""
    data = ScenarioSet.open(write_set(folder))
    shape = (len(data), data.capacity.steps)
    steps = np.random.default_rng(0).random(shape).astype(np.float32)
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    table = ScoreTable(
        "kinematic", {"a": 1}, data.hash, ids, np.ones(shape, bool), steps, steps[:, 0], {"urgency": steps}
    )
    write_scores(table, folder / "scores.npz")


def read_table(folder: Path) -> Any:
    """All of a score table."""
    table = read_scores(folder / "scores.npz", ScenarioSet.open(folder / "set"))
    return [table.method, dict(table.config), table.scenario_ids, table.valid, table.steps, table.scenarios,
            dict(table.components)]  # fmt: skip


def write_run(folder: Path) -> None:
    """An evaluation of two episodes, one of which crashed."""
    rng, n = np.random.default_rng(0), 2
    info = {
        "planner": "p",
        "traffic": "idm",
        "own_metrics": {"mine": {"unit": "m", "better": "low", "text": "t"}},
    }
    keys = {"planner": ("p",) * n, "dataset": ("d",) * n, "scenario_id": ("s1", "s2"), "segment": ("", "r"),
            "seed": ("0",) * n, "traffic": ("idm",) * n}  # fmt: skip
    rollouts = Trajectories(
        rng.random((n, 6, 4)).astype(np.float32), rng.random((n, 5, 2)), np.full(n, 10),
        {name: np.full(n, -1) for name in EVENTS}, rng.integers(-9, 9, (n, 6, 3, 3)).astype(np.int16),
    )  # fmt: skip
    metrics = {"success": np.array([1.0, 0.0]), "mine": np.array([0.25, np.nan])}
    table = EpisodeTable(None, "p", info, keys, metrics, (Crash("d", "s2", 3, "ValueError: x"),), rollouts)
    RunFolder.create(folder / "run", EvaluationConfig("p"), kind="evaluation", episodes=n, seed=0, **info)
    table.write(folder / "run")


def read_run(folder: Path) -> Any:
    """All of an evaluation that reports show."""
    table, run = EpisodeTable.read(folder / "run"), RunFolder.open(folder / "run")
    trajectories = table.trajectories
    crashes = [[crash.dataset, crash.scenario_id, crash.step, crash.error] for crash in table.crashes]
    return [run.info, run.settings, table.keys, dict(table.metrics), crashes, trajectories.ego, trajectories.action,
            trajectories.start, trajectories.events, trajectories.others, table.summary(),
            list(table.own_metrics), dict(table.data)]  # fmt: skip


def write_training(folder: Path) -> None:
    """A finished training of two checkpoints."""
    run = RunFolder.create(folder / "run", TrainConfig(), kind="training")
    with TrainingLog(run, "score", keep=2, patience=0) as log:
        log.start(None)
        for step in (100, 200):
            log.write(step, {"loss": 1 / step, "validation/vmax_score": step / 300})
            log.checkpoints.save(step, {"w": np.arange(3.0), "n": np.zeros(0, np.int32)}, step / 300)


def read_training(folder: Path) -> Any:
    """Learning curves, configuration, and both checkpoints."""
    (training,) = read_runs([folder / "run"])[1]
    run, template = RunFolder.open(folder / "run"), {"w": np.zeros(3), "n": np.zeros(0, np.int32)}
    checkpoints = Checkpoints(run.checkpoints)
    states = [[checkpoints.about(step), checkpoints.restore(template, step)] for step in checkpoints.steps()]
    return [
        training.info,
        dict(training.curves),
        settings.dump(run.config(TrainConfig)),
        checkpoints.best(),
        states,
    ]


def _bank() -> ScenarioBank:
    return ScenarioBank.from_scenarios([assemble(straight_road([car(x=40.0)]), SMALL_CAPACITY)])


def write_policy(folder: Path) -> None:
    """An exported policy."""
    bank = _bank()
    export_policy(write_tiny_run(folder / "training", bank).path, folder / "policy", bank)
    shutil.rmtree(folder / "training")


def read_policy(folder: Path) -> Any:
    """Its parameters as arrays, its task and its provenance."""
    planner, task = load_policy(folder / "policy", _bank())
    return [
        *map(np.asarray, jax.tree.leaves(planner)),
        settings.dump(task),
        RunFolder.open(folder / "policy").info,
    ]


def write_study(folder: Path) -> None:
    """The long-tail study as a file of the user, and a run folder with its results."""
    (folder / "study.yaml").write_text(settings.preset("studies/longtail").read_text("utf-8"))
    run = RunFolder.create(folder / "run", StudyConfig(), kind="study", definition="c0de").path
    (run / "results.json").write_text('{"claims": []}')
    seal(run, "results.json")


def read_study(folder: Path) -> Any:
    """The settings of the study, and the run folder."""
    run = RunFolder.open(folder / "run")
    check_seal(run.path / "results.json")
    definition = settings.dump(load(StudyDefinition, folder / "study.yaml"))
    return [definition, run.info, settings.dump(run.config(StudyConfig))]


#: Formats of exports, and the readers that read them.
EXPORTS: dict[Any, str] = {"gpudrive": "gpudrive", "tfexample": "womd-example"}


def write_export(folder: Path) -> None:
    """A scenario as GPUDrive JSON and as a tf.Example."""
    data = write_set(folder)
    for name in EXPORTS:
        export(data, folder / name, Export(format=name, limit=1))
    shutil.rmtree(data)


def read_export(folder: Path) -> Any:
    """The converted scenarios."""
    found = []
    for name, reader in EXPORTS.items():
        for file in survey(folder / name, reader).paths():
            for item in convert_file(file, Conversion(format=reader)):
                if isinstance(item, BadRecord):
                    if problem := complaint(item.error()):
                        raise AssertionError(problem)
                    raise item.error()
                found.append(item.record.tobytes())
    return found


def write_partial(folder: Path) -> None:
    """What a killed process leaves of a set of two finished shards."""
    partial = PartialFolder(folder / "out", IDENTITY)
    partial.open()
    (partial.content / "shard").write_text("x")
    for number, note in enumerate(NOTES):
        partial.note(number, note)
    partial.close()


def read_partial(folder: Path) -> Any:
    """The notes that a later process takes over; after damage, the first of those written, or none."""
    partial = PartialFolder(folder / "out", IDENTITY)
    notes = partial.open(restart=True)
    partial.close()
    if notes != NOTES[: len(notes)]:
        raise AssertionError(notes)
    return notes


KINDS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "set": (write_set, read_set), "table": (write_table, read_table), "run": (write_run, read_run),
    "training": (write_training, read_training), "policy": (write_policy, read_policy),
    "study": (write_study, read_study), "export": (write_export, read_export),
    "partial": (write_partial, read_partial),
}  # fmt: skip


def damage(folder: Path, rng: random.Random) -> tuple[Path, str]:
    """Damage one file of a sample: its bytes, its values, or the whole file."""
    path = rng.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
    kind = rng.random()
    if kind < 0.04:
        path.unlink()
        return path, "deleted"
    if kind < 0.08:
        other = rng.choice(sorted(other for other in folder.rglob("*") if other.is_file()))
        path.write_bytes(other.read_bytes())
        return path, f"replaced by {other.name}"
    if kind < 0.3 and path.suffix == ".json":
        mutations.json_tree(path, rng)
        return path, "values"
    mutations.raw(path, rng)
    return path, "bytes"


def outcome(
    read: Callable[[Path], Any], folder: Path, expected: str, editable: bool, edited: bool = False
) -> tuple[str, str | None]:
    """How reading ends: its kind, and what is wrong with that; ``editable`` files may have another content."""

    def compare() -> tuple[str, str | None]:
        with allow_edited(edited):
            result = content(read(folder))
        if result == expected:
            return "identical", None
        return "changed", None if editable else "read with another content"

    return attempt(compare, "detected", SECONDS_PER_FILE, MEMORY_PER_FILE)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the files of some kinds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="+", choices=KINDS)
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    return max(try_kind(kind, args.files, args.seed) for kind in args.kinds)


def try_kind(kind: str, files: int, seed: int) -> int:
    """Damage files of one kind, and print how reading them ends; return 1 if one ends badly, else 0."""
    write, read = KINDS[kind]
    ends: Counter[str] = Counter()
    changed: Counter[str] = Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        whole, folder = Path(scratch) / "whole", Path(scratch) / "damaged"
        whole.mkdir()
        write(whole)
        expected = content(read(whole))
        limit_memory(MEMORY_PER_FILE)
        for number in range(files):
            rng = random.Random(f"{seed} {kind} {number}")
            shutil.copytree(whole, folder)
            edited = number % 2 == 1
            path, how = damage(folder, rng)
            editable = path.name.endswith(OWN_TEXT + SEALED_TEXT * edited) or not EDITABLE.isdisjoint(
                path.parts
            )
            end, problem = outcome(read, folder, expected, editable, edited)
            ends[end] += 1
            changed[path.name] += end == "changed"
            if problem is not None:
                wrong.append(f"file {number} ({how} of {path.name}): {end}: {problem}")
            shutil.rmtree(folder)
    print(json.dumps({"kind": kind, "ends": ends, "changed": +changed, "wrong": len(wrong)}))
    for line in wrong[:12]:
        print(line)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
