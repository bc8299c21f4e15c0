from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.evaluation.audit import audit
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind
from drivax.synthetic.expert.violations import (
    against_traffic,
    find_violation,
    first_overlap_step,
    goes_against_traffic,
    inside,
    last_stop,
    leaves_road,
    passes,
    user_boxes,
)
from drivax.synthetic.roads.families import CurvedRoad, SignalisedJunction
from drivax.synthetic.roads.network import GRID, Control
from drivax.synthetic.roads.signals import Colour, LightGroup, SignalPlan
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.roles import Staging
from drivax.synthetic.world import WorldConfig, generate_recording

from .oracles import box_corners, shared_area, winding_number
from .staged_scenes import CAR, TIMES, WIDTH, crossed, road, scene, user

PEDESTRIAN = (0.6, 0.6, 1.75)


def cause(roles, motion, staging=None, hardest=4.0, first_step=0):
    return find_violation(roles, motion, TIMES, first_step, staging or Staging(), hardest).cause


def with_speed(motion, speed, at=30.0):
    """Ego drives along y = 0 with these speeds."""
    distance = at + np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) * 0.05)])
    xy, speeds = motion.xy.copy(), motion.speed.copy()
    xy[0], speeds[0] = np.stack([distance, np.zeros(len(distance))], axis=-1), speed
    return replace(motion, xy=xy, speed=speeds, distance_m=distance[None])


@pytest.mark.parametrize("family", [CurvedRoad(median_share=1.0), SignalisedJunction()])
@pytest.mark.parametrize("seed", range(2))
def test_inside_agrees_with_winding_numbers(family, seed):
    rng = np.random.default_rng(seed)
    network = family.build(rng, GRID)
    rings = tuple(edge.xy for edge in network.edges)
    around = np.concatenate([lane.curve.xy[::25] for lane in network.lanes])
    points = around + rng.normal(0.0, 4.0, around.shape)
    got = inside(points, rings)
    expected = [sum(winding_number(p, ring) for ring in rings) == 1 for p in points]
    assert got.tolist() == expected
    assert 0.1 < np.mean(expected) < 0.98


def test_touching_agrees_with_clipped_polygons():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-15, 15, (12, 3, 2))
    heading = rng.uniform(-4, 4, (12, 3))
    size = np.repeat(rng.uniform(1.5, 7.0, (12, 1, 2)), 3, axis=1)
    valid = rng.random((12, 3)) < 0.8
    reduced_size = size.copy()
    reduced_size[0] -= 0.2  # ego is tested with a margin of 0.1 m on each side
    cos, sin = np.cos(heading)[..., None], np.sin(heading)[..., None]
    tested = ~np.eye(12, dtype=bool)
    tested[3, 7] = tested[7, 3] = False
    got = first_overlap_step(np.concatenate([xy, cos, sin, reduced_size], axis=-1), valid, tested)
    for i in range(12):
        for j in range(i + 1, 12):
            steps = [
                t
                for t in range(3)
                if valid[i, t] and valid[j, t] and tested[i, j]
                and shared_area(
                    box_corners(xy[i, t], heading[i, t], *size[i, t]),
                    box_corners(xy[j, t], heading[j, t], *size[j, t]),
                ) > 1e-9
            ]  # fmt: skip
            assert got[i, j] == got[j, i] == (steps[0] if steps else 3)
    assert 0 < (got < 3).sum() < 12 * 11


def test_box_across_the_kerb_leaves_the_road():
    roles, motion = scene(road(), 12.0)
    box = user_boxes(motion)[0]
    assert not leaves_road(roles.network, box)
    # The kerb is 0.8 m beyond the lane's edge; the car is 1.9 m wide in a lane of 3.5 m.
    room = 0.8 + WIDTH / 2 - CAR[1] / 2
    for aside, out in ((room - 0.01, False), (room + 0.01, True)):
        moved = box.copy()
        moved[40:, 1] -= aside
        assert leaves_road(roles.network, moved) == out


def test_lines_are_passed_once_in_their_direction():
    lane = crossed(100.0, Control.SIGNAL).lanes[1]
    front = np.stack([np.arange(95.0, 105.0), np.zeros(10)], axis=-1)
    forward, back = np.zeros(10), np.full(10, np.pi)
    assert np.flatnonzero(passes(lane, front, forward)).tolist() == [5]
    assert not passes(lane, front[::-1].copy(), back).any()
    assert not passes(lane, front + np.array([0.0, 3.0]), forward).any()


def test_running_red_requires_red_before_and_after():
    network = SignalisedJunction().build(np.random.default_rng(0), GRID)
    first = network.starts[0].lane
    way = network.lanes[first].successors[0]
    path = lane_path(network, (first, way, *network.lanes[way].successors), Sway())
    line = path.spans[1].begin_m
    times = np.arange(0.0, network.signals.cycle_s, 0.1)
    colour = network.signals.colours(times, len(network.lanes))[0][:, way]
    roles, motion = scene(network, 1.2, lanes=(first, way, *network.lanes[way].successors))
    outcomes = set()
    for step in range(0, len(times) - 92, 7):
        window = times[step : step + 91]
        at = line - CAR[0] / 2 - 0.5 + np.where(np.arange(91) <= 45, 0.1 * (np.arange(91) - 45), 0.0)
        at[46:] = line - CAR[0] / 2 + 0.5 + 0.1 * np.arange(45)
        grid = path.step_m * np.arange(len(path.curve.xy))
        xy = np.stack([np.interp(at, grid, path.curve.xy[:, k]) for k in (0, 1)], axis=-1)[None]
        heading = np.interp(at, grid, path.curve.heading)[None]
        moved = replace(motion, xy=xy, heading=heading, distance_m=at[None], paths=[path])
        red = colour[step + 45] == Colour.RED and colour[step + 46] == Colour.RED
        violation = find_violation(roles, moved, window, 0, Staging(), 4.0).cause
        assert (violation == "ego_runs_red") == red
        outcomes.add(red)
    assert outcomes == {True, False}


def test_a_stop_sign_requires_standing():
    roles, motion = scene(crossed(100.0, Control.STOP), 10.0, lanes=(0, 1, 2))
    assert cause(roles, motion) == "ego_runs_stop_sign"
    # Braking with 2 m/s2 from 10 m/s takes 25 m; the front begins at 32.3 m.
    rolling, standing = np.full(91, 10.0), np.full(91, 10.0)
    falling = 10.0 - 0.2 * np.arange(51)
    distance = np.sum((falling[1:] + falling[:-1]) * 0.05)
    assert distance == pytest.approx(25.0)
    standing[:51], standing[51:56], standing[56:] = falling, 0.0, 1.5 * 0.1 * np.arange(1, 36)
    rolling[:] = np.maximum(standing, 0.8)
    at = 100.0 - 1.5 - CAR[0] / 2 - distance
    stopped = with_speed(motion, standing, at)
    assert cause(roles, stopped) == ""
    assert cause(roles, with_speed(motion, rolling, at - 4.0)) == "ego_runs_stop_sign"
    assert last_stop(roles, stopped, 0) == 58  # 1.5 m/s2 reaches 0.5 m/s after three steps
    assert last_stop(roles, motion, 7) == 7


def test_violations_of_ego():
    roles, motion = scene(road(), 12.0)
    assert cause(roles, motion) == ""
    assert cause(roles, with_speed(motion, np.full(91, 0.5))) == "ego_hardly_moves"
    valid = motion.valid.copy()
    valid[0, -1] = False
    assert cause(roles, replace(motion, valid=valid)) == "ego_leaves_map"
    braking = np.maximum(12.0 - 0.5 * np.arange(91), 0.0)
    assert cause(roles, with_speed(motion, braking)) == "ego_brakes_hard"
    assert cause(roles, with_speed(motion, braking), hardest=5.0) == ""
    opposite = replace(motion, xy=motion.xy + np.array([0.0, 2 * WIDTH]))
    assert cause(roles, opposite) == "ego_wrong_way"
    assert cause(roles, replace(motion, xy=motion.xy - np.array([0.0, 4.0]))) == "ego_leaves_road"


def test_collisions_of_ego_and_of_others():
    lane_left = [user((60.0, WIDTH)), user((40.0, WIDTH), velocity=(5.0, 0.0))]
    roles, motion = scene(road(), 12.0, lane_left)
    assert cause(roles, motion) == "others_collide"
    roles, motion = scene(road(), 12.0, [user((60.0, WIDTH)), user((62.0, WIDTH))])
    assert cause(roles, motion) == ""  # two static users are not tested
    pedestrians = [
        user((60.0, WIDTH), size=PEDESTRIAN, kind=AgentKind.PEDESTRIAN, velocity=(1.0, 0.0)),
        user((61.0, WIDTH), size=PEDESTRIAN, kind=AgentKind.PEDESTRIAN),
    ]
    roles, motion = scene(road(), 12.0, pedestrians)
    assert cause(roles, motion) == ""
    roles, motion = scene(road(), 12.0, [user((80.0, 0.0))])
    violation = find_violation(roles, motion, TIMES, 0, Staging(), 4.0)
    assert (violation.cause, violation.users) == ("ego_collides", (1,))
    # Bumpers meet when 30 + 2.3 + 0.1 + 12 t > 80 - 2.3: during the 38th step.
    assert violation.step == int(np.ceil((80.0 - 4.6 - 0.1 - 30.0) / 1.2))


def test_wrong_way_is_more_than_two_metres_in_a_second():
    network = road()
    xy = np.stack([100.0 + 0.5 * np.arange(91), np.full(91, 2 * WIDTH)], axis=-1)
    assert against_traffic(network, xy, np.zeros(91)).all()
    assert not against_traffic(network, xy, np.full(91, np.pi)).any()
    # Lane 0 leads along +x; ego moves 0.5 m each step.
    xy[:, 1] = 0.0
    for steps, wrong in ((3, False), (8, True)):
        heading = np.zeros(91)
        heading[40 : 40 + steps] = np.pi
        assert goes_against_traffic(network, xy, heading) == wrong


def test_lights_apply_to_their_own_lane():
    network = replace(
        crossed(100.0, Control.SIGNAL),
        signals=SignalPlan((LightGroup((1,), False),), ((0,),), (5.0,), offset_s=-40.0),
    )
    roles, motion = scene(network, 10.0, lanes=(0, 1, 2))
    red = network.signals.colours(TIMES, 3)[0][:, 1] == Colour.RED
    step = int((100.0 - 32.3) / 1.0)
    assert (cause(roles, motion) == "ego_runs_red") == bool(red[step] and red[step + 1])


@pytest.mark.parametrize(
    ("aside_m", "counts"), [(0.0, False), (1.8, False), (2.5, True), (WIDTH, True), (6.0, False)]
)
def test_lights_of_other_lanes_apply_off_the_route(aside_m, counts):
    # Two lanes side by side with lights only for the left one; ego is ``aside_m`` left of the middle of the right one.
    lanes = crossed(100.0, Control.SIGNAL).lanes
    left_lanes = [
        replace(
            lane,
            curve=lane.curve.parallel(WIDTH),
            successors=tuple(k + 3 for k in lane.successors),
            predecessors=tuple(k + 3 for k in lane.predecessors),
        )
        for lane in lanes
    ]
    network = replace(
        road((1, 1, 1)),
        lanes=(*lanes, *left_lanes),
        signals=SignalPlan((LightGroup((4,), False),), ((0,),), (5.0,), offset_s=-40.0),
    )
    roles, motion = scene(network, 10.0, lanes=(0, 1, 2))
    step = int((100.0 - 32.3) / 1.0)
    outcomes = set()
    for offset_s in np.arange(0.0, 40.0, 4.0):
        plan = replace(network.signals, offset_s=float(-offset_s))
        red = plan.colours(TIMES, 6)[0][:, 4] == Colour.RED
        moved = replace(motion, xy=motion.xy + np.array([0.0, aside_m]))
        roles = replace(roles, network=replace(network, signals=plan))
        outcomes.add(bool(red[step] and red[step + 1]))
        violation = cause(roles, moved) == "ego_runs_red"
        assert violation == (counts and bool(red[step] and red[step + 1])), (offset_s, cause(roles, moved))
    assert outcomes == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "index"), [("grid", 657), ("ring", 154)])
def test_no_expert_passes_a_stalled_car_over_the_line_of_a_red_light(domain, index):
    scenario = assemble(generate_recording(1, index, WorldConfig(domain=domain, rare_rate=1.0)))
    assert audit([scenario])[0]["log_runs_red"] is False
