from __future__ import annotations

import shutil

import numpy as np
import pytest

from drivax.errors import DataError, UsageError
from drivax.report.episodes import EpisodeGroup, rollouts_of
from drivax.report.runs import read_runs

from .conftest import redescribe


def test_evaluations_and_trainings_are_read(runs, scenarios):
    evaluations, trainings = read_runs(runs)
    assert [run.name for run in evaluations] == ["expert", "constant", "policy"]
    policy = evaluations[-1]
    assert len(policy) == 8 and policy.traffic == "log" and policy.data["hash"] == scenarios.hash
    np.testing.assert_array_equal(policy.metrics["collision"], [0, 1, 0, 0, 0, 1, 0, 0])
    assert np.isnan(policy.metrics["red_light"][::3]).all() and policy.metrics["red_light"][4] == 1
    assert "seed" not in policy.metrics
    row = policy.keys["scenario_id"].index("hand-03")
    assert policy.trajectories.events["offroad"][row] == 40
    assert policy.trajectories.ego.shape == (8, 81, 4)
    curves = trainings[0].curves
    assert set(curves) == {"rollout/success", "loss/policy"}
    np.testing.assert_allclose(curves["rollout/success"][3], (300, 0.15))
    assert len(curves["loss/policy"]) == 20, "half a last row is left out"


def test_repeated_names_get_the_folder_as_suffix(runs):
    redescribe(runs[1], planner="expert")
    evaluations, _ = read_runs(runs)
    assert [run.name for run in evaluations] == ["expert", "expert (constant)", "policy"]


def test_training_runs_of_the_same_folder_name_have_distinct_names(runs, tmp_path):
    folders = [
        tmp_path / name for name in ("bc/seed-0", "bc/seed-1", "ppo/seed-0", "a/ppo", "b/ppo", "c/ppo")
    ]
    for folder in folders:
        shutil.copytree(runs[-1], folder)
    _, trainings = read_runs(folders)
    assert [run.name for run in trainings] == [
        "bc/seed-0", "bc/seed-1", "ppo/seed-0", "ppo", "ppo (b/ppo)", "ppo (c/ppo)",
    ]  # fmt: skip


def test_repeated_scenarios_keep_their_trajectories(runs):
    folder = runs[0]
    lines = (folder / "episodes.csv").read_text().splitlines()
    (folder / "episodes.csv").write_text("\n".join([*lines, lines[1].replace(",0,log", ",1,log", 1)]) + "\n")
    with np.load(folder / "trajectories.npz") as stored:
        arrays = {name: np.concatenate((array, array[:1] + (name == "ego"))) if name != "scenario_id"
                  else np.append(array, array[0]) for name, array in stored.items()}  # fmt: skip
    np.savez(folder / "trajectories.npz", **arrays)
    run = read_runs([folder])[0][0]
    assert run.keys["scenario_id"][0] == run.keys["scenario_id"][8] == "hand-00"
    np.testing.assert_array_equal(run.trajectories.ego[8], run.trajectories.ego[0] + 1)


def test_actions_are_nan_in_runs_without_them(runs, scenarios):
    run = read_runs([runs[2]])[0][0]
    assert run.trajectories.action.shape == (8, 80, 2)
    choice = EpisodeGroup("hand", "hand-03", (3,), "offroad")
    (drive,) = rollouts_of([run], choice, scenarios[3])
    assert np.isnan(drive.action[:10]).all() and np.isnan(drive.action[90]).all()
    np.testing.assert_allclose(drive.action[10:90, 0], np.sin(np.arange(80) / 7.0), atol=1e-3)
    with np.load(runs[2] / "trajectories.npz") as stored:
        arrays = {name: array for name, array in stored.items() if name != "action"}
    np.savez(runs[2] / "trajectories.npz", **arrays)
    (drive,) = rollouts_of(read_runs([runs[2]])[0], choice, scenarios[3])
    assert np.isnan(drive.action).all(), "a run of before there were any"


def test_episodes_begin_within_their_scenario(runs, scenarios):
    _start(200)(runs[2])
    choice = EpisodeGroup("hand", "hand-03", (3,), "offroad")
    with pytest.raises(DataError, match="record hand-03: the episode begins at step 200 of 91"):
        rollouts_of(read_runs([runs[2]])[0], choice, scenarios[3])


def _remove(name):
    return lambda folder: (folder / name).unlink()


def _write(name, text):
    return lambda folder: (folder / name).write_text(text)


def _cut(name):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:200])


def _edit(name, old, new):
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new, 1))


def _shapes(folder):
    with np.load(folder / "trajectories.npz") as stored:
        arrays = dict(stored)
    np.savez(folder / "trajectories.npz", **(arrays | {"start": arrays["start"][:3]}))


def _lacks(folder):
    with np.load(folder / "trajectories.npz") as stored:
        arrays = dict(stored)
    del arrays["offroad_step"]
    np.savez(folder / "trajectories.npz", **arrays)


def _start(step):
    def change(folder):
        with np.load(folder / "trajectories.npz") as stored:
            arrays = dict(stored)
        np.savez(folder / "trajectories.npz", **(arrays | {"start": arrays["start"] * 0 + step}))

    return change


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_start(-1), "trajectories.npz: cannot be read (an episode begins at step -1)"),
        (_start(40_000), "trajectories.npz: cannot be read (an episode begins at step 40000)"),
        (_remove("run.json"), "not a run folder: no run.json"),
        (_remove("episodes.csv"), "episodes.csv: file not found"),
        (_remove("trajectories.npz"), "trajectories.npz: file not found"),
        (_write("run.json", "{"), "not valid JSON"),
        (_write("run.json", "[1]"), "not a JSON object"),
        (_write("run.json", '{"kind": "study"}'), "of kind 'study'"),
        (_write("episodes.csv", ""), "lacks the column 'planner'"),
        (_edit("episodes.csv", "segment", "recording"), "lacks the column 'segment'"),
        (_edit("episodes.csv", ",vmax_score", ",accuracy"), "names a column twice"),
        (_edit("episodes.csv", "log,0", "log,yes"), "record 1: collision is 'yes'"),
        (_edit("episodes.csv", "log,0", "log,inf"), "record 1: collision is infinite"),
        (_edit("episodes.csv", "log,0", "log,0,0"), "record 1: has"),
        (_cut("trajectories.npz"), "not an .npz file, or damaged"),
        (
            _write("crashes.json", '[{"dataset": "hand"}]'),
            "crashes.json: cannot be read (lacks 'scenario_id')",
        ),
        (_shapes, "disagree in shape"),
        (_lacks, "lacks 'offroad_step'"),
    ],
)
def test_damaged_files_are_errors_with_a_cure(runs, damage, words):
    damage(runs[0])
    with pytest.raises(DataError) as caught:
        read_runs(runs)
    assert words in str(caught.value) and caught.value.cure and str(runs[0]) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_evaluation_without_episodes_is_refused(runs):
    path = runs[0] / "episodes.csv"
    path.write_text(path.read_text().splitlines()[0] + "\n")
    with pytest.raises(DataError, match="no episodes"):
        read_runs(runs)


def test_damaged_training_log_is_an_error(runs):
    log = runs[-1] / "metrics.jsonl"
    log.write_text(log.read_text().replace('"step": 300', '"stop": 300'))
    with pytest.raises(DataError, match="record 4: not a metrics row"):
        read_runs(runs)
    log.unlink()
    with pytest.raises(DataError, match=r"metrics\.jsonl: file not found"):
        read_runs(runs)


def test_runs_must_exist_and_be_given_once(runs, tmp_path):
    with pytest.raises(UsageError, match="once"):
        read_runs([runs[0], tmp_path / "x" / ".." / runs[0].name])
    with pytest.raises(UsageError):
        read_runs([])
    with pytest.raises(DataError, match="run folder not found"):
        read_runs([tmp_path / "nowhere"])
