"""Run folders contain the information that reproduces a run."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from drivax.errors import DataError, UsageError
from drivax.scenario.schema import Capacity, Scenario, SourceCounts, record_dtype
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import allow_edited, seal
from drivax.tracking import run_folder as runs
from drivax.tracking.run_folder import RunFolder


@dataclass(frozen=True)
class Config:
    lr: float = 3e-4
    hidden: tuple[int, ...] = (8, 8)


@pytest.fixture
def scenarios(tmp_path: Path) -> ScenarioSet:
    capacity = Capacity(name="tiny", agents=1, parked=1, steps=2, segments=1, features=1, lanes=1, grid=1)
    record = np.zeros((), record_dtype(capacity))
    record["scenario_id"], record["steps"], record["dt_s"] = b"one", 2, 0.1
    record["agent_valid"][:, 0], record["lane_length"] = True, 1.0
    with ScenarioWriter(tmp_path / "set", capacity) as writer:
        writer.add(Scenario(record, capacity, SourceCounts(2, 1, 1, {}, 0, 0)))
    return ScenarioSet.open(tmp_path / "set")


def test_create_and_open(tmp_path: Path, scenarios: ScenarioSet):
    config = Config(lr=1e-5)
    created = RunFolder.create(tmp_path / "run", config, data=[scenarios], seed=3)
    opened = RunFolder.open(tmp_path / "run")
    assert opened == created
    assert opened.config(Config) == config
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["seed"] == 3
    assert info["data"] == [
        {"path": str((tmp_path / "set").resolve()), "hash": scenarios.hash, "scenarios": 1}
    ]
    assert info["versions"]["jax"] == jax.__version__
    assert info["versions"]["numpy"] == np.__version__
    assert info["versions"]["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}.")
    assert info["machine"]["device"] == jax.devices()[0].device_kind
    assert info["machine"]["cpu_count"] >= 1
    assert info["command"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "set"]


def test_note_does_not_write_through_symbolic_links_of_a_stranger(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config())
    for name in ("run.json", "seal.json"):
        content = (run.path / name).read_bytes()
        (tmp_path / name).write_bytes(content)
        (run.path / name).unlink()
        (run.path / name).symlink_to(tmp_path / name)
    stored = {name: (tmp_path / name).read_bytes() for name in ("run.json", "seal.json")}
    RunFolder.open(run.path).note(result=0.5)
    assert RunFolder.open(run.path).info["result"] == 0.5
    assert {name: (tmp_path / name).read_bytes() for name in stored} == stored
    (run.path / "checkpoints").symlink_to(tmp_path)
    with pytest.raises(DataError, match=r"checkpoints: is a symbolic link; replace"):
        _ = run.checkpoints


def test_notes_are_stored_in_run_json(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config()).note(result=0.5)
    assert RunFolder.open(tmp_path / "run").info["result"] == 0.5
    assert run.info["result"] == 0.5
    assert sorted(path.name for path in run.path.iterdir()) == ["config.yaml", "run.json", "seal.json"]


def test_existing_folder_is_replaced_only_by_a_run_of_its_kind(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config())
    (run.path / "metrics.jsonl").write_text("{}")
    with pytest.raises(UsageError, match="--overwrite"):
        RunFolder.create(tmp_path / "run", Config())
    RunFolder.create(tmp_path / "run", Config(), overwrite=True)
    assert not (run.path / "metrics.jsonl").exists()
    RunFolder.create(tmp_path / "days", Config(), kind="training")
    with pytest.raises(UsageError, match="contains a run of kind training, not evaluation"):
        RunFolder.create(tmp_path / "days", Config(), overwrite=True, kind="evaluation")
    RunFolder.create(tmp_path / "days", Config(), overwrite=True, kind="seeds")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "main.tex").write_text("years of work")
    with pytest.raises(UsageError, match="is not a run folder"):
        RunFolder.create(tmp_path / "thesis", Config(), overwrite=True)
    (tmp_path / "empty").mkdir()
    RunFolder.create(tmp_path / "empty", Config())


def test_a_configuration_that_cannot_be_written_leaves_nothing(tmp_path: Path):
    @dataclass(frozen=True)
    class Odd:
        value: object = object()

    with pytest.raises(Exception, match="represent"):
        RunFolder.create(tmp_path / "run", Odd())
    assert list(tmp_path.iterdir()) == []


def test_folders_without_a_run_are_refused(tmp_path: Path):
    with pytest.raises(DataError, match=r"not a run folder: no run\.json; give a folder"):
        RunFolder.open(tmp_path)
    run = RunFolder.create(tmp_path / "run", Config())
    (run.path / "run.json").write_text("{")
    seal(run.path, "run.json")
    with pytest.raises(DataError, match=r"run\.json: is not valid JSON"):
        RunFolder.open(run.path)


@pytest.mark.parametrize(
    "values",
    [
        {"data": [{"path": "x"}]},
        {"data": {"hash": "x"}},
        {"data": [5]},
        {"networks_from": {"data": [{"path": "x"}]}},
        {"networks_from": {"data": 5}},
        {"divergence": "x"},
        {"divergence": {"step": "a", "problem": "x is NaN"}},
        {"divergence": {"problem": "x is NaN"}},
        {"divergence": {"step": 1, "problem": 1}},
        {"seeds": "x"},
        {"seeds": 1_000_000_000},
        {"seeds": -1},
        {"validation": 5},
        {"validation": {"scenarios": 1}},
        {"validation": {"recordings": [["a"]]}},
        {"validation": {"recordings": [[["a"], "b"]]}},
        {"weights": 5},
    ],
)
def test_entries_of_other_types_are_refused(tmp_path: Path, values: dict[str, Any]):
    folder = RunFolder.create(tmp_path / "run", Config(), kind="training").note(**values)
    with pytest.raises(DataError, match=r"run\.json: is damaged \(.+; run the command again") as raised:
        RunFolder.open(folder.path)
    assert "\n" not in str(raised.value)


def test_entries_of_trainings_are_read(tmp_path: Path):
    entries = [
        {"data": None, "networks_from": None, "divergence": None, "seeds": None, "validation": None},
        {
            "divergence": {"step": 10, "problem": "x is NaN"},
            "seeds": 3,
            "weights": "abc",
            "validation": "abc",
        },
        {"validation": {"recordings": [["nuplan", "log"]], "scenarios": 3}},
    ]
    run = RunFolder.create(tmp_path / "run", Config(), kind="training")
    for values in entries:
        info = RunFolder.open(run.note(**values).path).info
        assert info.items() >= values.items() and runs.training_sets(info) == []


def test_tables_of_other_programs_need_no_hash(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config(), kind="evaluation").note(data={"path": "x"})
    assert RunFolder.open(run.path).info["data"] == {"path": "x"}


def test_seeds_are_ordered_by_number_without_other_folders(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config(), kind="seeds", seeds=4)
    for name in ("seed-10", "seed-9", "seed--1", "seed-x"):
        RunFolder.create(run.path / name, Config(), kind="training")
    assert [path.name for path in runs.seed_folders(run.path)] == ["seed--1", "seed-9", "seed-10"]


def test_a_run_of_seeds_without_seeds_is_refused(tmp_path: Path):
    run = RunFolder.create(tmp_path / "run", Config(), kind="seeds", seeds=4)
    with pytest.raises(DataError, match="run: no folder seed-N"):
        runs.seed_folders(run.path)


def test_git_state_is_the_commit_of_the_package_with_its_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A temporary repository with a clean commit, a run next to it, a new file, and a change."""

    def git(*arguments: str) -> str:
        options = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "init.defaultBranch=main"]
        command = ["git", "-C", str(tmp_path), *options, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    file = tmp_path / "package" / "tracking" / "runs.py"
    file.parent.mkdir(parents=True)
    file.write_text("one")
    monkeypatch.setattr(runs, "__file__", str(file))
    assert runs.git_state(tmp_path) is None
    git("init")
    assert runs.git_state(tmp_path) is None
    git("add", str(file))
    git("commit", "-m", "one")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").write_text("beside the package")
    assert runs.git_state(tmp_path) == {"commit": git("rev-parse", "HEAD"), "changed": False}
    new, preset = file.with_name("new.py"), tmp_path / "configs" / "preset.yaml"
    preset.parent.mkdir()
    for changed in (new, preset, file):
        changed.write_text("two")
        assert runs.git_state(tmp_path) == {"commit": git("rev-parse", "HEAD"), "changed": True}
        for made in (new, preset):
            made.unlink(missing_ok=True)


def test_training_sets_of_a_planner(tmp_path):
    data = [{"path": "sets/a", "hash": "abc", "scenarios": 3}]
    for name, kind in (("policy", "training"), ("judged", "evaluation")):
        RunFolder.create(tmp_path / name, Config(), kind=kind).note(data=data)
    trained = str(tmp_path / "policy")
    assert runs.policy_training_sets(trained) == runs.policy_training_sets(f"{trained}@1000") == data
    assert runs.policy_training_sets(str(tmp_path / "judged")) == runs.policy_training_sets("idm") == []
    assert [entry["scenarios"] for entry in runs.policy_training_sets("zoo:aggressive")] == [4096]
    assert runs.policy_folder(Path("zoo:aggressive")) == runs.policy_folder("zoo:aggressive")
    # What the run learned from whose networks it began with counts too, each set once.
    former = [{"hash": "abc"}, {"path": "sets/b", "hash": "def", "scenarios": 2}]
    RunFolder.open(trained).note(networks_from={"run": "runs/a", "step": 10, "data": former})
    assert runs.policy_training_sets(trained) == [*data, former[1]]


def test_steps_of_runs(tmp_path):
    (tmp_path / "me@home").mkdir()
    for path in (str(tmp_path / "me@home"), "me@host/runs/a"):
        assert runs.run_and_step(path) == (path, None) and runs.run_and_step(f"{path}@5") == (path, 5)
    assert runs.run_and_step("runs/a") == ("runs/a", None) and runs.run_and_step("runs/a@20") == (
        "runs/a",
        20,
    )
    (tmp_path / "a@5").mkdir()
    assert runs.run_and_step(f"{tmp_path}/a@5") == (f"{tmp_path}/a@5", None)
    with pytest.raises(UsageError, match="'best' is not a checkpoint step; write RUN@STEP"):
        runs.run_and_step("runs/a@best")


@pytest.mark.parametrize("edited", ["abc", {"a": 1}, 5])
def test_edited_files_are_a_list(tmp_path: Path, edited: object):
    """The letters of a text would be noted as files."""
    run = RunFolder.create(tmp_path / "run", Config()).note(edited=edited)
    with (
        allow_edited(),
        pytest.raises(DataError, match=r"run\.json: is damaged \(edited is not of type list\)"),
    ):
        RunFolder.open(run.path)
