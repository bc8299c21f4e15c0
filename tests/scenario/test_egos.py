"""Further egos: their selection; their routes are those of a recording with another ego."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from drivax.datasets.conversion import Conversion
from drivax.errors import DataError, UsageError
from drivax.scenario.bank.columns import LaneRow, LightRow
from drivax.scenario.bank.queries import in_corridor
from drivax.scenario.bank.scenario_bank import PER_EGO, ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.manifest import field_table
from drivax.scenario.recording import with_ego
from drivax.scenario.schema import CAPACITIES, AgentKind, Capacity, Flag, find_impossible
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.synthetic.generate import Generation, generate
from drivax.synthetic.world import generate_recording
from scenes import RED, car, straight_road

SMALL = replace(CAPACITIES["default"], name="small", agents=40, parked=24)
EGOS = SMALL.with_egos(4)


@pytest.fixture(scope="module")
def recordings():
    """A junction with lights, and a straight road with two lanes and a light."""
    cars = [car(0, 0, 0, 10), car(-20, 0, 0, 9), car(10, 3.7, 0, 12)]
    return [generate_recording(0, 8), straight_road(cars, RED)]


@pytest.fixture(scope="module")
def scenarios(recordings):
    return [assemble(recording, EGOS) for recording in recordings]


def further_egos(recordings, scenarios):
    """Each further ego: index of its scenario, its number, and the scenario in which it is the recorded ego."""
    for index, (recording, scenario) in enumerate(zip(recordings, scenarios, strict=True)):
        for k, slot in enumerate(scenario.ego_slot.tolist()):
            if slot >= 0:
                (row,) = np.flatnonzero(recording.tracks.track_id == scenario.agent_id[slot])
                yield index, k, assemble(with_ego(replace(recording, route_lanes=()), int(row)), SMALL)


def ids(lanes, scenario):
    """Source ids of lanes, -1 for none."""
    return np.append(scenario.lane_id, -1)[lanes]


def test_routes_are_those_of_a_recording_with_this_ego(recordings, scenarios):
    compared = 0
    for index, k, own in further_egos(recordings, scenarios):
        scenario, count = scenarios[index], int(own.route_points[0])
        shift = (own.origin - scenario.origin)[:2]
        assert count == scenario.ego_route_points[k]
        assert scenario.ego_on_lanes[k] == bool(own.has & Flag.ROUTE)
        np.testing.assert_allclose(
            scenario.ego_route_xy[k, :count], own.route_xy[0, :count] + shift, atol=1e-3
        )
        for name in ("heading", "limit"):
            stored = getattr(scenario, f"ego_route_{name}")[k, :count]
            np.testing.assert_allclose(stored, getattr(own, f"route_{name}")[0, :count], atol=1e-3)
        lanes = scenario.ego_route_lane[k, :count], own.route_lane[0, :count]
        np.testing.assert_array_equal(*map(ids, lanes, (scenario, own)))
        last = int(scenario.ego_last_step[k])
        np.testing.assert_allclose(
            scenario.ego_log_progress[k, : last + 1], own.log_progress[: last + 1], atol=1e-2
        )
        if last == 90:
            np.testing.assert_allclose(scenario.ego_goal_xy[k], own.goal_xy + shift, atol=1e-2)
            compared += 1
    assert compared >= 4


def test_light_arcs_and_corridors_are_those_of_the_route(recordings, scenarios):
    bank, at_light = ScenarioBank.from_scenarios(scenarios), 0
    for index, k, own in further_egos(recordings, scenarios):
        alone = ScenarioBank.from_scenarios([own])
        arc, own_arc = bank.light_line[index, LightRow.ARC + k + 1], alone.light_line[0, LightRow.ARC]
        known, own_known = (np.asarray(values[values < 1e5]) for values in (arc, own_arc))
        np.testing.assert_allclose(np.sort(known), np.sort(own_known), atol=1e-2)
        at_light += len(known)
        corridors = []
        for each, number, row in ((bank, index, 4 * index + k + 1), (alone, 0, 0)):
            lanes = np.asarray(each.lanes[number])
            inside = np.asarray(in_corridor(each, jnp.asarray(lanes), row)) & (lanes[LaneRow.X_A] < 1e5)
            lane_ids = (scenarios[index] if each is bank else own).lane_id
            corridors.append(set(lane_ids[lanes[LaneRow.LANE, inside].astype(int)].tolist()))
        assert corridors[0] == corridors[1] and corridors[0]
    assert at_light >= 3


def test_rows_of_a_bank_and_of_its_parts(scenarios):
    bank = ScenarioBank.from_scenarios(scenarios)
    assert bank.most_egos == 4 and bank.egos[:, 0].tolist() == [0, 0]
    assert all(len(getattr(bank, name)) == 8 for name in PER_EGO)
    part = bank.part(jnp.array([1, 1, 0]))
    for name in PER_EGO:
        values = np.asarray(getattr(bank, name)).reshape(2, 4, -1)
        np.testing.assert_array_equal(np.asarray(getattr(part, name)).reshape(3, 4, -1), values[[1, 1, 0]])
    slot = int(bank.egos[1, 2])
    assert [int(bank.row_of(1, number)) for number in (slot, 0, 39)] == [6, 4, 4]
    assert int(bank.ego_slot(jnp.array(6))) == slot and int(bank.ego_number(jnp.array(6))) == 2
    # Two cars move besides ego; the third row is empty.
    assert bank.egos[1].tolist()[3] == -1 and bank.route_points[7] == 0


def test_first_egos_of_a_set_keep_their_bank(recordings, scenarios):
    """The recorded ego has the route, lights and corridor that it has without further egos."""
    bank = ScenarioBank.from_scenarios(scenarios)
    alone = ScenarioBank.from_scenarios([assemble(recording, SMALL) for recording in recordings])
    for name in ("goal", "log_progress", "log_ahead", "last_step", "on_lanes", "route_points"):
        np.testing.assert_array_equal(getattr(bank, name)[::4], getattr(alone, name), err_msg=name)
    np.testing.assert_array_equal(bank.routes[::4, ..., :6], alone.routes[..., :6])
    np.testing.assert_array_equal(bank.light_line[:, :10], alone.light_line)
    np.testing.assert_array_equal(bank.agents, alone.agents)


def test_a_long_further_ego_is_marked():
    cars = [car(0, 0, 0, 10), car(40, 0, 0, 10, length=11.0, width=2.5)]
    bank = ScenarioBank.from_scenarios([assemble(straight_road(cars), SMALL.with_egos(2))])
    assert bank.long_ego
    assert not ScenarioBank.from_scenarios([assemble(straight_road(cars), SMALL)]).long_ego


def test_egos_are_moving_vehicles_near_ego_with_an_unbroken_log():
    steps, upto = range(91), {step: [*range(step + 1)] for step in (29, 30, 50)}
    cars = [
        car(0, 0, 0, 10), car(40, 0, 0, 10), car(-15, 3.7, 0, 10, steps=upto[30]), car(20, 3.7, 0, 10, steps=upto[29]),
        car(-30, 0, 0, 0.2), car(15, 0, 0, 10, kind=AgentKind.CYCLIST), car(-45, 0, 0, 10, steps=range(11, 91)),
        car(60, 3.7, 0, 10, steps=[*upto[50], *steps[60:]]), car(150, 0, 0, 30, steps=steps),
    ]  # fmt: skip
    scenario = assemble(straight_road(cars), SMALL.with_egos(8))
    # The car that starts at 150 m leaves the surroundings of ego's log (80 m ahead of 80 m) within 2 s.
    order = [int(scenario.agent_id[slot]) - 100 for slot in scenario.ego_slot if slot >= 0]
    assert order == [2, 1, 7]
    assert scenario.ego_last_step[:3].tolist() == [30, 90, 50]
    assert (
        assemble(straight_road(cars), SMALL.with_egos(3)).ego_slot.tolist() == scenario.ego_slot[:2].tolist()
    )


def test_a_capacity_of_one_ego_stores_what_it_always_did():
    assert Capacity().with_egos(1) == Capacity() and EGOS.with_egos(4) is EGOS
    assert EGOS.with_egos(1).egos == 1
    # Computed by the version before sets could have further egos.
    table = json.dumps(field_table(Capacity())).encode()
    assert hashlib.sha256(table).hexdigest().startswith("c983bc0aaf54f38f")
    for wrong in (0, 9):
        with pytest.raises(UsageError, match=f"egos is {wrong}; use 1 to 8"):
            Capacity().with_egos(wrong)


def test_sets_with_further_egos_are_read_as_written(scenarios, tmp_path):
    with ScenarioWriter(tmp_path / "set", EGOS) as writer:
        for scenario in scenarios:
            writer.add(scenario)
    opened = ScenarioSet.open(tmp_path / "set")
    assert opened.capacity == EGOS and opened.capacity.name == "small-4egos"
    for stored, scenario in zip(opened, scenarios, strict=True):
        np.testing.assert_array_equal(stored.ego_route_xy, scenario.ego_route_xy)
        np.testing.assert_array_equal(stored.ego_slot, scenario.ego_slot)


def test_conversion_and_generation_store_further_egos(tmp_path):
    generated = generate(tmp_path / "set", 1, 0, Generation(egos=3))
    (scenario,) = ScenarioSet.open(generated.path)
    assert scenario.capacity == CAPACITIES["default"].with_egos(3) and len(scenario.ego_slot) == 2
    assert Conversion(egos=3).sizes == scenario.capacity
    for options in (Generation(egos=9), Conversion(egos=9)):
        with pytest.raises(UsageError, match="egos is 9; use 1 to 8"):
            options.check()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 0), ("steps", 32_000), ("current_step", -1), ("current_step", 30_000), ("dt_s", 0.0),
        ("dt_s", np.nan), ("segment_blocks", (0, 2, 5, 1 << 30)), ("segment_blocks", (0, 5, 2, 7)),
        ("segment_blocks", (-1, 2, 5, 7)), ("route_lane", -32_768), ("route_points", 32_000), ("light_lane", 500),
        ("road_rows", -3), ("ego_slot", 4_000), ("ego_last_step", 9_000), ("ego_route_lane", -9),
        ("segment_lane", 10), ("segment_feature", 30_000), ("lane_successor", -2), ("lane_left", 50),
        ("stop_lane", 50), ("grid_edge", -1), ("grid_lane", 30_000), ("agent_kind", 6), ("segment_kind", 21),
        ("agent_xy", np.nan), ("route_z", np.inf), ("segment_b", 1e30), ("agent_valid", False),
    ],
)  # fmt: skip
def test_records_that_no_scenario_has_are_refused(tmp_path: Path, name: str, value: Any):
    """Such a set has valid checksums: someone made it. Arrays are sized and indexed by these numbers."""
    scenario = assemble(straight_road([car(), car(20.0)]), SMALL.with_egos(2))
    record = scenario.record.copy()
    assert find_impossible(record) is None
    record[name] = value
    with ScenarioWriter(tmp_path / "set", scenario.capacity) as writer:
        writer.add(replace(scenario, record=record))
    for verify in (True, False):
        with pytest.raises(DataError, match=f"record 0: {name} "):
            ScenarioSet.open(tmp_path / "set", verify=verify)[0]
