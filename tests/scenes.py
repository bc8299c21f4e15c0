"""Hand-made recordings whose right answers can be worked out on paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks, with_ego
from drivax.scenario.schema import CAPACITIES, STEPS, AgentKind, Flag, LightState, RoadKind
from drivax.tasks.observations import ObservationConfig

LANE_M = 3.7


def car(x=0.0, y=0.0, heading=0.0, speed=0.0, length=4.8, width=2.0, kind=AgentKind.VEHICLE, steps=None):
    """A track at constant velocity that is at (x, y) at step 10; ``steps`` are those where it is valid."""
    t = (np.arange(STEPS) - 10) * 0.1
    xy = np.stack([x + speed * t * np.cos(heading), y + speed * t * np.sin(heading)], -1)
    valid = np.ones(STEPS, bool) if steps is None else np.isin(np.arange(STEPS), list(steps))
    return {
        "xy": np.where(valid[:, None], xy, 0.0),
        "heading": np.where(valid, heading, 0.0),
        "velocity": np.where(valid[:, None], speed * np.array([np.cos(heading), np.sin(heading)]), 0.0),
        "valid": valid,
        "size": (length, width, 1.5),
        "kind": int(kind),
    }


def tracks(cars):
    n = len(cars)
    return Tracks(
        xy=np.stack([c["xy"] for c in cars]),
        z=np.zeros((n, STEPS)),
        heading=np.stack([c["heading"] for c in cars]),
        velocity=np.stack([c["velocity"] for c in cars]),
        size=np.stack([np.broadcast_to(c["size"], (STEPS, 3)) for c in cars]).astype(np.float64),
        valid=np.stack([c["valid"] for c in cars]),
        kind=np.array([c["kind"] for c in cars], np.int8),
        track_id=np.arange(n, dtype=np.int64) + 100,
    )


def line(*points):
    return np.array([(*p, 0.0) for p in points], np.float64)


def straight_road(cars, light=None, light_x=40.0, limit=13.4, begin=-150.0, end=350.0):
    """A one-way road along +x: lane 1 on y = 0, lane 2 to its left on y = 3.7, closed by one edge.

    ``cars[0]`` is ego. ``light`` is a state, or one per step, for lane 3, which takes over from lane 1 at ``light_x``.
    """
    half = LANE_M / 2
    features = [
        MapFeature(1, RoadKind.LANE_SURFACE, line((begin, 0), (light_x, 0)), limit, LANE_M, (3,), (), (2,)),
        MapFeature(
            2,
            RoadKind.LANE_SURFACE,
            line((begin, LANE_M), (end, LANE_M)),
            limit,
            LANE_M,
            right_neighbours=(1, 3),
        ),
        MapFeature(3, RoadKind.LANE_SURFACE, line((light_x, 0), (end, 0)), limit, LANE_M, (), (1,), (2,)),
        MapFeature(
            4,
            RoadKind.EDGE_BOUNDARY,
            line((begin, -half), (end, -half), (end, LANE_M + half), (begin, LANE_M + half), (begin, -half)),
        ),
    ]
    lights = ()
    if light is not None:
        states = np.broadcast_to(np.asarray(light, np.int8), (STEPS,)).copy()
        lights = (Light(3, np.array([light_x, 0.0, 0.0]), states),)
    return Recording(
        scenario_id="hand-made",
        dataset="test",
        segment="hand-made",
        timestamps_s=np.arange(STEPS) * 0.1,
        current_step=10,
        ego=0,
        tracks=tracks(cars),
        features=tuple(features),
        lights=lights,
        flags=Flag.LIGHTS | Flag.LANE_GRAPH | Flag.SPEED_LIMITS,
        route_lanes=(1, 3),
    )


#: The least that can be seen, for tests that look at no observation: tracing the default one takes over a second.
GLIMPSE = ObservationConfig(agents=1, steps=1, road=0, lights=1, route=2)
#: One small size for all hand-made scenes: banks of as many scenarios share one compiled program.
SMALL = replace(
    CAPACITIES["default"],
    agents=16,
    parked=8,
    segments=512,
    lights=2,
    road_rows=512,
    edge_run=48,
    lane_run=48,
)


def bank_of(*recordings):
    scenarios = [assemble(recording, SMALL) for recording in recordings]
    assert not any(scenario.overflow for scenario in scenarios)
    return ScenarioBank.from_scenarios(scenarios, trim=False)


def further_egos(recordings, capacity, egos):
    """Scenarios with up to ``egos`` egos, those with each further one as the recorded ego, and its index and number."""
    scenarios = [assemble(recording, capacity.with_egos(egos)) for recording in recordings]
    alone, places = [], []
    for index, (recording, scenario) in enumerate(zip(recordings, scenarios, strict=True)):
        for number, slot in enumerate(scenario.ego_slot.tolist(), start=1):
            if slot >= 0:
                (row,) = np.flatnonzero(recording.tracks.track_id == scenario.agent_id[slot])
                own = with_ego(replace(recording, route_lanes=()), int(row))
                alone.append(assemble(own, capacity))
                places.append((index, number))
    return scenarios, alone, np.array(places)


RED, GREEN = LightState.STOP, LightState.GO
