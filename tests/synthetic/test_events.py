from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.geometry.boxes import overlap
from drivax.scenario.schema import AgentKind
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.events import SCRIPTS, SEVERITY_MPS2, EgoView, EventKind, draw_severity, stage
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.placement import Density, draw_drivers
from drivax.synthetic.traffic.roles import Override, Roles, ScriptedUser, Staging, Tailgate
from drivax.synthetic.traffic.simulation import WorldTraffic

from .event_scenes import FIRST, STEPS, junction, road, scene, suitable


def predicted(motion, staged):
    """Motion of the actor: as scripted, or braking along its path from the override's first step on."""
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
    return ScriptedUser(AgentKind.VEHICLE, size, xy, motion.heading[row], v - a * t, motion.valid[row])


def march(motion, actor, begin, deceleration, start, speed):
    """Move ego along +x in steps of 10 ms and return whether its box ever overlaps the actor's.

    Also return the least time, on a grid of 50 ms, after which both would overlap at constant velocities.
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
        touches = bool(np.any(overlap(ego, box(xy + velocity * ahead, heading, actor.size_m[:2])) & valid))
        hit = touches if ahead == 0.0 else hit
        ttc = min(ttc, float(ahead)) if touches else ttc
    return hit, ttc


def follow(actor, start, speed, until):
    """Position and speed of an ego that has followed the actor since it appeared."""
    law, target = IdmParameters(2.0, 1.5, 1.5, 1.5), speed
    begin = int(np.argmax(actor.valid))
    x, v = start - speed * 0.1 * (until - begin), speed
    for t in range(begin, until):
        gap = actor.xy[t, 0] - actor.size_m[0] / 2 - x - 2.4
        a = idm_acceleration(np.array(v), np.array(target), np.array(gap), np.array(actor.speed[t]), law)
        after = v + max(float(a), -6.0) * 0.1
        x, v = x + (v + after) * 0.05, after
    return x, v


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_required_braking_avoids_the_actor_and_constant_speed_does_not(kind):
    staged_count, close, severities = 0, 0, []
    for seed in range(14):
        rng = np.random.default_rng([int(kind), seed])
        roles, motion = suitable(kind, rng)
        staged = stage(kind, EgoView(roles, motion, FIRST), draw_severity(rng), rng)
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
            start, v = follow(actor, start, v, begin)
        hit, ttc = march(motion, actor, begin, 0.0, start, v)
        close += hit or ttc < 1.0
        # Ego brakes 0.4 s after the first step. The margins allow for the step in which an actor leaves the path.
        brakes, at = begin + 4, start + 0.4 * v
        assert not march(motion, actor, brakes, 1.1 * staged.severity_mps2 + 0.3, at, v)[0]
        assert march(motion, actor, brakes, 0.85 * staged.severity_mps2 - 0.1, at, v)[0]
    assert staged_count >= 7
    assert close >= 0.8 * staged_count
    assert np.ptp(severities) > 0.2


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_actors_move_plausibly_and_appear_out_of_view(kind):
    for seed in range(8):
        rng = np.random.default_rng([int(kind), seed])
        roles, motion = suitable(kind, rng)
        staged = stage(kind, EgoView(roles, motion, FIRST), draw_severity(rng), rng)
        if staged is None:
            continue
        for override in staged.staging.overrides:
            assert -8.0 <= override.acceleration_mps2 < -3.6
            assert (override.first_step, override.last_step) == (staged.first_step, staged.last_step)
        for extra in staged.staging.extras:
            present = np.flatnonzero(extra.valid)
            assert np.all(np.diff(present) == 1) and extra.xy.shape == (STEPS, 2)
            xy = extra.xy[present]
            speed = np.hypot(*np.diff(xy, axis=0).T) / 0.1
            acceleration = np.diff(xy, n=2, axis=0) / 0.01
            assert np.hypot(*acceleration.T).max() <= 8.5
            assert np.abs(extra.speed[present][:-1]) == pytest.approx(
                speed, abs=0.5 * np.hypot(*acceleration.T).max() * 0.1 + 0.3
            )
            if extra.kind == AgentKind.PEDESTRIAN:
                assert speed.max() <= 3.05
            if extra.kind == AgentKind.CYCLIST:
                assert speed.min() >= 3.0 and speed.max() <= 7.5
            if present[0] > FIRST:
                assert np.hypot(*(extra.xy[present[0]] - motion.xy[0, present[0]])) >= 40.0
            assert present[0] <= staged.first_step
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
def test_unsuitable_scenarios_have_no_event(kind):
    # One lane, no other agents, no junction, no parked cars.
    roles, motion = scene(road(lanes=1), [(0,)], [60.0], [11.0])
    assert stage(kind, EgoView(roles, motion, FIRST), 3.0, np.random.default_rng(0)) is None


@pytest.mark.parametrize("kind", sorted(SCRIPTS))
def test_standing_ego_has_no_event(kind):
    roles, motion = scene(road(), [(0,), (0,)], [60.0, 75.0], [0.0, 0.0])
    assert stage(kind, EgoView(roles, motion, FIRST), 3.0, np.random.default_rng(0)) is None


def test_red_light_runner_crosses_its_line_at_speed_during_the_event():
    staged_count = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        roles, motion = suitable(EventKind.RED_LIGHT_RUNNER, rng)
        staged = stage(EventKind.RED_LIGHT_RUNNER, EgoView(roles, motion, FIRST), 2.5, rng)
        if staged is not None:
            staged_count += 1
            (extra,) = staged.staging.extras
            front = extra.xy[:, 1] + extra.size_m[0] / 2
            passes = int(np.argmax(front > -15.0))
            assert staged.first_step < passes < staged.last_step
            assert extra.speed[passes] > 8.0
    assert staged_count >= 3


def test_queue_before_the_red_light_runner_is_removed():
    network, route = junction(False)
    cross = (3, 4, 5)
    staged = None
    for seed in range(6):
        v = 11.0
        roles, motion = scene(network, [route, cross, cross], [166.0 - 10 * v, 195.0, 188.0], [v, 0.0, 0.0])
        rng = np.random.default_rng(seed)
        staged = staged or stage(EventKind.RED_LIGHT_RUNNER, EgoView(roles, motion, FIRST), 2.5, rng)
    assert staged is not None and staged.staging.removed == (1, 2)
    table = draw_drivers(3, Density(), np.random.default_rng(0))
    roles = dataclasses.replace(roles, drivers=table)
    simulated = WorldTraffic(roles, np.arange(30) * 0.1 - 6.0).run(Staging(removed=(1, 2)))
    assert simulated.valid[0].all() and not simulated.valid[1:].any()


def test_event_kinds_keep_their_stored_numbers():
    assert [kind.value for kind in EventKind] == list(range(13)) and EventKind.LEAD_BRAKES == 1
    assert set(SCRIPTS) == set(EventKind) - {EventKind.NONE}


def test_tailgater_keeps_a_short_gap():
    table = draw_drivers(2, Density(), np.random.default_rng(0))
    paths = [lane_path(road(lanes=1), (0,), Sway()) for _ in range(2)]
    at, speed = np.array([70.0, 40.0]), np.array([10.0, 10.0])
    roles = Roles(road(lanes=1, limit=11.0), paths, table, at, speed, (0,))
    slower = Staging(overrides=(Override(0, 0, 150, 0.0),))
    usual = WorldTraffic(roles, np.arange(150) * 0.1).run(slower)
    close = WorldTraffic(roles, np.arange(150) * 0.1).run(
        dataclasses.replace(slower, tailgates=(Tailgate(1, 0.5),))
    )
    gaps = [float(m.distance_m[0, -1] - m.distance_m[1, -1]) for m in (usual, close)]
    assert gaps[1] < gaps[0] - 3.0
    assert gaps[1] - table.size_m[:, 0].mean() > 2.0
