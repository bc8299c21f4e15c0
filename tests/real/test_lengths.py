"""Scenarios of nuPlan's 15 s from recordings of 20 s, and short logs, from the files to a trained policy."""

import json

import numpy as np
import pytest

from drivax.cli import main
from drivax.datasets.formats import detect
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import evaluate
from drivax.planners.simple import Expert
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows
from drivax.scenario.store import ScenarioSet
from drivax.tasks.task import Task
from drivax.tracking.sinks import read_rows
from scenes import GLIMPSE

TINY = [
    "--total_steps", "128", "--task.observation.agents", "2", "--task.observation.road", "0",
    "--algorithm.network.encoder.rows", "[4]", "--algorithm.network.encoder.hidden", "[8]",
    "--algorithm.network.head", "[8]",
]  # fmt: skip
BC = ["offline/bc", "--evaluate_every", "2", "--algorithm.batch", "16", "--algorithm.updates", "2", *TINY]
#: Episodes that begin later than any step of a scenario of 91 steps.
PPO = [
    "ppo", "--earliest_start", "100", "--latest_start", "140", "--algorithm.environments", "4",
    "--algorithm.unroll", "16", "--algorithm.minibatches", "1", *TINY,
]  # fmt: skip


@pytest.fixture(scope="module")
def long_set(real_data, tmp_path_factory):
    """Six scenarios of 15 s: one of Waymo, five of nuScenes."""
    out = tmp_path_factory.mktemp("long") / "set"
    source = str(real_data / "scenarionet")
    assert main(["convert", source, str(out), "--future-s", "15", "--workers", "1"]) == 0
    return ScenarioSet.open(out)


def test_recordings_of_twenty_seconds_become_scenarios_of_fifteen(long_set):
    assert (long_set.capacity.steps, long_set.capacity.name) == (161, "default-15s")
    assert [int(scenario.steps) for scenario in long_set] == [161] * 6
    assert all(scenario.audit["clean"] and scenario.audit["route_reaches_goal"] for scenario in long_set)
    assert {scenario.id.partition("@")[2] for scenario in long_set} == {"0", "40"}
    (waymo,) = (scenario for scenario in long_set if scenario.text("dataset") == "womd")
    # The car moves beyond the 8 s of other sets.
    moved = np.hypot(*np.diff(waymo.agent_xy[90:, 0], axis=0).T).sum()
    assert moved > 5.0 and waymo.agent_valid[:, 0].all()


@pytest.mark.slow
def test_real_short_logs_are_judged_to_their_last_step(real_data):
    path = next((real_data / "scenarionet").glob("sd_waymo*.pkl"))
    (recording,) = detect(path).read(path)
    first = next(windows(recording, length=161))
    # The recording ends after the window: as short as those of nuScenes' prediction task and INTERACTION.
    scenarios = [assemble(next(windows(first, length=steps))) for steps in (31, 66, 81, 91)]
    table = evaluate(Expert(), scenarios, task=Task(observation=GLIMPSE))
    assert table.metrics["last_step"].tolist() == [30, 65, 80, 90]
    assert table.metrics["steps"].tolist() == [20, 55, 70, 80]
    assert table.metrics["progress_ratio"].tolist() == pytest.approx([1.0] * 4, abs=1e-3)
    for name in ("collision", "offroad", "fde"):
        assert table.metrics[name].tolist() == [0.0] * 4, name


@pytest.mark.slow
@pytest.mark.parametrize("traffic", ["log", "idm"])
@pytest.mark.parametrize("planner", ["expert", "idm", "pdm"])
def test_planners_drive_fifteen_seconds_and_are_judged_by_the_devkits_rules(
    long_set, planner, traffic, tmp_path
):
    call = ["evaluate", "--planner", planner, "--traffic", traffic, "--data", str(long_set.path)]
    assert main([*call, "--out", str(tmp_path / "run"), "--metrics", "devkit"]) == 0
    table = EpisodeTable.read(tmp_path / "run")
    assert table.metrics["steps"].tolist() == [150] * 6
    assert table.metrics["last_step"].tolist() == [160] * 6
    assert table.trajectories.ego.shape == (6, 151, 4)
    moved = np.hypot(*np.moveaxis(np.diff(table.trajectories.ego[:, 81:, :2], axis=1), -1, 0)).sum(axis=1)
    assert moved.max() > 5.0
    rows = (tmp_path / "run" / "devkit.csv").read_text().splitlines()
    assert len(rows) == 7
    if planner == "expert" and traffic == "log":
        assert table.metrics["fde"].max() < 1e-3 and table.metrics["collision"].max() == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bc", "ppo"])
def test_policies_learn_from_fifteen_seconds(long_set, kind, tmp_path):
    data, out = str(long_set.path), tmp_path / "run"
    scores = tmp_path / "scores.npz"
    call = ["train", *(BC if kind == "bc" else PPO), "--data", data, "--out", str(out)]
    if kind == "bc":
        assert main(["curate", "kinematic", "--data", data, "--out", str(scores)]) == 0
        with np.load(scores) as stored:
            assert stored["step_score"].shape == (6, 161)
        call += ["--scores", str(scores), "--validation", data]
    assert main(call) == 0
    assert json.loads((out / "run.json").read_text())["kind"] == "training"
    values = [value for row in read_rows(out / "metrics.jsonl") for value in row.values()]
    assert values and all(value == value for value in values if isinstance(value, float))
