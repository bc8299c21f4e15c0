"""PDM-Closed: its lines and its IDM against oracles, its decisions on scenes whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.planners.pdm.brake import BrakeConfig, EmergencyBrake, braking_acceleration, is_emergency, stop
from drivax.planners.pdm.forecast import Forecast, boxes_of
from drivax.planners.pdm.planner import (
    LINE_ALONG,
    LINE_CURVATURE,
    PUBLISHED_DRIVER,
    Lines,
    PdmConfig,
    PdmPlanner,
    unroll_idm,
)
from drivax.planners.pdm.scoring import ScoringConfig, ground_at
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.record import record
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import ROUTE, Trajectory
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.testing.worlds import change_future, rotate_recording, scatter_garbage
from quick import quick
from scenes import RED, SMALL, bank_of, car, straight_road

TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2), metrics="none")
SIMULATOR = Simulator(TASK)
PERSON = partial(car, length=0.6, width=0.6, kind=AgentKind.PEDESTRIAN)
DT, THOUGHT = 0.1, []


@record
class Watched(PdmPlanner):
    """PDM that tells what it thought of its proposals."""

    def score_proposals(self, carry, bank, situation):
        THOUGHT.append(PdmPlanner.score_proposals(self, carry, bank, situation))
        return THOUGHT[-1]


@jax.jit
def considered(bank, touched):
    """The first action, what is carried on, and what was thought of all proposals."""
    planner, key = Watched(), jax.random.key(0)
    state = SIMULATOR.reset(bank, 0, 10, 0)
    carry = planner.init(bank, state, key)
    carry = replace(carry, touched=carry.touched | touched)
    action, after = planner.act(carry, bank, state, SIMULATOR.situation(bank, state), None, key)
    return action, after, THOUGHT.pop()


def considering(bank, touched=False):
    return jax.device_get(considered(bank, jnp.asarray(touched)))


def decide(recording, touched=False):
    return considering(bank_of(recording), touched)


# Lines -----------------------------------------------------------------------------------------------------------


def on_a_circle(bank, radius):
    """The bank with a route around a circle to the left, 1 m apart, that begins where ego is."""
    angle = np.arange(bank.routes.shape[1]) / radius
    rows = np.zeros(bank.routes.shape[1:], np.float32)
    rows[:, 0], rows[:, 1] = radius * np.sin(angle), radius * (1 - np.cos(angle))
    rows[:, 3], rows[:, 4], rows[:, 5] = np.cos(angle), np.sin(angle), 10.0
    routes = jnp.asarray(np.broadcast_to(rows, bank.routes.shape))
    return replace(bank, routes=routes, route_points=jnp.full_like(bank.route_points, 120))


def test_lines_keep_their_offset_from_the_route_and_even_spacing():
    radius = 25.0
    bank = on_a_circle(bank_of(straight_road([car(0, 0, 0, 9)])), radius)
    me = jnp.asarray([0.0, 0.0, 1.0, 0.0, 4.8, 2.0])

    def lines(bank):
        return Lines.along_route(bank, jnp.asarray(0), jnp.asarray(7.0), (0.0, -1.0, 1.0), me)

    found = quick(lines, bank)
    assert found.remaining_m == pytest.approx(112.0) and found.limit == pytest.approx(10.0)
    for points, offset in zip(found.points, (0.0, -1.0, 1.0), strict=True):
        own = radius - offset
        angle = 7.0 / radius + np.arange(90) / own
        right = np.stack([own * np.sin(angle), radius - own * np.cos(angle)], 1)
        np.testing.assert_allclose(points[:90, :2], right, atol=0.03)
        np.testing.assert_allclose(points[:90, 2], np.cos(angle), atol=0.01)
        np.testing.assert_allclose(points[4:86, LINE_CURVATURE], 1 / own, rtol=0.02)
        np.testing.assert_allclose(points[:90, LINE_ALONG], np.arange(90) * radius / own, atol=0.02)
    # Beyond the end of the route they go straight on.
    steps = np.diff(found.points[0, 115:, :2], axis=0)
    np.testing.assert_allclose(steps, steps[:1].repeat(len(steps), 0), atol=1e-3)


def test_lines_lead_straight_ahead_without_a_route():
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    bank = replace(bank, route_points=jnp.zeros_like(bank.route_points))
    me = jnp.asarray([5.0, 3.0, 0.6, 0.8, 4.8, 2.0])
    found = quick(lambda b: Lines.along_route(b, jnp.asarray(0), jnp.asarray(0.0), (0.0, 1.0), me), bank)
    way = np.arange(160)[:, None] * np.array([0.6, 0.8])
    np.testing.assert_allclose(found.points[0, :, :2], way + np.array([5.0, 3.0]), atol=1e-3)
    np.testing.assert_allclose(found.points[1, :, :2], way + np.array([4.2, 3.6]), atol=1e-3)
    assert found.remaining_m < 0


# IDM -------------------------------------------------------------------------------------------------------------


def idm_oracle(boxes, velocities, speed, wanted, stop, offset):
    """Published IDM on a straight line along +x, in double precision, boxes along the axes (x, y, half sizes)."""
    x, v, out = 0.0, speed, []
    for step in range(40):
        if step % 2 == 0:
            later = DT * step
            now = [
                (bx + vx * later, by + vy * later, hx, hy)
                for (bx, by, hx, hy), (vx, vy) in zip(boxes, velocities, strict=True)
            ]
            gap, leader = 1e4, 0.0
            for (bx, by, hx, hy), (vx, _) in zip(now, velocities, strict=True):
                if bx > x and abs(by - offset) < hy + 1.0:
                    dx, dy = max(abs(bx - x) - hx - 2.4, 0.0), max(abs(by - offset) - hy - 1.0, 0.0)
                    if np.hypot(dx, dy) < gap:
                        gap, leader = np.hypot(dx, dy), vx
            if stop + 2.4 > x and max(stop - x, 0.0) < gap:
                gap, leader = max(stop - x, 0.0), 0.0
        out.append((x, v))
        kept = max(gap, 1.0)
        star = 1.0 + max(0.0, 1.5 * v + v * (v - leader) / (2 * np.sqrt(1.5 * 3.0)))
        a = np.clip(1.5 * (1 - (v / wanted) ** 10 - (star / kept) ** 2), -3.0, 1.5)
        x, gap, v = x + DT * v, gap - DT * v, max(v + DT * a, 0.0)
    return np.array([*out, (x, v)]).T


@pytest.mark.parametrize("stop", (np.inf, 22.0))
def test_idm_is_unrolled_as_in_double_precision(stop):
    """A slower leader ahead, an agent crossing from the right, one that leaves, and one off the road."""
    boxes = [(30.0, 0.0, 2.4, 1.0), (38.0, -14.1, 1.0, 2.4), (12.0, 1.05, 1.0, 2.4), (20.0, 8.0, 2.4, 1.0)]
    velocities = [(4.0, 0.0), (0.0, 4.0), (0.0, 3.0), (9.0, 0.0)]
    heading = [0.0, np.pi / 2, np.pi / 2, 0.0]
    box = np.array(
        [[x, y, np.cos(h), np.sin(h), 4.8, 2.0] for (x, y, *_), h in zip(boxes, heading, strict=True)]
    )
    valid = jnp.ones(4, bool)
    others = Forecast(
        jnp.asarray(box, jnp.float32), jnp.asarray(velocities, jnp.float32), jnp.ones(4, jnp.int32), valid
    )
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    me = jnp.asarray([0.0, 0.0, 1.0, 0.0, 4.8, 2.0])
    fractions = np.array([0.2, 0.6, 1.0]) * 13.4

    def proposals(bank, others, stop):
        along = bank.routes[0, :, 0]
        start = jnp.argmin(jnp.abs(along)).astype(jnp.float32)
        lines = Lines.along_route(bank, jnp.asarray(0), start, (0.0, -1.0, 1.0), me)
        first = lines.points[0, 0, 0]
        moved = replace(others, box=others.box.at[:, 0].add(first))
        wanted = jnp.asarray(fractions, jnp.float32)
        return unroll_idm(
            lines, moved, me[4:], jnp.asarray(8.0), wanted, stop, PUBLISHED_DRIVER, range(0, 40, 2)
        )

    found = quick(proposals, bank, others, jnp.asarray(stop, jnp.float32))
    braked = False
    for line, offset in enumerate((0.0, -1.0, 1.0)):
        for driver, wanted in enumerate(fractions):
            way, speed = idm_oracle(boxes, velocities, 8.0, wanted, stop, offset)
            np.testing.assert_allclose(found.arc_m[line, driver], way, atol=5e-3)
            np.testing.assert_allclose(found.speed[line, driver], speed, atol=5e-3)
            braked |= speed.min() < 5.0 and wanted > 8.0
    assert braked


# Decisions -------------------------------------------------------------------------------------------------------


def test_fastest_centred_proposal_wins_on_a_free_road():
    action, after, scored = decide(straight_road([car(0, 0, 0, 9)]))
    assert scored.cars.motion.shape == (15, 41, 4)
    assert int(np.argmax(scored.score)) == 4 and scored.score[4] == pytest.approx(1.0)
    assert (scored.metrics.road[:5] == 1.0).all() and (scored.metrics.direction == 1.0).all()
    # IDM is at 13.4 m/s (1 - v^10 ...) after a second: 9 + 1.5 (1 - small); the regulator asks 10/11 of it, the lag
    # passes on a third.
    assert 0.3 < action[0] * 6.0 < 0.5 and action[1] == pytest.approx(0.0, abs=1e-4)
    assert not after.touched.any()


def test_pdm_follows_a_slower_leader_without_a_collision():
    action, _, scored = decide(straight_road([car(0, 0, 0, 10), car(18, 0, 0, 5)]))
    best = int(np.argmax(scored.score))
    assert action[0] < -0.05 and scored.metrics.collision[best] == 1.0


def test_pdm_stops_for_red_and_not_for_green():
    bank = bank_of(straight_road([car(0, 0, 0, 10)], light=RED, light_x=30.0))
    red, _, _ = considering(bank)
    green, _, _ = considering(replace(bank, light_state=jnp.full_like(bank.light_state, 6)))
    assert red[0] < -0.05 and green[0] > 0.0


def test_pdm_passes_obstacles_that_reach_slightly_into_the_lane():
    """A box that reaches 0.45 m into the middle line's corridor leaves room a metre to the left."""
    box = partial(car, length=1.0, width=1.0, kind=AgentKind.OTHER)
    action, _, scored = decide(straight_road([car(0, 0, 0, 10), box(30, -1.05, 0, 0)]))
    best = int(np.argmax(scored.score))
    assert best // 5 == 2 and action[1] > 0.0


def test_emergency_brake_applies_when_no_proposal_is_safe():
    """1.2 m before a car that stands, at 4 m/s: IDM brakes with 3 m/s2 and the car lags."""
    action, after, scored = decide(straight_road([car(0, 0, 0, 4), car(6.0, 0, 0, 0)]))
    best = int(np.argmax(scored.score))
    assert scored.metrics.fault_s[best] <= 2.0
    assert action[0] * 6.0 == pytest.approx(-4.05) and action[1] == 0.0
    assert after.acceleration == pytest.approx(-4.05)
    # Faster cars are not braked by it: at 8 m/s the same distance is left to IDM.
    fast, _, _ = decide(straight_road([car(0, 0, 0, 8), car(6.0, 0, 0, 0)]))
    assert -3.0 < fast[0] * 6.0 < 0.0


@pytest.mark.slow
def test_proposals_are_unrolled_as_the_simulator_executes_their_plans():
    """In the action space ``trajectory``: the first step of each proposal, off the lane and with turned wheels."""
    space = Trajectory(initial_steering="logged")
    simulator, planner = Simulator(replace(TASK, actions=space)), Watched(space)

    def unrolled_and_executed(bank):
        state, key = simulator.reset(bank, 0, 10, 0), jax.random.key(0)
        carry, situation = planner.init(bank, state, key), simulator.situation(bank, state)
        action, _ = planner.act(carry, bank, state, situation, None, key)
        scored = THOUGHT.pop()
        follow = lambda plan: simulator.step(bank, state, space.plan(plan))[0].context.history[-1]  # noqa: E731
        return scored, action, jax.vmap(follow)(scored.plans)

    bank = bank_of(straight_road([car(0, 0.6, 0.1, 9), car(30, 0, 0, 4)]))
    scored, action, executed = quick(unrolled_and_executed, bank)
    np.testing.assert_allclose(scored.cars.motion[:, 1], executed, atol=1e-5)
    # The chosen plan is handed over.
    best = int(np.argmax(scored.score))
    np.testing.assert_allclose(action.reshape(-1, 3)[:41], scored.plans[best], atol=1e-6)


def test_tracked_proposals_are_looked_up_at_every_pose():
    """In the action space ``trajectory``: heading for the edge of the road, tracked back onto the lane."""
    space = Trajectory(initial_steering="logged")
    simulator, planner = Simulator(replace(TASK, actions=space)), PdmPlanner(space)

    def gate_and_look_ups(bank):
        state, key, index = simulator.reset(bank, 0, 10, 0), jax.random.key(0), jnp.asarray(0)
        situation = simulator.situation(bank, state)
        scored = planner.score_proposals(planner.init(bank, state, key), bank, situation)
        boxes = boxes_of(scored.cars.motion, jnp.array([4.8, 2.0]))

        def look(box):
            return ground_at(bank, index, box, jnp.zeros(()), jnp.asarray(True))

        return scored.metrics.road, jax.vmap(jax.vmap(look))(boxes).is_offroad

    road, off = quick(gate_and_look_ups, bank_of(straight_road([car(0, 0, -0.2, 9)])))
    assert (1.0 - road).tolist() == off.any(axis=1).tolist()
    # Some corners are off the road for less than half a second, between multiples of it.
    assert (off.any(axis=1) & ~off[:, ::5].any(axis=1)).any() and not off.any(axis=1).all()


def test_agents_that_touched_ego_are_ignored():
    overlapping = straight_road([car(0, 0, 0, 4), car(4.0, 0, 0, 0)])
    action, after, _ = decide(overlapping)
    assert after.touched.sum() == 1 and action[0] > 0.0
    ahead = straight_road([car(0, 0, 0, 4), car(6.0, 0, 0, 0)])
    assert decide(ahead, touched=True)[0][0] > 0.0


def test_pdm_does_not_read_the_future():
    bank = bank_of(
        straight_road([car(0, 0, 0, 10), car(30, 0, 0, 5), PERSON(25, -5, np.pi / 2, 1.0)], light=RED)
    )
    seen, other = considering(bank), considering(change_future(bank, 10))
    assert np.array_equal(seen[0], other[0]) and np.array_equal(seen[2].score, other[2].score)


def test_pdm_is_invariant_to_rotation_shift_and_padding_values():
    recording = straight_road([car(0, 0, 0, 10), car(24, 0.5, 0, 6), PERSON(40, -4, np.pi / 2, 1.0)])
    action, _, scored = decide(recording)
    turned, _, other = decide(rotate_recording(recording, 0.7, 1000.0, -500.0))
    assert turned == pytest.approx(action, abs=5e-3)
    np.testing.assert_allclose(other.score, scored.score, atol=0.01)
    filled = considering(scatter_garbage(bank_of(recording)))
    np.testing.assert_allclose(filled[0], action, atol=1e-6)


def test_one_program_serves_all_planners_of_one_configuration():
    assert hash(PdmPlanner()) == hash(PdmPlanner()) and PdmPlanner() == PdmPlanner()
    considering(bank_of(straight_road([car(0, 0, 0, 9)])))
    assert considered._cache_size() == 1


def test_invalid_settings_are_refused():
    with pytest.raises(UsageError, match="no proposals"):
        PdmConfig(fractions=())
    with pytest.raises(UsageError, match="leader_every is 3, steps 40; use a divisor"):
        PdmConfig(leader_every=3)
    with pytest.raises(UsageError, match="ground_every is 7"):
        PdmConfig(scoring=ScoringConfig(ground_every=7))
    with pytest.raises(UsageError, match="10 steps are too few"):
        PdmConfig(steps=10)
    with pytest.raises(UsageError, match="PDM considers 0 agents"):
        PdmConfig(agents=0)
    with pytest.raises(UsageError, match="weights of progress, ttc and comfort are 0, 0, 0"):
        ScoringConfig(progress=0.0, ttc=0.0, comfort=0.0)
    with pytest.raises(UsageError, match="within_s is nan"):
        BrakeConfig(within_s=math.nan)
    with pytest.raises(UsageError, match="use least_mps2 <= most_mps2"):
        BrakeConfig(least_mps2=3.0)


# The brake -------------------------------------------------------------------------------------------------------


def test_emergency_brake_equals_hand_computation():
    acceleration = lambda v, a: float(braking_acceleration(jnp.asarray(v), jnp.asarray(a)))  # noqa: E731
    assert acceleration(5.0, 0.0) == pytest.approx(-4.05)
    assert acceleration(0.3, -9.0) == pytest.approx(-3.0)  # -10 v above 0.2 m/s
    assert acceleration(0.1, -0.5) == pytest.approx(-0.4 + 0.5)  # -4 v - a below
    assert acceleration(0.0, -9.0) == pytest.approx(2.40)
    emergency = lambda t, v: bool(is_emergency(jnp.asarray(t), jnp.asarray(v)))  # noqa: E731
    assert emergency(20 * np.float32(0.1), 5.0) and not emergency(2.1, 5.0) and not emergency(1.0, 5.1)
    assert not emergency(np.inf, 1.0)
    assert bool(is_emergency(jnp.asarray(2.5), jnp.asarray(9.0), BrakeConfig(within_s=3.0, up_to_mps=10.0)))


def first_action(planner, simulator, bank, step=10):
    state, key = simulator.reset(bank, 0, step, 0), jax.random.key(0)
    carry, situation = planner.init(bank, state, key), simulator.situation(bank, state)
    return planner.act(carry, bank, state, situation, None, key)[0]


def test_any_planner_accepts_the_emergency_brake():
    """At 4 m/s: 6 m to the bumper of who stands are 1.5 s, 9 m are more than 2 s."""
    planner = EmergencyBrake(ConstantVelocity())
    run = jax.jit(partial(first_action, planner, SIMULATOR))
    near, far, beside = (
        np.asarray(run(bank_of(straight_road([car(0, 0, 0, 4), other]))))
        for other in (car(10.8, 0, 0, 0), car(13.8, 0, 0, 0), car(10.8, 3.7, 0, 0))
    )
    assert near[0] * 6.0 == pytest.approx(-4.05)
    assert far.tolist() == beside.tolist() == [0.0, 0.0]
    assert planner.name == "constant_velocity+brake"


def test_emergency_brake_holds_the_curvature_in_the_space_route():
    """0.5 m left of the route, straight ahead is an offset of 0.5 m: no left turn into the car alongside."""
    simulator = Simulator(replace(TASK, actions=ROUTE))
    run = jax.jit(partial(first_action, EmergencyBrake(ConstantVelocity(ROUTE), ROUTE), simulator))
    blocked, free = (
        np.asarray(run(bank_of(straight_road([car(0, 0.5, 0, 4), other]))))
        for other in (car(10.8, 0.5, 0, 0), car(10.0, 3.0, 0, 0))
    )
    np.testing.assert_allclose(blocked * [6.0, 3.5], [-4.05, 0.5], atol=1e-3)
    np.testing.assert_allclose(free * [6.0, 3.5], [0.0, 0.5], atol=1e-3)


def test_emergency_brake_forecasts_along_planned_poses():
    """As above for a plan at 4 m/s, 4 m from the origin; the brake's poses are 1.1 (4 - 4.05) m/s apart.

    Taken for actuators, the first pose would be 4 m/s2.
    """
    space = Trajectory(steps=10)
    simulator = Simulator(replace(TASK, actions=space))
    planner = EmergencyBrake(ConstantVelocity(space), space)
    run = jax.jit(partial(first_action, planner, simulator, step=20))
    near, far = (
        np.asarray(run(bank_of(straight_road([car(0, 0, 0, 4), car(x, 0, 0, 0)])))).reshape(-1, 3)
        for x in (14.8, 17.8)
    )
    np.testing.assert_allclose(np.diff(near[:, 0] - near[0, 0]), -0.0055, atol=1e-5)
    np.testing.assert_allclose(np.diff(far[:, 0] - far[0, 0]), 0.4, atol=1e-5)


def test_controller_stops_as_with_the_published_poses():
    """From 5 m/s in 4.5 m, measured with the published brake, nuPlan's tracker and its vehicle model."""
    space, length = Trajectory(steps=40), jnp.float32(5.176)

    def step(now, _):
        motion, last = now
        plan = stop(space, motion, braking_acceleration(motion[3], last[0]), length)
        last = space.actuate(motion, plan, last, length)
        return (space.move(motion, last, length), last), motion

    start = jnp.array([0.0, 0.0, 0.0, 5.0]), jnp.zeros(space.size)
    motions = quick(lambda now: jax.lax.scan(step, now, None, 60)[1], start)
    assert motions[-1, 0] == pytest.approx(4.5, abs=0.05) and motions[-1, 3] == 0.0


@pytest.mark.slow
def test_pdm_handles_an_obstacle_a_leader_a_pedestrian_and_a_red_light():
    """Closed loop; constant velocity of 10 m/s for 8 s fails in each of them."""
    scenes = [
        straight_road([car(0, 0, 0, 10), car(40, 0, 0, 0)]),
        straight_road([car(0, 0, 0, 10), car(20, 0, 0, 4)]),
        straight_road([car(0, 0, 0, 10), PERSON(45, -6.0, np.pi / 2, 1.5)]),
        straight_road([car(0, 0, 0, 10)], light=RED),
    ]
    scenarios = [assemble(recording, SMALL) for recording in scenes]
    bank = ScenarioBank.from_scenarios(scenarios, trim=False)
    found = evaluate(
        PdmPlanner(), bank, scenario_names(scenarios), task=replace(TASK, metrics="full")
    ).metrics
    assert found["accuracy"].tolist() == [1.0, 1.0, 1.0, 1.0]
