"""The loop, with an algorithm that compiles at once: seeds, resuming, early stops, what is refused."""

import json
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from drivax import kernels, settings
from drivax.api import evaluate, load
from drivax.cli import main
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.learning import loop, training_log, training_set
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.policies import load_policy
from drivax.learning.training_log import patience_exceeded, rank
from drivax.learning.training_set import TrainingSet
from drivax.report.runs import read_runs
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.select import splits
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import policy_training_sets, seed_folders
from drivax.tracking.sinks import read_rows
from toy_learner import VALUES, Toy, ToyConfig, ToyState

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def config():
    return settings.load(TrainConfig, VALUES)


def last_state(folder):
    return Checkpoints(folder / "checkpoints").restore(jax.eval_shape(Toy(ToyConfig()).init, None, KEY))


def numbers(state: ToyState):
    return np.asarray(state.parameters), np.asarray(jax.random.key_data(state.key)), int(state.iteration)


def test_seeds_are_runs_of_their_own(data, config, tmp_path):
    lines = []
    folder = train(config, data, tmp_path / "three", seeds=3, log=lines.append, validation=None)
    folders = seed_folders(folder.path)
    assert [path.name for path in folders] == ["seed-4", "seed-5", "seed-6"]
    assert len(lines) == 1 and lines[0].startswith("memory: ") and "scenarios" in lines[0]
    for seed, path in zip((4, 5, 6), folders, strict=True):
        alone = train(replace(config, seed=seed), data, tmp_path / f"alone-{seed}", validation=None).path
        assert settings.load(TrainConfig, path / "config.yaml") == replace(config, seed=seed)
        assert [row["step"] for row in read_rows(path / "metrics.jsonl")] == [10, 20, 30, 40, 50, 60]
        for one, other in zip(
            read_rows(path / "metrics.jsonl"), read_rows(alone / "metrics.jsonl"), strict=True
        ):
            assert one["loss/toy"] == pytest.approx(other["loss/toy"], rel=1e-6)
            assert one["loss/sum"] == pytest.approx(other["loss/sum"], rel=1e-6)
        for one, other in zip(numbers(last_state(path)), numbers(last_state(alone)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6)
    bank = ScenarioBank.from_scenarios(data)
    assert load_policy(folders[0], bank, trust=["toy_learner"])[1] == config.task
    with pytest.raises(UsageError, match=r"contains 3 seeds; name one, as .*seed-4"):
        load_policy(folder.path, bank)
    _, trainings = read_runs([folder.path])
    assert [training.name for training in trainings] == ["three/seed-4", "three/seed-5", "three/seed-6"]


def test_seeds_resume_from_their_newest_common_checkpoint(data, config, tmp_path):
    whole = train(config, data, tmp_path / "whole", seeds=2, validation=None)
    cut = train(config, data, tmp_path / "cut", seeds=2, validation=None)
    # As if the machine had gone while checkpoints were written: one seed is a checkpoint behind.
    shutil.rmtree(cut.path / "seed-5" / "checkpoints" / "step-000000060")
    resumed = train(config, data, tmp_path / "cut", resume=True)
    for path, other in zip(seed_folders(whole.path), seed_folders(resumed.path), strict=True):
        assert [row["step"] for row in read_rows(other / "metrics.jsonl")] == [10, 20, 30, 40, 50, 60]
        for one, again in zip(numbers(last_state(path)), numbers(last_state(other)), strict=True):
            np.testing.assert_array_equal(one, again)
    with pytest.raises(UsageError, match="contains 2 seeds, not 3; resume without --seeds"):
        train(config, data, tmp_path / "cut", resume=True, seeds=3)


@pytest.mark.slow
def test_run_fine_tunes_the_networks_of_another(data, config, tmp_path):
    """The toy adds random numbers of its key to its parameters: their start is the difference from a fresh run."""
    former = train(config, data, tmp_path / "former", validation=None).path
    plain = train(replace(config, total_steps=10), data, tmp_path / "plain", seeds=2, validation=None).path
    lines = []
    onward = replace(config, total_steps=10, begin_from=f"{former}@40")
    run = train(onward, data, tmp_path / "run", seeds=2, log=lines.append, validation=None)
    assert lines[1:] == [f"starts from parameters of {former}@40"]
    start_state = Checkpoints(former / "checkpoints").restore(
        jax.eval_shape(Toy(ToyConfig()).init, None, KEY), 40
    )
    pairs = list(zip(seed_folders(run.path), seed_folders(plain), strict=True))
    for path, fresh in pairs:
        parameters, key, iteration = numbers(last_state(path))
        lacks = parameters - numbers(last_state(fresh))[0]
        np.testing.assert_allclose(lacks, start_state.parameters, rtol=1e-5)
        assert iteration == 1 and (key == numbers(last_state(fresh))[1]).all()
        assert policy_training_sets(str(path)) == policy_training_sets(str(former)), "each set once"
    # Without a step it is the best; resuming from the beginning finds the same.
    run = train(replace(onward, begin_from=str(former)), data, tmp_path / "best", validation=data)
    assert (
        run.config(TrainConfig, trust=["toy_learner"]).begin_from == f"{former}@60"
        and run.info["networks_from"]["step"] == 60
    )
    before = numbers(last_state(run.path))
    shutil.rmtree(run.checkpoints)
    train(config, data, run.path, validation=data, resume=True)
    for one, again in zip(before, numbers(last_state(run.path)), strict=True):
        np.testing.assert_array_equal(one, again)
    # What does not fit is refused before a folder is created.
    wide = replace(onward, algorithm=ToyConfig(size=4))
    for wrong, words in (
        (
            wide,
            r"parameters is float32\[3\] in the checkpoint, not float32\[4\]; start from a run with the same net",
        ),
        (replace(onward, begin_from=str(tmp_path / "run")), "contains 2 seeds; name one"),
        (replace(onward, begin_from=str(tmp_path)), "not a run folder"),
        (replace(onward, begin_from=f"{former}@7"), "no checkpoint of step 7"),
        (replace(onward, begin_from="zoo:aggressive"), "is an exported policy, which cannot be fine-tuned"),
    ):
        with pytest.raises(DrivaxError, match=words):
            train(wrong, data, tmp_path / "never", validation=None)
    assert not (tmp_path / "never").exists()
    # Once there is a checkpoint, the former run is not read.
    shutil.rmtree(former)
    train(config, data, run.path, validation=data, resume=True)


@pytest.mark.slow
def test_training_stops_when_patience_is_exceeded(data, config, tmp_path):
    """The toy always drives the same: the first validation is the best, two more are waited for."""
    patient = replace(config, evaluate_every=1, patience=2, checkpoint_rule="lexicographic")
    lines = []
    run = train(patient, data, tmp_path / "run", validation=data, seeds=2, log=lines.append)
    assert lines[1:] == [f"seed {seed}: no better for 2 validations, stopped at 30 steps" for seed in (4, 5)]
    for path in seed_folders(run.path):
        rows = list(read_rows(path / "metrics.jsonl"))
        assert [row["step"] for row in rows] == [10, 20, 30]
        about = json.loads((path / "checkpoints" / "step-000000030" / "about.json").read_text())
        row = rows[-1]
        expected = [row[f"validation/{name}"] for name in ("accuracy", "progress_ratio", "comfortable")]
        assert about["score"] == expected and all(value >= 0.0 for value in expected)
    # Nothing is left to do, and resuming does nothing.
    train(patient, data, tmp_path / "run", validation=data, resume=True)
    assert [row["step"] for row in read_rows(run.path / "seed-4" / "metrics.jsonl")] == [10, 20, 30]
    with pytest.raises(UsageError, match="pass --validation"):
        train(patient, data, tmp_path / "other", validation=None)


def test_patience_ends_without_a_better_rank():
    ranks = [(0.1,), (0.5,), (0.5,), (0.4,), (0.6,)]
    assert [patience_exceeded(ranks[:n], 2) for n in range(6)] == [False, False, False, False, True, False]
    assert not patience_exceeded(ranks, 0) and not patience_exceeded([], 3)
    # Equal failures, better progress: that is better.
    assert not patience_exceeded([(0.9, 0.5, 1.0), (0.9, 0.6, 0.0)], 1)
    assert patience_exceeded([(0.9, 0.5, 0.2), (0.8, 1.0, 1.0)], 1)


def test_ranks_compare_failures_before_progress_before_comfort():
    row = {
        "validation/vmax_score": 0.7, "validation/accuracy": 0.75, "validation/progress_ratio": 0.9,
        "validation/comfortable": None, "loss/value": 3.0,
    }  # fmt: skip
    assert rank("score", row) == (0.7,)
    assert rank("success", row | {"validation/success": 0.6}) == (0.6, 0.7)
    assert rank("lexicographic", row) == (0.75, 0.9, -1.0)
    assert rank("score", {"validation/vmax_score_partial": 0.2}) == (0.2,)
    assert rank("score", {"loss/value": 3.0}) is None
    # A failure less is worth any progress, progress any comfort.
    safe, quick, smooth = (0.76, 0.1, 0.0), (0.75, 0.9, 0.0), (0.75, 0.8, 1.0)
    assert safe > quick > smooth


def test_a_run_is_never_overwritten_or_resumed_on_other_data(data, config, tmp_path):
    train(config, data, tmp_path / "run", validation=None)
    with pytest.raises(UsageError, match="--overwrite"):
        train(config, data, tmp_path / "run", validation=None)
    generate(tmp_path / "other", 1, 12, Generation(workers=0))
    other = ScenarioSet.open(tmp_path / "other")
    with pytest.raises(UsageError, match="other scenarios"):
        train(config, other, tmp_path / "run", resume=True)
    with pytest.raises(UsageError, match="same --validation"):
        train(config, data, tmp_path / "run", resume=True, validation=other)
    with pytest.raises(UsageError, match="2 devices, but there are 1"):
        train(replace(config, devices=2), data, tmp_path / "never", validation=None)
    assert not (tmp_path / "never").exists()


@pytest.mark.slow
def test_command_trains_several_seeds(data, tmp_path, capsys):
    (tmp_path / "toy.yaml").write_text(settings.dump(settings.load(TrainConfig, VALUES)))
    out = tmp_path / "out"
    arguments = ["train", str(tmp_path / "toy.yaml"), "--data", str(data.path), "--out", str(out)]
    assert main([*arguments, "--seeds", "2", "--total_steps", "20"]) == 0
    output = capsys.readouterr()
    assert "wrote" in output.out and "memory: " in output.err and (out / "seed-5" / "metrics.jsonl").is_file()
    more = ["--from", str(out / "seed-4"), "--total_steps", "10"]
    assert main([*arguments[:-1], str(tmp_path / "onward"), *more]) == 0
    assert f"starts from parameters of {out / 'seed-4'}@20" in capsys.readouterr().err
    assert main([*arguments, "--resume", *more[:2]]) == 2
    assert "a resumed run keeps its configuration; leave out --from" in capsys.readouterr().err
    assert main([*arguments[:1], "demo", *arguments[2:], "--seeds", "0", "--overwrite"]) == 2
    assert "0 seeds; use 1 or more" in capsys.readouterr().err


def test_unsuccessful_scenarios_are_split_by_reason():
    """Of five scenarios with a goal, two succeed; one is late, one fails, one fails at fault. The last has no goal."""
    values = {
        "success": np.array([1.0, 1.0, 0.0, 0.0, 0.0, np.nan]),
        "accuracy": np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
        "accuracy_at_fault": np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0]),
    }
    shares = pytest.approx({"late": 0.2, "not_at_fault": 0.2, "at_fault": 0.2})
    assert training_log._split_unsuccessful(values) == shares


def test_weights_cannot_be_added_to_a_run(data, config, tmp_path):
    weighted = TrainingSet(data, np.ones((3, 91)))
    train(config, data, tmp_path / "run", validation=None)
    with pytest.raises(UsageError, match="was trained with other weights"):
        train(config, weighted, tmp_path / "run", resume=True)


def test_training_holds_out_recordings_by_default(data, config, tmp_path, monkeypatch):
    """Of three scenarios the third is a recording of its own; the toy drives it at constant velocity."""
    lines = []
    short = replace(config, total_steps=20)
    run = train(short, data, tmp_path / "run", log=lines.append)
    assert lines[0].startswith("trains on 2 scenarios, validates on 1 (held-out recordings: 1);")
    recording = [data.entries[2][name] for name in ("dataset", "segment")]
    assert run.info["validation"] == {"recordings": [recording], "scenarios": 1}
    first, last = read_rows(run.metrics)
    assert not any(name.startswith("validation/") for name in first)
    alone = evaluate("constant_velocity", load(data[2:]), task=config.task).metrics
    for name in ("vmax_score", "accuracy", "progress_ratio"):
        assert last[f"validation/{name}"] == pytest.approx(alone[name][0], abs=1e-6)
    shares = [last[f"validation/{name}"] for name in ("success", "late", "at_fault", "not_at_fault")]
    assert sum(shares) == pytest.approx(1.0) and min(shares) >= 0.0
    seeds = train(replace(short, seed=7), data, tmp_path / "seeds", seeds=2)
    for path in (seeds.path, *seed_folders(seeds.path)):
        assert json.loads((path / "run.json").read_text())["validation"] == run.info["validation"]
    # Resuming reads the split; nothing else does.
    monkeypatch.setattr(splits, "_choose", lambda _: pytest.fail("chosen again"))
    shutil.rmtree(run.checkpoints / "step-000000020")
    resumed = train(short, data, run.path, resume=True)
    assert resumed.read_metrics()[1]["validation/accuracy"] == last["validation/accuracy"]
    for other in (None, data):
        with pytest.raises(
            UsageError, match="was validated on other scenarios or none; resume with the same --valid"
        ):
            train(short, data, run.path, resume=True, validation=other)


def test_run_without_validation_resumes_without(data, config, tmp_path):
    run = train(config, data, tmp_path / "run", validation=None)
    shutil.rmtree(run.checkpoints / "step-000000060")
    lines = []
    resumed = train(config, data, run.path, resume=True, log=lines.append)
    assert run.info["validation"] is None and len(lines) == 1 and lines[0].startswith("memory: ")
    assert not any("validation/" in name for row in resumed.read_metrics() for name in row)


def test_resuming_with_other_kernels_warns(data, config, tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "state", lambda: "AVX2, build 0123")
    run = train(config, data, tmp_path / "run", validation=None)

    def warnings(state):
        monkeypatch.setattr(kernels, "state", lambda: state)
        lines = []
        train(config, data, run.path, validation=None, resume=True, log=lines.append)
        return [line for line in lines if line.startswith("warning: ")]

    assert warnings("AVX2, build 0123") == []
    for state, name in {
        "none: make native": "none",
        "none, since DRIVAX_NATIVE=0": "none",
        "AVX-512, build 0123": "AVX-512, build 0123",
    }.items():
        (line,) = warnings(state)
        assert (
            f"the run used native kernels AVX2, build 0123, this process {name}: the result differs" in line
        )
    run = run.note(machine={"kernels": "none: make native"})
    assert warnings("none, since DRIVAX_NATIVE=0") == []
    assert len(warnings("AVX2, build 0123")) == 1
    run.note(machine=None)  # before kernels
    assert warnings("none: make native") == []


def test_resuming_on_other_devices_warns(data, config, tmp_path):
    run = train(config, data, tmp_path / "run", validation=None)
    assert run.info["devices"] == 1
    for former, warnings in ((1, 0), (2, 1), (None, 0)):
        run, lines = run.note(devices=former), []
        train(config, data, run.path, validation=None, resume=True, log=lines.append)
        lines = [line for line in lines if line.startswith("warning: ")]
        assert len(lines) == warnings
        assert all("the run used 2 devices, this process 1: the result differs" in line for line in lines)


def test_a_resumed_run_keeps_its_devices_where_there_are_as_many(data, config, tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    requested = []

    def note(seeds, experience, devices):
        requested.append(devices)
        raise Stop

    run = train(config, data, tmp_path / "run", validation=None)
    assert config.devices is None
    monkeypatch.setattr(loop, "Program", note)
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    for former in (1, 2, 3, None):
        run = run.note(devices=former)
        with pytest.raises(Stop):
            train(config, data, run.path, validation=None, resume=True)
    assert requested == [1, 2, None, 1]


class Stop(Exception):
    """Stops a training before its first iteration."""


@pytest.fixture
def calls(monkeypatch):
    """Banks and weights of trainings that stop when these are complete."""
    calls = []

    def note(algorithm, environment, bank, weights=None):
        calls.append((bank, weights))
        raise Stop

    monkeypatch.setattr(training_set, "training_data", note)
    return calls


def test_filters_select_scenarios_and_their_weights(data, config, tmp_path, calls):
    tracks = [entry["source"]["tracks"] for entry in data.entries]
    filtered = replace(config, filters=(f"tracks>={sorted(tracks)[1]}",))
    rows = [row for row, count in enumerate(tracks) if count >= sorted(tracks)[1]]
    weights = np.arange(3 * 91, dtype=float).reshape(3, 91)
    with pytest.raises(Stop):
        train(filtered, TrainingSet(data, weights), tmp_path / "run", validation=None)
    ((bank, training_weights),) = calls
    assert len(rows) == len(bank) == 2
    np.testing.assert_array_equal(training_weights, weights[rows])
    np.testing.assert_array_equal(bank.identity, ScenarioBank.from_scenarios(data).identity[np.array(rows)])
    for validation, problem in ((None, "no scenario is selected"), ("held_out", "no scenario is selected")):
        with pytest.raises(DataError, match=problem):
            train(replace(config, filters=("tracks<1",)), data, tmp_path / "run", validation=validation)
    _, validated = splits.hold_out(data.entries).training, splits.hold_out(data.entries).validation
    most = max(tracks)
    only = [row for row, count in enumerate(tracks) if count == most]
    use = "train on" if only == validated else "validate on"
    with pytest.raises(DataError, match=f"no scenario to {use} meets tracks>={most}; use weaker filters"):
        train(replace(config, filters=(f"tracks>={most}",)), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_weights_are_divided_with_the_scenarios(data, config, tmp_path, calls):
    weights = np.arange(3 * 91, dtype=float).reshape(3, 91)
    with pytest.raises(Stop):
        train(config, TrainingSet(data, weights), tmp_path / "run")
    ((bank, training_weights),) = calls
    np.testing.assert_array_equal(training_weights, weights[:2])
    jax.tree.map(np.testing.assert_array_equal, bank, ScenarioBank.from_scenarios(data[:2]))
    with pytest.raises(UsageError, match=r"weights of shape \(2, 91\) for 3 scenarios"):
        train(config, TrainingSet(data, weights[:2]), tmp_path / "run")
    assert not (tmp_path / "run").exists()
