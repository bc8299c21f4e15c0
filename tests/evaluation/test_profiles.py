"""The devkit profile: inputs from scenarios and runs, and the table of both definitions."""

import csv
import shutil
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import shapely
from scipy.sparse.csgraph import connected_components

from drivax.cli import main
from drivax.errors import DataError
from drivax.evaluation.episode_table import Crash
from drivax.evaluation.profiles import (
    TERMS,
    ProfileRow,
    _objects,
    _speeds,
    devkit_rows,
    format_rows,
    write_rows,
)
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.planners.catalogue import make_planner
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task
from scenes import GLIMPSE, SMALL, car, straight_road


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One scenario with a free road, and one with a standing car in ego's lane."""
    path = tmp_path_factory.mktemp("profiles") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for name, cars in (("free", []), ("blocked", [car(x=60.0, speed=0.0)])):
            recording = straight_road([car(speed=8.0), *cars])
            writer.add(assemble(replace(recording, scenario_id=name, segment=name), SMALL))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "constant"
    config = EvaluationConfig("constant_velocity", task=Task(observation=GLIMPSE))
    return run_evaluation(config, make_planner("constant_velocity"), data, out), out


def test_lanes_become_strips_of_their_width(data):
    scenario = data[0]
    for index, lane in enumerate(_objects(scenario)):
        assert lane.line.length == pytest.approx(float(scenario.lane_length[index]), rel=1e-3)
        width = float(scenario.lane_width[index])
        assert lane.polygon.area == pytest.approx(lane.line.length * (width if width > 0 else 3.7), rel=1e-3)
        assert shapely.contains_xy(lane.polygon, *lane.line.interpolate(5.0).coords[0])


def test_roadblocks_hold_parallel_lanes_and_connectors_of_the_same_two_blocks():
    scenario = assemble(generate_recording(seed=0, index=4))
    objects = _objects(scenario)
    lanes = [index for index, each in enumerate(objects) if not each.connector]
    assert lanes and len(lanes) < len(objects)
    adjacent = np.zeros((len(objects), len(objects)), bool)
    for index in lanes:
        for other in (scenario.lane_left[index], scenario.lane_right[index]):
            adjacent[index, other] |= other >= 0
    groups = connected_components(adjacent, directed=False)[1]
    for first, second in combinations(lanes, 2):
        assert (objects[first].block == objects[second].block) == (groups[first] == groups[second])
    ends = {
        index: (groups[each.predecessors[0]], groups[each.successors[0]])
        for index, each in enumerate(objects)
        if each.connector and {*each.predecessors[:1], *each.successors[:1]} <= set(lanes) and each.predecessors
        and each.successors
    }  # fmt: skip
    assert len(ends) > 1
    for first, second in combinations(ends, 2):
        assert (objects[first].block == objects[second].block) == (ends[first] == ends[second])


def test_hitting_a_standing_car_is_at_fault_by_both_definitions(data, run):
    table, _ = run
    free, blocked = devkit_rows(table, data)
    assert (free.scenario_id, blocked.scenario_id) == ("free", "blocked")
    assert free.devkit["score"] == pytest.approx(1.0) == free.ours["score"] and not free.differing
    assert blocked.devkit["fault_score"] == blocked.ours["fault_score"] == 0.0
    assert blocked.devkit["ttc_ok"] == blocked.devkit["score"] == 0.0


@pytest.mark.slow
def test_simulated_traffic_is_read_from_its_stored_poses(data, tmp_path):
    """The set's banks are smaller than its records, and the standing car does not move."""
    table = run_evaluation(
        EvaluationConfig("constant_velocity", traffic="idm"),
        make_planner("constant_velocity"),
        data,
        tmp_path / "idm",
    )
    assert table.trajectories.others is not None
    free, blocked = devkit_rows(table, data)
    assert free.devkit["fault_score"] == 1.0 and blocked.devkit["fault_score"] == 0.0


def test_speeds_of_stored_poses_bridge_absences():
    time_s = 0.1 * np.arange(12)
    xy = np.stack(
        [np.stack([5.0 * time_s, 0 * time_s], -1), np.stack([0 * time_s, 2.0 * time_s], -1)], axis=1
    )
    xy[:4, 1] = np.nan
    speed = _speeds(xy)
    np.testing.assert_allclose(speed[:, 0], 5.0)
    np.testing.assert_allclose(speed[4:, 1], 2.0)


def test_crashed_episodes_score_zero(data, run):
    table, _ = run
    crash = Crash(table.keys["dataset"][0], "free", 20, "error")
    free, _ = devkit_rows(replace(table, crashes=(crash,)), data)
    assert free.devkit["score"] == 0.0


def test_scenario_of_another_set_is_refused(data, run):
    table, _ = run
    moved = replace(table, keys={**table.keys, "scenario_id": ("free", "elsewhere")})
    with pytest.raises(DataError, match="record elsewhere: is not in the scenario set"):
        devkit_rows(moved, data)


@pytest.mark.parametrize("exists", [False, True])
def test_judge_does_not_write_through_a_link(data, run, tmp_path, capsys, exists):
    out, victim = tmp_path / "run", tmp_path / "victim"
    shutil.copytree(run[1], out)
    (out / "devkit.csv").unlink(missing_ok=True)
    (out / "devkit.csv").symlink_to(victim)
    if exists:
        victim.write_text("kept")
    assert main(["judge", str(out), "--overwrite"]) == 1
    assert "devkit.csv: is a symbolic link; replace the link" in capsys.readouterr().err
    assert victim.exists() == exists and (not exists or victim.read_text() == "kept")


def test_judge_writes_and_prints_both_definitions(data, run, capsys):
    _, out = run
    assert main(["judge", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "nuplan_score" in printed and "differ in" in printed and f"wrote {out / 'devkit.csv'}" in printed
    rows = list(csv.DictReader((out / "devkit.csv").read_text().splitlines()))
    assert [row["scenario_id"] for row in rows] == ["free", "blocked"]
    assert (rows[1]["drivax_fault_score"], rows[1]["devkit_fault_score"]) == ("0", "0")
    assert main(["judge", str(out)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert main(["judge", str(out), "--overwrite"]) == 0


def test_undefined_terms_are_empty_and_count_as_equal(tmp_path):
    terms = dict.fromkeys(TERMS, 1.0)
    row = ProfileRow("drivax", "a", terms | {"speed": np.nan, "ttc_ok": 0.0}, terms)
    assert row.differing == ("ttc_ok",)
    write_rows([row], tmp_path / "devkit.csv")
    (stored,) = csv.DictReader((tmp_path / "devkit.csv").read_text().splitlines())
    assert stored["drivax_speed"] == "" and stored["differ"] == "ttc_ok"
    assert "1 - offroad" in format_rows([row])
