"""Damages the files that drivax writes: detected in one line, or harmless and the same content.

    python -m fuzz.own_files KIND ... --files 200 --seed 0       (from the folder tests)

Exit status 1 when a file ended in anything else. Every second sample has no seals, so that damage reaches the parsers;
valid text of another content is accepted there, and for the user's own files (:data:`OWN_TEXT`), and counted.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax import settings
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.errors import DrivaxError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.metrics.catalogue import EVENTS
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Capacity
from drivax.scenario.select import splits
from drivax.scenario.select.selection import read_names, select_scenarios
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import SEAL, seal
from drivax.settings import load
from drivax.studies.definition import StudyDefinition
from drivax.tracking.checkpoints import pack, unpack
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import JsonLines
from fuzz import mutations
from fuzz.run import SECONDS_PER_FILE, Hang, limit_memory
from fuzz.run import _alarm as alarm
from scenes import car, straight_road

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
    ".txt",
)
OWN_TEXT = ("study.yaml",)
TREE = {
    "head": np.arange(12, dtype=np.float32).reshape(3, 4),
    "body": [np.ones(5, np.float32), np.zeros(0, np.int32)],
}


def content(value: Any) -> str:
    """A digest of nested values and arrays."""
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
            digest.update(repr(value).encode())

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
    """An evaluation of two episodes, one of which crashed, with a log of metrics."""
    (folder / "run.json").write_text(json.dumps({
        "kind": "evaluation", "planner": "p", "traffic": "idm", "data": [{"path": "s", "hash": "ab", "scenarios": 2}],
        "own_metrics": {"mine": {"unit": "m", "better": "low", "text": "t"}}, "versions": {"numpy": "2"},
    }))  # fmt: skip
    (folder / "config.yaml").write_text(
        "planner: p\nnoisy_start: false\nseeds: [1, 2]\ntask: {a: 1.5, b: null}\n"
    )
    head = "planner,dataset,scenario_id,segment,seed,traffic,success,mine"
    (folder / "episodes.csv").write_text(f"{head}\np,d,s1,,0,idm,1,0.25\np,d,s2,r,0,idm,0,\n")
    crash = {"dataset": "d", "scenario_id": "s2", "step": 3, "error": "ValueError: x"}
    (folder / "crashes.json").write_text(json.dumps([crash]))
    rng, events = np.random.default_rng(0), {f"{name}_step": np.full(2, -1, np.int16) for name in EVENTS}
    np.savez_compressed(
        folder / "trajectories.npz", scenario_id=np.array(["s1", "s2"]), start=np.array([10, 10], np.int32),
        ego=rng.random((2, 6, 4)).astype(np.float32), action=rng.random((2, 5, 2)).astype(np.float16),
        others=rng.integers(-9, 9, (2, 6, 3, 3)).astype(np.int16), **events,
    )  # fmt: skip
    log = JsonLines(folder / "metrics.jsonl")
    for step in (0, 100):
        log.write(step, {"loss": 0.5, "return": float("nan")})
    log.close()
    seal(folder, *(file.name for file in folder.iterdir()))


def read_run(folder: Path) -> Any:
    """All of an evaluation that reports show."""
    table, run = EpisodeTable.read(folder), RunFolder.open(folder)
    trajectories = table.trajectories
    crashes = [[crash.dataset, crash.scenario_id, crash.step, crash.error] for crash in table.crashes]
    return [run.info, run.settings, table.keys, dict(table.metrics), crashes, run.read_metrics(), trajectories.ego,
            trajectories.action, trajectories.start, trajectories.events, trajectories.others, table.summary(),
            list(table.own_metrics), dict(table.data)]  # fmt: skip


def write_policy(folder: Path) -> None:
    """The parameters of an exported policy."""
    pack(folder / "policy.npz", TREE)


def read_policy(folder: Path) -> Any:
    """The parameters as arrays."""
    tree = unpack(folder / "policy.npz", TREE)
    return [tree["head"], *tree["body"]]


def write_study(folder: Path) -> None:
    """The long-tail study as a file of the user."""
    (folder / "study.yaml").write_text(settings.preset("studies/longtail").read_text("utf-8"))


def read_study(folder: Path) -> Any:
    """The settings of the study."""
    return settings.dump(load(StudyDefinition, folder / "study.yaml"))


KINDS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "set": (write_set, read_set), "table": (write_table, read_table), "run": (write_run, read_run),
    "policy": (write_policy, read_policy), "study": (write_study, read_study),
}  # fmt: skip


def remove_seals(folder: Path) -> None:
    """Remove the seals of a sample, which would find damage before the parsers."""
    for file in folder.rglob(SEAL):
        file.unlink()


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
    read: Callable[[Path], Any], folder: Path, expected: str, editable: bool
) -> tuple[str, str | None]:
    """How reading ends: its kind, and what is wrong with that; ``editable`` files may have another content."""
    try:
        result = content(read(folder))
    except DrivaxError as error:
        return "detected", str(error) if "\n" in str(error) or len(str(error)) > 2000 else None
    except Hang:
        return "hang", traceback.format_exc()
    except BaseException:
        return "traceback", traceback.format_exc()
    if result == expected:
        return "identical", None
    return "changed", None if editable else "read with another content"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the files of some kinds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="+", choices=KINDS)
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    signal.signal(signal.SIGALRM, alarm)
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
        limit_memory()
        for number in range(files):
            rng = random.Random(f"{seed} {kind} {number}")
            shutil.copytree(whole, folder)
            editable = OWN_TEXT + SEALED_TEXT * (number % 2)
            if number % 2:
                remove_seals(folder)
            path, how = damage(folder, rng)
            signal.alarm(SECONDS_PER_FILE)
            end, problem = outcome(read, folder, expected, path.name.endswith(editable))
            signal.alarm(0)
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
