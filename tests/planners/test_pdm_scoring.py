"""Every term of PDM's score, on drives whose value can be worked out by hand."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from drivax.kernels import without_kernels
from drivax.planners.pdm import scoring
from drivax.planners.pdm.forecast import Contacts, Forecast, boxes_of, predict_overlaps
from drivax.planners.pdm.scoring import (
    Ground,
    ProposalMetrics,
    ScoringConfig,
    _direction,
    evaluate_proposal,
    ground_along,
    ground_at,
    is_comfortable,
    scores,
)
from drivax.planners.pdm.tracking import Car
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind
from drivax.simulator.types import Frame
from drivax.synthetic.world import generate_recording
from quick import quick
from scenes import bank_of, car, straight_road

CONFIG, DT, SIZE = ScoringConfig(), 0.1, jnp.asarray([4.8, 2.0])
T = np.arange(41) * DT
NOWHERE = Ground(*(jnp.zeros(41, bool) for _ in range(3)))


def straight(speed, y=0.0):
    return jnp.asarray(np.stack([speed * T, np.full(41, y), 0 * T, np.full(41, speed)], 1), jnp.float32)


def others(*rows):
    """(x, y, heading, speed, kind) of each; always four, so that one program serves."""
    rows = [*rows, *[(500.0, 500.0, 0.0, 0.0, 0)] * (4 - len(rows))]
    x, y, h, v, kind = np.array(rows).T
    box = np.stack([x, y, np.cos(h), np.sin(h), np.full(4, 4.8), np.full(4, 2.0)], 1)
    velocity = v[:, None] * np.stack([np.cos(h), np.sin(h)], 1)
    here = (jnp.asarray(part, jnp.float32) for part in (box, velocity))
    return Forecast(*here, jnp.asarray(kind, jnp.int32), jnp.asarray(kind > 0))


@pytest.fixture(scope="module")
def evaluate():
    def one(motion, others, several):
        position = Ground(several, jnp.zeros(41, bool), jnp.zeros(41, bool))
        still = Car(motion, jnp.zeros(41), jnp.zeros(41))
        contacts = Contacts.along(motion, SIZE, others)
        return evaluate_proposal(
            still, jnp.zeros(()), SIZE, others, contacts, position, motion[-1, 0], CONFIG
        )

    run = jax.jit(one)
    return lambda motion, others, several=False: jax.device_get(
        run(motion, others, jnp.full(41, several, bool))
    )


def test_a_collision_ahead_is_ego_s_fault_when_it_begins(evaluate):
    """10 m/s, a car that stands 20 m ahead: 15.2 m between bumpers, overlap first at 1.6 s."""
    found = evaluate(straight(10.0), others((20, 0, 0, 0, AgentKind.VEHICLE)))
    assert found.collision == 0.0 and found.fault_s == pytest.approx(1.6)
    beside = evaluate(straight(10.0), others((20, 2.1, 0, 0, AgentKind.VEHICLE)))
    assert beside.collision == 1.0 and np.isinf(beside.fault_s)


def test_hitting_objects_costs_half_and_people_or_vehicles_all(evaluate):
    for kind, gate in (
        (AgentKind.PEDESTRIAN, 0.0), (AgentKind.CYCLIST, 0.0), (AgentKind.OTHER, 0.5), (AgentKind.STATIC, 0.5)
    ):  # fmt: skip
        assert evaluate(straight(10.0), others((20, 0, 0, 0, kind))).collision == gate
    both = others((20, 0, 0, 0, AgentKind.STATIC), (30, 0, 0, 0, AgentKind.VEHICLE))
    assert evaluate(straight(10.0), both).collision == 0.0


def test_ego_hit_from_behind_or_standing_is_not_at_fault(evaluate):
    rear = others((-12, 0, 0, 10, AgentKind.VEHICLE))
    assert evaluate(straight(5.0), rear).collision == 1.0
    front = others((12, 0, np.pi, 10, AgentKind.VEHICLE))
    assert evaluate(straight(0.0), front).collision == 1.0
    # Hit in the side: only somebody who is in several lanes is at fault; that contact decides, whatever comes later.
    side = others((2, -12, np.pi / 2, 8, AgentKind.VEHICLE))
    assert evaluate(straight(1.0), side).collision == 1.0
    assert evaluate(straight(1.0), side, several=True).collision == 0.0


def test_time_to_collision_looks_0_9_s_ahead(evaluate):
    """5 m/s for 4 s is 20 m; bumpers are 2.4 m from centres; in 0.9 s ego would come 4.5 m further."""
    for gap, kept in ((20 + 4.4, 0.0), (20 + 4.6, 1.0)):
        found = evaluate(straight(5.0), others((gap + 4.8, 0, 0, 0, AgentKind.VEHICLE)))
        assert (found.ttc, found.collision) == (kept, 1.0)
    # Nothing is foreseen while standing, and nobody who comes from behind counts.
    assert evaluate(straight(0.0), others((9, 0, np.pi, 2, AgentKind.VEHICLE))).ttc == 1.0
    assert evaluate(straight(5.0), others((-9, 0, 0, 6, AgentKind.VEHICLE))).ttc == 1.0


def test_wrong_way_driving_costs_half_or_all():
    drive = straight(10.0)  # a metre each step
    for steps, gate in (([*range(5, 6)], 1.0), ([*range(5, 8)], 0.5), ([*range(5, 12)], 0.0)):
        astray = jnp.zeros(41, bool).at[jnp.asarray(steps)].set(True)
        assert float(_direction(drive, astray, CONFIG)) == gate
    # Twice a metre is not two metres in one go.
    apart = jnp.zeros(41, bool).at[jnp.asarray([5, 9])].set(True)
    assert float(_direction(drive, apart, CONFIG)) == 1.0


def comfortable_by_scipy(motion, acceleration):
    """nuPlan's limits and windows, with SciPy's filter."""
    yaw = np.unwrap(motion[:, 2])
    rate = np.concatenate([[0.0], np.diff(yaw) / DT])
    lateral = motion[:, 3] * rate
    magnitude = np.hypot(acceleration, lateral)
    smooth = lambda s, window, order, d=0: savgol_filter(s, window, order, deriv=d, delta=DT)  # noqa: E731
    along = smooth(acceleration, 8, 2)
    fine = along.min() >= -4.05 and along.max() <= 2.40
    fine &= np.abs(smooth(lateral, 8, 2)).max() <= 4.89
    fine &= np.abs(smooth(along, 15, 2, 1)).max() <= 4.13
    fine &= np.abs(smooth(smooth(magnitude, 8, 2), 15, 2, 1)).max() <= 8.37
    fine &= np.abs(smooth(yaw, 5, 2, 1)).max() <= 0.95
    return fine & (np.abs(smooth(yaw, 5, 3, 2)).max() <= 1.93)


def test_comfort_equals_scipy():
    rng = np.random.default_rng(2)
    drives, wanted = [], []
    for _ in range(60):
        size = rng.uniform(0.1, 2.0)
        acceleration = size * np.cumsum(rng.normal(size=41)) * 0.6
        rate = 0.3 * size * np.cumsum(rng.normal(size=41)) * 0.5
        speed = np.maximum(8 + np.cumsum(acceleration) * DT, 0.0)
        motion = np.stack([0 * T, 0 * T, np.cumsum(rate) * DT, speed], 1)
        drives.append((motion, acceleration))
        wanted.append(comfortable_by_scipy(motion, acceleration))
    motion, acceleration = (jnp.asarray(np.array(part), jnp.float32) for part in zip(*drives, strict=True))
    motion = motion.at[..., 2].set((motion[..., 2] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    found = quick(jax.vmap(lambda m, a: is_comfortable(m, a, jnp.zeros(()))), motion, acceleration)
    assert found.tolist() == wanted and 10 < sum(wanted) < 50


def test_scores_equal_hand_computation():
    """Weights 5, 5, 2; progress counts relative to the best, 20 m x 0.5 here, and gates multiply all."""
    parts = {
        "collision": [1.0, 1.0, 0.0], "road": [1.0, 1.0, 1.0], "direction": [1.0, 0.5, 1.0],
        "progress_m": [8.0, 20.0, 40.0], "ttc": [1.0, 0.0, 1.0], "comfort": [0.0, 1.0, 1.0],
    }  # fmt: skip
    metrics = ProposalMetrics(
        **{name: jnp.asarray(part) for name, part in parts.items()}, fault_s=jnp.full(3, jnp.inf)
    )
    expected = [(5 * 0.8 + 5 + 0) / 12, 0.5 * (5 * 1.0 + 0 + 2) / 12, 0.0]
    assert np.asarray(scores(metrics, CONFIG)) == pytest.approx(expected)
    # Where nobody gets anywhere, all that are allowed have made the most of it.
    parts["progress_m"] = [0.05, 0.0, 9.0]
    still = ProposalMetrics(
        **{name: jnp.asarray(part) for name, part in parts.items()}, fault_s=jnp.full(3, jnp.inf)
    )
    assert np.asarray(scores(still, CONFIG)) == pytest.approx([10 / 12, 0.5 * 7 / 12, 0.0])


def test_ground_at_marks_several_lanes_off_road_and_wrong_way():
    """Lanes of 3.7 m on y = 0 and y = 3.7 of a one-way road; its edges are at -1.85 and 5.55."""
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))

    def look(bank, y, heading):
        box = jnp.stack([jnp.asarray(20.0), y, jnp.cos(heading), jnp.sin(heading), *SIZE])
        return ground_at(bank, jnp.asarray(0), box, jnp.zeros(()), jnp.asarray(True))

    y = jnp.asarray([0.0, 1.3, -1.3, 3.7, 7.5, 1.85])
    found = quick(jax.vmap(look, (None, 0, 0)), bank, y, jnp.zeros(6))
    assert found.is_in_several_lanes.tolist() == [False, True, True, False, True, True]
    # Half a car is 1 m wide, and 0.3 m beyond the edge are tolerated.
    assert found.is_offroad.tolist() == [False, False, True, False, True, False]
    assert found.is_astray.tolist() == [False, False, False, False, True, False]


def test_ground_is_looked_up_ahead_of_each_step():
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    drift = np.stack([10 * T, -0.5 * T, 0 * T, np.full(41, 10.0)], 1)
    motion = jnp.asarray(np.stack([np.asarray(straight(10.0)), drift]), jnp.float32)
    z, there = jnp.zeros((2, 41)), jnp.ones((2, 41), bool)
    found = quick(lambda b, m: ground_along(b, jnp.asarray(0), m, SIZE, z, there, there, 5), bank, motion)
    # 1.15 m aside is the limit, after 2.3 s; the look-up at 2.5 s stands for 2.1 s to 2.5 s.
    assert not found.is_offroad[0].any() and found.is_offroad[1].tolist() == [False] * 21 + [True] * 20


@pytest.mark.parametrize(
    ("most", "every"),
    [
        ((96, 40), 5),
        *(pytest.param(*p, marks=pytest.mark.slow) for p in (((96, 40), 1), ((20, 40), 5), ((96, 6), 5))),
    ],
)
def test_ground_along_equals_a_query_of_the_grid_per_pose(monkeypatch, most, every):
    """On curves that leave lanes, road and route of generated worlds, also with more segments than fit."""
    monkeypatch.setattr(scoring, "PATH_SEGMENTS", most[0])
    monkeypatch.setattr(scoring, "GROUP_SEGMENTS", most[1])
    worlds = [assemble(generate_recording(0, index)) for index in range(6)]
    bank = ScenarioBank.from_scenarios(worlds)
    rng = np.random.default_rng(0)
    curvature, speed = rng.normal(0.0, 0.02, (6, 5, 1)), rng.uniform(0.0, 15.0, (6, 5, 1))
    start = np.array([[*world.agent_xy[10, 0], world.agent_heading[10, 0]] for world in worlds])[:, None]
    turned = start[..., 2:] + curvature * speed * T
    steps = speed[..., None] * DT * np.stack([np.cos(turned), np.sin(turned)], -1)
    xy = start[..., None, :2] + np.cumsum(steps, axis=2) - steps[:, :, :1]
    motion = np.concatenate([xy, turned[..., None], np.broadcast_to(speed[..., None], (6, 5, 41, 1))], -1)
    z = np.broadcast_to(bank.agents[:, 10, 0, AgentColumn.Z][:, None, None] - 0.75, (6, 5, 41))
    on_route, needs_lanes = rng.random((6, 5, 41)) < 0.9, rng.random((6, 5, 41)) < 0.1
    poses = (np.asarray(motion, np.float32), z, on_route)

    def along(index, motion, z, on_route, needs_lanes):
        return ground_along(bank, index, motion, SIZE, z, on_route, needs_lanes, every)

    def query(index, motion, z, on_route):
        return jax.vmap(jax.vmap(partial(ground_at, bank, index)))(boxes_of(motion, SIZE), z, on_route)

    index = jnp.arange(6)
    with without_kernels():  # Native kernels query the grid per pose.
        seen = jax.device_get(jax.jit(jax.vmap(along))(index, *poses, needs_lanes))
    exact = jax.device_get(jax.jit(jax.vmap(query))(index, *poses))
    # Each step shares the look-up at the end of its interval.
    at = np.ceil(np.arange(41) / every).astype(int) * every
    np.testing.assert_array_equal(seen.is_offroad, exact.is_offroad[..., at])
    np.testing.assert_array_equal(seen.is_astray, exact.is_astray[..., at])
    np.testing.assert_array_equal(
        seen.is_in_several_lanes[needs_lanes], exact.is_in_several_lanes[..., at][needs_lanes]
    )
    for flags in (exact.is_offroad, exact.is_astray, exact.is_in_several_lanes[needs_lanes]):
        assert 0.1 < flags.mean() < 0.9


def test_forecast_keeps_agents_that_come_near():
    """Of many agents standing off the road only two enter it."""
    count = 40
    x, y = np.arange(count) * 2.0 - 20, np.full(count, 30.0)
    x[7], y[7], x[9], y[9] = 30.0, -20.0, 45.0, 2.0
    velocity = np.zeros((count, 2))
    velocity[7] = 0.0, 5.0
    box = np.stack([x, y, 0 * x + 1, 0 * x, 0 * x + 4.8, 0 * x + 2.0], 1)
    box[0, :2] = 0.0
    valid = np.arange(count) != 3
    frame = Frame(
        jnp.asarray(box, jnp.float32), jnp.asarray(velocity, jnp.float32), jnp.zeros(count), jnp.asarray(valid),
        jnp.ones(count, jnp.int32), jnp.zeros(0, jnp.int32),
    )  # fmt: skip
    way = jnp.stack([jnp.arange(0, 100, 5.0), jnp.zeros(20)], 1)

    def near(frame, ignored):
        return Forecast.of(frame, jnp.asarray(0), ignored, way, 2, 50.0)

    found = quick(near, frame, jnp.zeros(count, bool))
    assert sorted(found.box[:, 0].tolist()) == [30.0, 45.0] and found.valid.all()
    without = quick(near, frame, jnp.arange(count) == 9)
    assert 45.0 not in without.box[without.valid, 0].tolist()
    box = quick(lambda f: near(f, jnp.zeros(count, bool)).at(jnp.asarray([0.0, 2.0])), frame)
    assert sorted(box[1, :, 1].tolist()) == pytest.approx([-10.0, 2.0])


def test_overlaps_within_a_horizon_equal_small_steps():
    """Against moving both boxes on in steps of a hundredth of a second."""
    rng = np.random.default_rng(1)
    rows = [
        (rng.uniform(5, 25), rng.uniform(-8, 8), rng.uniform(-3, 3), rng.uniform(0, 9), 1) for _ in range(4)
    ]
    masks = lambda m, o: [predict_overlaps(m, SIZE, o, horizon) for horizon in (0.0, 0.44, 0.9)]  # noqa: E731
    found = np.stack(quick(masks, straight(6.0), others(*rows)))
    assert found.any((1, 2)).all() and not found.all((1, 2)).any()
    for t in range(0, 41, 4):
        for k, (x, y, h, v, _) in enumerate(rows):
            first = np.inf
            for tau in np.arange(0, 0.92, 0.01):
                when = T[t] + tau
                ego = corners(6.0 * when, 0.0, 0.0)
                other = corners(x + v * np.cos(h) * when, y + v * np.sin(h) * when, h)
                if meets(ego, other):
                    first = tau
                    break
            for mask, horizon in zip(found, (0.0, 0.44, 0.9), strict=True):
                # Steps of 0.01 s do not tell what begins at the horizon.
                if abs(first - horizon) > 0.011 or first == horizon == 0.0:
                    assert mask[t, k] == (first <= horizon)


def corners(x, y, h):
    c, s = np.cos(h), np.sin(h)
    return np.array(
        [[x + a * c - b * s, y + a * s + b * c] for a, b in ((2.4, 1), (2.4, -1), (-2.4, -1), (-2.4, 1))]
    )


def meets(a, b):
    """Separating axes of two rectangles."""
    for first, second in ((a, b), (b, a)):
        for side in (0, 1):
            axis = first[side + 1] - first[side]
            if (
                first.dot(axis).max() <= second.dot(axis).min()
                or second.dot(axis).max() <= first.dot(axis).min()
            ):
                return False
    return True


def test_fault_is_decided_at_the_first_contact_only():
    """A follower runs into a slow ego, which later runs into a standing agent: only the second is its fault."""
    both = others((-12, 0, 0, 10, AgentKind.VEHICLE), (15, 0, 0, 0, AgentKind.VEHICLE))

    def times(motion, others):
        return Contacts.along(motion, SIZE, others).fault_times(jnp.ones(41, bool))

    found = quick(times, straight(4.0), both)
    # 15 - 4.8 = 10.2 m at 4 m/s: 2.55 s.
    assert np.isinf(found[0]) and found[1] == pytest.approx(2.6)
