from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.geometry.boxes import overlap
from drivax.scenario.schema import AgentKind, RoadKind
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.cast import Cast, Motion, Override, Scripted, Staging, Tailgate
from drivax.synthetic.curves import Pose, straight, turn
from drivax.synthetic.drafting import Draft
from drivax.synthetic.drivers import Drivers
from drivax.synthetic.events import SCRIPTS, SEVERITY_MPS2, EventKind, possible, stage, stage_any
from drivax.synthetic.events.leading import leader_requires
from drivax.synthetic.events.merging import cut_in_gap
from drivax.synthetic.events.threat import required_deceleration, waiting_room
from drivax.synthetic.paths import Sway, lane_path
from drivax.synthetic.population import Density, drawn_drivers
from drivax.synthetic.roads import Control, Line, RoadNetwork
from drivax.synthetic.signals import LightGroup, SignalPlan
from drivax.synthetic.traffic import Traffic

FIRST, STEPS = 60, 151
CURRENT = FIRST + 10


def drivers(count):
    """Everybody the same."""
    values = {f.name: np.full(count, 1.5) for f in dataclasses.fields(Drivers)}
    values["size_m"] = np.tile([4.8, 2.0, 1.6], (count, 1))
    if "kind" in values:
        values["kind"] = np.full(count, AgentKind.VEHICLE, np.int8)
    return Drivers(**values)


def scene(network, routes, at, speed, parked=()):
    """Everybody drives along a sequence of lanes at constant speed; the first is ego."""
    paths = [lane_path(network, route, Sway()) for route in routes]
    times = np.arange(STEPS) * 0.1
    distance = np.array(at, float)[:, None] + np.array(speed, float)[:, None] * times
    xy, heading = np.zeros((len(at), STEPS, 2)), np.zeros((len(at), STEPS))
    for i, path in enumerate(paths):
        along = np.arange(len(path.curve.xy)) * path.step_m
        for k in (0, 1):
            xy[i, :, k] = np.interp(distance[i], along, path.curve.xy[:, k])
        heading[i] = np.interp(distance[i], along, path.curve.heading)
    table = drivers(len(at))
    users = len(at) + len(parked)
    cast = Cast(network, paths, table, distance[:, 0], np.array(speed, float), routes[0], (), tuple(parked))
    motion = Motion(
        kind=np.full(users, AgentKind.VEHICLE, np.int8),
        size_m=np.concatenate([table.size_m, *(np.array([p.size_m]) for p in parked)]),
        xy=np.concatenate([xy, *(p.xy[None] for p in parked)]),
        heading=np.concatenate([heading, *(p.heading[None] for p in parked)]),
        speed=np.concatenate(
            [np.tile(np.array(speed, float)[:, None], STEPS), np.zeros((len(parked), STEPS))]
        ),
        valid=np.ones((users, STEPS), bool),
        distance_m=distance,
        acceleration=np.zeros_like(distance),
        paths=paths,
    )
    return cast, motion


def road(lanes=2, ends=False, limit=14.0):
    """One direction along +x, 600 m, lane 0 at y = 0, others to its left; lane 1 may end at 250 m."""
    draft = Draft()
    for k in range(lanes):
        length = 250.0 if ends and k == 1 else 600.0
        draft.lane(straight(Pose(0.0, 3.5 * k, 0.0), length), 3.5, limit)
        if k:
            draft.beside(k, k - 1)
    built = list(draft.lanes)
    if ends:
        built[1] = dataclasses.replace(built[1], ends=True)
    low, high = -3.0, 3.5 * lanes - 0.5
    edge = np.array([[-5.0, low], [605.0, low], [605.0, high], [-5.0, high]])
    return RoadNetwork("test", tuple(built), (Line(RoadKind.EDGE_BOUNDARY, edge),))


def junction(turning):
    """Ego goes east through a junction at 160 to 190 m; somebody crosses from the south or turns left."""
    draft = Draft()
    control = Control.NONE if turning else Control.SIGNAL
    arm = draft.lane(straight(Pose(0.0, 0.0, 0.0), 160.0), 3.5, 14.0)
    way = draft.lane(straight(Pose(160.0, 0.0, 0.0), 30.0), 3.5, 14.0, connector=True, control=control)
    out = draft.lane(straight(Pose(190.0, 0.0, 0.0), 300.0), 3.5, 14.0)
    if turning:
        begin = Pose(190.0, 3.5, math.pi)
        other = draft.lane(straight(Pose(390.0, 3.5, math.pi), 200.0), 3.5, 14.0)
        bend = turn(begin, math.pi / 2, 13.0)
    else:
        begin = Pose(175.0, -15.0, math.pi / 2)
        other = draft.lane(straight(Pose(175.0, -215.0, math.pi / 2), 200.0), 3.5, 14.0)
        bend = straight(begin, 30.0)
    cross = draft.lane(bend, 3.5, 14.0, connector=True, control=Control.YIELD if turning else control)
    far = draft.lane(straight(bend.end, 150.0), 3.5, 14.0)
    for a, b in ((arm, way), (way, out), (other, cross), (cross, far)):
        draft.link(a, b)
    lanes = list(draft.lanes)
    if turning:
        lanes[cross] = dataclasses.replace(lanes[cross], yields_to=(way,))
    groups = (LightGroup((way,), False), LightGroup((cross,), False))
    signals = None if turning else SignalPlan(groups, ((0,), (1,)), (60.0, 10.0), offset_s=-20.0)
    return RoadNetwork("test", tuple(lanes), (), signals=signals), (arm, way, out)


def parked_row():
    """Cars beside the road every 9 m, 2.6 m to the right of ego's way."""
    poses = [Pose(60.0 + 9.0 * k, -2.7, 0.0) for k in range(30)]
    return [Scripted.standing(AgentKind.VEHICLE, (4.4, 1.8, 1.5), pose, STEPS) for pose in poses]


def occasion(kind, rng):
    """A scenario with an occasion for a kind of event."""
    v = float(rng.uniform(9.0, 13.0))
    if kind in (EventKind.LEAD_BRAKES, EventKind.TAILGATER):
        gap = 4.8 + float(rng.uniform(1.0, 1.6)) * v
        return scene(road(), [(0,), (0,), (0,)], [60.0, 60.0 + gap, 60.0 - 25.0], [v] * 3)
    if kind == EventKind.LATE_MERGE:
        return scene(road(ends=True), [(0,)], [240.0 - v * float(rng.uniform(9.0, 10.5))], [v])
    if kind in (EventKind.RED_LIGHT_RUNNER, EventKind.TURN_CONFLICT):
        network, route = junction(kind == EventKind.TURN_CONFLICT)
        return scene(network, [route], [166.0 - v * float(rng.uniform(9.5, 10.5))], [v])
    if kind == EventKind.FROM_BEHIND_PARKED:
        return scene(road(), [(0,)], [60.0], [v], parked_row())
    return scene(road(), [(0,)], [60.0], [v])


def predicted(motion, staged):
    """How the actor goes: as told, or braking from the given step on along its way."""
    if staged.staging.extras:
        return staged.staging.extras[0]
    (override,) = staged.staging.overrides
    row, a = override.vehicle, -override.acceleration_mps2
    t = np.maximum(np.arange(STEPS) - override.first_step, 0) * 0.1
    v = motion.speed[row, 0]
    t = np.minimum(t, v / a)
    x = motion.xy[row, np.minimum(np.arange(STEPS), override.first_step), 0] + v * t - a * t**2 / 2
    xy = np.stack([x, motion.xy[row, :, 1]], axis=-1)
    size = tuple(motion.size_m[row].tolist())
    return Scripted(AgentKind.VEHICLE, size, xy, motion.heading[row], v - a * t, motion.valid[row])


def march(motion, actor, begin, deceleration, start, speed):
    """Marches ego (on a straight way along +x) in steps of 10 ms; whether its box and the actor's ever overlap.

    Returns also the least time, on a grid of 50 ms, after which both would overlap at constant velocities.
    """
    fine = np.arange(0.0, (FIRST + 90 - begin) * 0.1, 0.01)
    index = begin + fine / 0.1
    low = np.minimum(index.astype(int), STEPS - 2)
    share = (index - low)[:, None]
    xy = actor.xy[low] + share * (actor.xy[low + 1] - actor.xy[low])
    heading = actor.heading[low]
    valid = actor.valid[low] & actor.valid[low + 1]
    t = np.minimum(fine, speed / deceleration) if deceleration else fine
    x = start + speed * t - deceleration * t**2 / 2
    y = float(motion.xy[0, 0, 1])
    length, width = motion.size_m[0, :2]
    n = len(fine)

    def box(xy, heading, size):
        return np.column_stack([xy, np.cos(heading), np.sin(heading), np.tile(size, (n, 1))])

    hit, ttc = False, math.inf
    velocity = np.gradient(xy, 0.01, axis=0)
    ego_speed = np.maximum(speed - deceleration * fine, 0.0)
    for ahead in np.arange(0.0, 1.001, 0.05):
        ego = box(np.column_stack([x + ego_speed * ahead, np.full(n, y)]), np.zeros(n), [length, width])
        met = bool(np.any(overlap(ego, box(xy + velocity * ahead, heading, actor.size_m[:2])) & valid))
        hit = met if ahead == 0.0 else hit
        ttc = min(ttc, float(ahead)) if met else ttc
    return hit, ttc


def followed(actor, start, speed, until):
    """Where ego is, and its speed, when it has kept its distance from a car ahead since that is there."""
    law, wanted = IdmParameters(2.0, 1.5, 1.5, 1.5), speed
    begin = int(np.argmax(actor.valid))
    x, v = start - speed * 0.1 * (until - begin), speed
    for t in range(begin, until):
        gap = actor.xy[t, 0] - actor.size_m[0] / 2 - x - 2.4
        a = idm_acceleration(np.array(v), np.array(wanted), np.array(gap), np.array(actor.speed[t]), law)
        after = v + max(float(a), -6.0) * 0.1
        x, v = x + (v + after) * 0.05, after
    return x, v


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_an_ego_that_keeps_its_speed_meets_the_actor_and_one_that_brakes_as_required_does_not(kind):
    staged_count, close, severities = 0, 0, []
    for seed in range(14):
        rng = np.random.default_rng([int(kind), seed])
        cast, motion = occasion(kind, rng)
        staged = stage(kind, cast, motion, FIRST, rng)
        if staged is None:
            continue
        staged_count += 1
        assert staged.kind == kind
        assert FIRST + 12 <= staged.first_step < staged.last_step <= FIRST + 90
        assert SEVERITY_MPS2[0] <= staged.severity_mps2 <= SEVERITY_MPS2[1]
        severities.append(staged.severity_mps2)
        actor = predicted(motion, staged)
        begin, v = staged.first_step, float(motion.speed[0, 0])
        start = float(motion.xy[0, begin, 0])
        if kind == EventKind.STALLED_VEHICLE:
            start, v = followed(actor, start, v, begin)
        hit, ttc = march(motion, actor, begin, 0.0, start, v)
        close += hit or ttc < 1.0
        assert not march(motion, actor, begin, 1.1 * staged.severity_mps2 + 0.2, start, v)[0]
        assert march(motion, actor, begin, 0.85 * staged.severity_mps2 - 0.1, start, v)[0]
    assert staged_count >= 7
    assert close >= 0.8 * staged_count
    assert np.ptp(severities) > 0.2


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_actors_are_plausible(kind):
    for seed in range(8):
        rng = np.random.default_rng([int(kind), seed])
        cast, motion = occasion(kind, rng)
        staged = stage(kind, cast, motion, FIRST, rng)
        if staged is None:
            continue
        for override in staged.staging.overrides:
            assert -8.0 <= override.acceleration_mps2 < -3.6
            assert (override.first_step, override.last_step) == (staged.first_step, staged.last_step)
        for extra in staged.staging.extras:
            there = np.flatnonzero(extra.valid)
            assert np.all(np.diff(there) == 1) and extra.xy.shape == (STEPS, 2)
            xy = extra.xy[there]
            speed = np.hypot(*np.diff(xy, axis=0).T) / 0.1
            acceleration = np.diff(xy, n=2, axis=0) / 0.01
            assert np.hypot(*acceleration.T).max() <= 8.5
            assert np.abs(extra.speed[there][:-1]) == pytest.approx(
                speed, abs=0.5 * np.hypot(*acceleration.T).max() * 0.1 + 0.3
            )
            if extra.kind == AgentKind.PEDESTRIAN:
                assert speed.max() <= 3.05
            if extra.kind == AgentKind.CYCLIST:
                assert speed.min() >= 3.0 and speed.max() <= 7.5
            if there[0] > FIRST:
                assert np.hypot(*(extra.xy[there[0]] - motion.xy[0, there[0]])) >= 40.0
            assert there[0] <= staged.first_step
        rows = len(motion.kind)
        assert all(0 < actor < rows + len(staged.staging.extras) for actor in staged.actors)
        if kind == EventKind.TAILGATER:
            (tailgate,) = staged.staging.tailgates
            assert tailgate.vehicle == staged.actors[1] == 2 and 0.3 < tailgate.headway_s < 0.8


@pytest.mark.parametrize(
    "kind",
    [
        EventKind.CUT_IN, EventKind.LATE_MERGE, EventKind.RED_LIGHT_RUNNER, EventKind.TURN_CONFLICT,
        EventKind.FROM_BEHIND_PARKED, EventKind.TAILGATER,
    ],
)  # fmt: skip
def test_without_occasion_there_is_no_event(kind):
    # One lane, nobody else, no junction, no parked cars.
    cast, motion = scene(road(lanes=1), [(0,)], [60.0], [11.0])
    assert stage(kind, cast, motion, FIRST, np.random.default_rng(0)) is None


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_who_stands_meets_nobody(kind):
    cast, motion = scene(road(), [(0,), (0,)], [60.0, 75.0], [0.0, 0.0])
    assert stage(kind, cast, motion, FIRST, np.random.default_rng(0)) is None


def test_a_runner_enters_at_red():
    for seed in range(6):
        rng = np.random.default_rng(seed)
        cast, motion = occasion(EventKind.RED_LIGHT_RUNNER, rng)
        staged = stage(EventKind.RED_LIGHT_RUNNER, cast, motion, FIRST, rng)
        if staged is not None:
            (extra,) = staged.staging.extras
            front = extra.xy[:, 1] + extra.size_m[0] / 2
            passes = int(np.argmax(front > -15.0))
            assert staged.first_step < passes < staged.last_step
            # Ego's light is green until 40 s after the recording's start.
            assert extra.speed[passes] > 8.0


def test_the_queue_at_the_runners_light_is_not_there():
    network, route = junction(False)
    cross = (3, 4, 5)
    staged = None
    for seed in range(6):
        v = 11.0
        cast, motion = scene(network, [route, cross, cross], [166.0 - 10 * v, 195.0, 188.0], [v, 0.0, 0.0])
        staged = staged or stage(EventKind.RED_LIGHT_RUNNER, cast, motion, FIRST, np.random.default_rng(seed))
    assert staged is not None and staged.staging.removed == (1, 2)
    table = drawn_drivers(3, Density(), np.random.default_rng(0))
    cast = dataclasses.replace(cast, drivers=table)
    went = Traffic(cast, np.arange(30) * 0.1 - 6.0).run(Staging(removed=(1, 2)))
    assert went.valid[0].all() and not went.valid[1:].any()


def test_any_feasible_kind_is_chosen_and_the_others_are_told():
    cast, motion = scene(road(lanes=1), [(0,)], [60.0], [11.0])
    chosen, impossible = set(), set()
    for seed in range(25):
        staged, failed = stage_any(cast, motion, FIRST, np.random.default_rng(seed))
        impossible |= set(failed)
        if staged is not None:
            chosen.add(staged.kind)
    assert {EventKind.JAYWALKER, EventKind.LANE_BLOCKED} <= chosen
    assert not chosen & {EventKind.CUT_IN, EventKind.TURN_CONFLICT}
    assert {EventKind.CUT_IN, EventKind.TURN_CONFLICT} <= impossible
    only, _ = stage_any(cast, motion, FIRST, np.random.default_rng(0), (EventKind.LANE_BLOCKED,))
    assert only is not None and only.kind == EventKind.LANE_BLOCKED
    again, _ = stage_any(cast, motion, FIRST, np.random.default_rng(0), (EventKind.LANE_BLOCKED,))
    assert np.array_equal(again.staging.extras[0].xy, only.staging.extras[0].xy)


def test_numbers_of_kinds_are_stored_and_stay():
    assert [kind.value for kind in EventKind] == list(range(13)) and EventKind.LEAD_BRAKES == 1
    assert set(SCRIPTS) == set(EventKind) - {EventKind.NONE}


def brute(speed, blocked, times):
    """The least of a grid of decelerations that keeps ego behind every place at its time."""
    for a in np.arange(0.0, 20.0, 0.001):
        t = np.minimum(times, speed / a) if a else times
        if np.all(speed * t - a * t**2 / 2 <= blocked + 1e-9):
            return a
    return math.inf


@pytest.mark.parametrize("speed", [4.0, 9.0, 15.0])
def test_required_deceleration_is_the_least_that_keeps_behind(speed):
    rng = np.random.default_rng(0)
    for _ in range(10):
        times = np.sort(rng.uniform(0.2, 5.0, 4))
        blocked = rng.uniform(5.0, 40.0, 4)
        assert required_deceleration(speed, blocked, times) == pytest.approx(
            brute(speed, blocked, times), abs=2e-3
        )
    assert required_deceleration(speed, np.array([0.0]), np.array([1.0])) == math.inf


def test_rooms_and_gaps_by_hand():
    # 10 m/s, 20 m, taken for good: 100 / 40. Free again after 3 s: 2 (30 - 20) / 9.
    assert required_deceleration(10.0, np.array([20.0]), np.array([60.0])) == pytest.approx(2.5)
    assert required_deceleration(10.0, np.array([20.0]), np.array([3.0])) == pytest.approx(20 / 9)
    assert waiting_room(10.0, 20 / 9, 3.0) == pytest.approx(20.0)
    assert waiting_room(10.0, 2.5, 60.0) == pytest.approx(20.0)
    # Leader at 10 m/s brakes at 5: 10 m; with a gap of 10 m ego has 20 m.
    assert leader_requires(10.0, 10.0, 10.0, 5.0) == pytest.approx(2.5)
    # 12 -> 4 m/s behind somebody who goes from 10 to 4 at 3 m/s2: 64 / (2 a) = g + 6.
    assert cut_in_gap(12.0, 10.0, 4.0, 3.0, 3.2) == pytest.approx(4.0)


def test_what_roads_must_have():
    plain, ending, (lights, _), (yielding, _) = (
        road(lanes=1),
        road(ends=True),
        junction(False),
        junction(True),
    )
    assert possible(EventKind.LATE_MERGE, ending) and not possible(EventKind.LATE_MERGE, road())
    assert possible(EventKind.CUT_IN, road()) or possible(EventKind.CUT_IN, ending)
    assert not possible(EventKind.CUT_IN, plain) and not possible(EventKind.FROM_BEHIND_PARKED, plain)
    assert possible(EventKind.RED_LIGHT_RUNNER, lights) and not possible(EventKind.RED_LIGHT_RUNNER, yielding)
    assert possible(EventKind.TURN_CONFLICT, yielding) and not possible(EventKind.TURN_CONFLICT, plain)
    assert possible(EventKind.JAYWALKER, plain) and not possible(EventKind.JAYWALKER, road(limit=27.0))
    assert all(possible(kind, plain) for kind in (EventKind.LEAD_BRAKES, EventKind.LANE_BLOCKED))


def test_a_tailgater_keeps_its_short_gap():
    table = drawn_drivers(2, Density(), np.random.default_rng(0))
    paths = [lane_path(road(lanes=1), (0,), Sway()) for _ in range(2)]
    at, speed = np.array([70.0, 40.0]), np.array([10.0, 10.0])
    cast = Cast(road(lanes=1, limit=11.0), paths, table, at, speed, (0,))
    slower = Staging(overrides=(Override(0, 0, 150, 0.0),))
    usual = Traffic(cast, np.arange(150) * 0.1).run(slower)
    close = Traffic(cast, np.arange(150) * 0.1).run(
        dataclasses.replace(slower, tailgates=(Tailgate(1, 0.5),))
    )
    gaps = [float(m.distance_m[0, -1] - m.distance_m[1, -1]) for m in (usual, close)]
    assert gaps[1] < gaps[0] - 3.0
    assert gaps[1] - table.size_m[:, 0].mean() > 2.0
