"""Lane changes of logged cars in a real map, counted once more from the source's own lines and neighbours."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapely.geometry import LineString, Point

from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import with_ego
from drivax.scenario.schema import CAR_LANE_KINDS, AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

SIMULATOR = Simulator(Task(rewards=RewardConfig(preset="safety", lane_change=0.1), metrics="none", ends=()))
#: From the line between two lanes to 0.3 m beyond it a car may take so many steps.
LATE = 12


@pytest.fixture(scope="module")
def recording(real_data):
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    return next(iter(WomdScenario().read(real_data / "womd/motion_data_one_scenario.tfrecord")))


def travelling(recording):
    """Rows of vehicles that are seen nearly always and travel more than 20 m."""
    tracks = recording.tracks
    rows = []
    for row in np.flatnonzero(tracks.valid[:, recording.current_step] & (tracks.kind == AgentKind.VEHICLE)):
        seen = np.flatnonzero(tracks.valid[row])
        way = np.hypot(*(tracks.xy[row, seen[-1]] - tracks.xy[row, seen[0]]))
        if len(seen) > 0.8 * tracks.valid.shape[1] and way > 20.0:
            rows.append(int(row))
    return rows


def crossings(recording, row):
    """Steps at which the nearest lane that runs a car's way becomes one that the source calls its neighbour.

    Only where the two are 2 m apart: the car is between them.
    """
    lanes = [f for f in recording.features if f.kind in CAR_LANE_KINDS and len(f.points) > 1]
    lines = [LineString(f.points[:, :2]) for f in lanes]
    beside = {f.feature_id: {*f.left_neighbours, *f.right_neighbours} for f in lanes}
    tracks, ids = recording.tracks, []
    for step in range(11, 91):
        xy, heading = tracks.xy[row, step], tracks.heading[row, step]
        best = (4.0, None)
        for feature, drawn in zip(lanes, lines, strict=True):
            distance = drawn.distance(Point(xy))
            if tracks.valid[row, step] and distance < best[0]:
                at = drawn.project(Point(xy))
                a, b = (np.array(drawn.interpolate(at + off).coords[0]) for off in (-0.5, 0.5))
                if (b - a) @ [np.cos(heading), np.sin(heading)] > 0:
                    best = (distance, feature.feature_id)
        ids.append(best[1])
    found = []
    for k in range(1, len(ids)):
        a, b = ids[k - 1], ids[k]
        if a != b and (b in beside.get(a, ()) or a in beside.get(b, ())):
            here = Point(tracks.xy[row, k + 11])
            if (
                sum(
                    drawn.distance(here)
                    for f, drawn in zip(lanes, lines, strict=True)
                    if f.feature_id in (a, b)
                )
                > 2
            ):
                found.append(k + 11)
    return found


@jax.jit
def changes(bank):
    def one(row):
        def step(state, _):
            now = logged_motion(bank, state.context, 1)
            after, _ = SIMULATOR.replay(bank, state, now, jnp.zeros(2))
            return after, after.facts.lane_changed

        return jax.lax.scan(step, SIMULATOR.reset(bank, row), None, 80)[1]

    return jax.vmap(one)(jnp.arange(len(bank)))


@pytest.mark.slow
def test_logged_lane_changes_are_found_where_they_are(recording):
    rows = travelling(recording)
    bank = ScenarioBank.from_scenarios([assemble(with_ego(recording, row)) for row in rows])
    there = np.asarray(bank.agents[:, 11:, 0, AgentColumn.VALID]) > 0
    flags = np.asarray(changes(bank)) & there
    found = {row: (np.flatnonzero(flags[i]) + 11).tolist() for i, row in enumerate(rows)}
    expected = {row: crossings(recording, row) for row in rows}
    assert sum(map(len, found.values())) >= 1
    for row in rows:
        assert len(found[row]) == len(expected[row]), (row, found[row], expected[row])
        late = np.array(found[row]) - np.array(expected[row])
        assert ((late >= 0) & (late <= LATE)).all(), (row, found[row], expected[row])
