"""Height: edges, lanes, lights and agents more than 3 m above or below do not exist for a car."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.rollout import drive
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task
from scenes import GLIMPSE, bank_of, car, line, straight_road

METRICS = (
    "collision", "offroad", "lane_straddle", "min_ttc", "speeding_max", "wrong_way", "off_route", "distance",
)  # fmt: skip
SIMULATOR = Simulator(Task(observation=GLIMPSE, metrics=METRICS, to_the_end=True))
DECK_X, CAR_M = 40.0, 0.75


def lifted(feature, height):
    """The same feature at a height, which is a number or a function of x."""
    z = height(feature.points[:, 0]) if callable(height) else np.full(len(feature.points), height)
    return replace(feature, points=np.concatenate([feature.points[:, :2], z[:, None]], axis=1))


def crossing(deck_m, cars, road_m=0.0):
    """A road along +x and a deck across it at x = 40, where only 5 m/s are allowed; ``cars`` come with a height."""
    road = straight_road([one for one, _ in cars], limit=20.0, begin=-60.0, end=200.0)
    half = 1.85
    deck = (
        MapFeature(11, RoadKind.LANE_SURFACE, line((DECK_X, -80), (DECK_X, 80)), 5.0, 3.7),
        MapFeature(12, RoadKind.EDGE_BOUNDARY, line((DECK_X + half, -80), (DECK_X + half, 80))),
        MapFeature(13, RoadKind.EDGE_BOUNDARY, line((DECK_X - half, 80), (DECK_X - half, -80))),
    )
    features = [lifted(feature, road_m) for feature in road.features]
    features += [lifted(feature, deck_m) for feature in deck]
    z = np.stack([np.where(one["valid"], height + CAR_M, 0.0) for one, height in cars])
    return replace(road, features=tuple(features), tracks=replace(road.tracks, z=z))


def judged(recording):
    result = drive(
        SIMULATOR,
        ConstantVelocity(),
        bank_of(recording),
        jnp.arange(1),
        jax.random.split(jax.random.key(0), 1),
    )
    return {name: float(v.value[0]) for name, v in result.metrics.items()}


def test_agent_under_a_bridge_ignores_the_bridge():
    found = judged(crossing(8.0, [(car(0, 0, 0, 10), 0.0), (car(DECK_X, 0, np.pi / 2, 0), 8.0)]))
    assert found["distance"] == pytest.approx(80.0, abs=0.1)
    for name in ("collision", "offroad", "lane_straddle", "speeding_max", "wrong_way", "off_route"):
        assert found[name] == 0.0, name
    assert found["min_ttc"] == 5.0


def test_on_one_level_the_same_crossing_is_a_collision_off_the_road():
    found = judged(crossing(0.0, [(car(0, 0, 0, 10), 0.0), (car(DECK_X, 0, np.pi / 2, 0), 0.0)]))
    assert found["collision"] == 1.0 and found["offroad"] == 1.0 and found["min_ttc"] == 0.0


def test_agent_on_a_bridge_ignores_the_road_below():
    found = judged(crossing(8.0, [(car(DECK_X, -40, np.pi / 2, 10), 8.0), (car(DECK_X, 0, 0, 0), 0.0)]))
    assert found["collision"] == 0.0 and found["offroad"] == 0.0 and found["min_ttc"] == 5.0
    assert found["speeding_max"] == pytest.approx(5.0, abs=1e-3), "10 m/s where the deck allows 5"


@pytest.mark.slow
def test_height_follows_the_map_and_not_the_log():
    """The log stops at the foot of a ramp of 10 %; the car that drives on rises over a car parked 6 m below it."""

    def ramp(x):
        return np.clip((x - 20.0) / 10.0, 0.0, 8.0)

    log, now = car(0, 0, 0, 12), np.arange(91)[:, None] <= 11
    t = np.clip((np.arange(91) - 10) * 0.1, None, 0.1)
    log |= {"xy": np.stack([12 * t, 0 * t], -1), "velocity": np.where(now, [12.0, 0.0], [0.0, 0.0])}
    road = straight_road([log, car(80, 0, 0, 0)], limit=20.0, begin=-60.0, end=200.0)
    features = tuple(dense(feature, ramp) for feature in road.features)
    bank = bank_of(replace(road, features=features, tracks=replace(road.tracks, z=road.tracks.z + CAR_M)))

    @jax.jit
    def driven(bank):
        def one(state, _):
            state, _ = SIMULATOR.step(bank, state, jnp.zeros(2))
            return state, (
                state.context.history[-1, 0],
                state.context.z,
                state.facts.collision,
                state.facts.offroad,
            )

        return jax.lax.scan(one, SIMULATOR.reset(bank, 0), None, 80)[1]

    x, z, collision, offroad = map(np.asarray, driven(bank))
    rises = z - float(bank.agents[0, 10, 0, AgentColumn.Z])
    assert x[-1] > 90 and rises[-1] > 7.0
    np.testing.assert_allclose(rises, ramp(x), atol=0.25)
    assert not collision.any() and not offroad.any()


def dense(feature, height):
    """A feature with a point every 2 m, at a height."""
    points, along = feature.points, [feature.points[:1]]
    for a, b in pairwise(points):
        count = max(int(np.hypot(*(b - a)[:2]) // 2), 1)
        along.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return lifted(replace(feature, points=np.concatenate(along)), height)
