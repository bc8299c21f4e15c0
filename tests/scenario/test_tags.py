"""One vocabulary of tags: every value by a hand-made scenario, thresholds exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.lanes import lane_graph
from drivax.scenario.schema import AgentKind, Flag, RoadKind
from drivax.scenario.select.tags import TAGS, junction_lanes

from .recordings import arc, driving, lane, light, line, make_recording, make_tracks, straight_road

DEGREE = np.pi / 180


def bend(angle: float, radius: float = 20.0, lead: float = 30.0) -> np.ndarray:
    """A log of 0.9 m per step: straight to the east, then along an arc to the left (right where negative)."""
    side = np.sign(angle) or 1.0
    turn = arc((lead, side * radius), radius, -side * np.pi / 2, -side * np.pi / 2 + angle, step=0.02)
    tip = turn[-1] + 200.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    way = np.concatenate((line((-20, 0), (lead, 0)), turn[1:], line(tuple(turn[-1, :2]), tuple(tip[:2]))[1:]))
    total = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))))
    s = np.arange(91) * 0.9
    return np.stack([np.interp(s, total, way[:, axis]) for axis in (0, 1)], axis=-1)


def tags_of(features=(), path=None, others=(), kinds=(), **changes) -> dict[str, str]:
    paths = [driving() if path is None else path, *others]
    kind = [AgentKind.VEHICLE, *kinds] if kinds else None
    return assemble(make_recording(features, make_tracks(paths, kind=kind), **changes)).tags


def still(x: float, y: float) -> np.ndarray:
    return np.broadcast_to([float(x), float(y)], (91, 2))


def test_all_tags_exist_with_allowed_values():
    found = tags_of(straight_road())
    assert set(TAGS) <= set(found)
    assert all(found[name] in allowed for name, allowed in TAGS.items())
    assert found["dataset"] == "test"


def test_source_tags_are_kept_and_computed_tags_win():
    found = tags_of(straight_road(), tags={"place": "boston", "family": "ring", "type": "nonsense"})
    assert (found["place"], found["family"], found["type"]) == ("boston", "ring", "straight")


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, "straight"), (9.5, "straight"), (10.5, "lane_follow"), (44.0, "lane_follow"), (46.0, "turn_left"),
        (-46.0, "turn_right"), (-44.0, "lane_follow"), (134.0, "turn_left"), (136.0, "u_turn"), (-136.0, "u_turn"),
    ],
)  # fmt: skip
def test_types_by_heading_where_there_are_no_lanes(angle, expected):
    radius = 15.0  # 136 degrees are 35.6 m, within the 40 m in which a turn must happen
    assert tags_of((), bend(angle * DEGREE, radius, lead=15.0))["type"] == expected


def test_turn_over_more_than_forty_metres_is_a_bend():
    # 45 degrees within 40 m of driving are a radius of 51 m.
    assert tags_of((), bend(80 * DEGREE, 48.0, lead=0.0))["type"] == "turn_left"
    assert tags_of((), bend(80 * DEGREE, 56.0, lead=0.0))["type"] == "lane_follow"


def curve(*, forks: bool):
    """The road along ``bend(90 degrees)``; with another lane that goes straight on."""
    turn = arc((30, 20), 20.0, -np.pi / 2, 0.0)
    lanes = [
        lane(1, line((-100, 0), (30, 0)), successors=(2, 4) if forks else (2,)),
        lane(2, turn, successors=(3,)),
        lane(3, line((50, 20), (50, 300))),
    ]
    return [*lanes, lane(4, line((30, 0), (70, 0)))] if forks else lanes


def test_bending_road_is_not_a_turn_outside_junctions():
    path = bend(90 * DEGREE)
    assert tags_of(curve(forks=False), path)["type"] == "lane_follow"
    assert tags_of(curve(forks=True), path)["type"] == "turn_left"
    assert tags_of(curve(forks=False)[:1], path)["type"] == "turn_left"  # off all lanes
    assert tags_of(curve(forks=True), driving())["type"] == "junction"  # straight on where others turn


def test_junction_lanes_are_short_and_leave_or_enter_at_an_angle():
    def fork(angle: float, length: float = 20.0, **more):
        tip = length * np.array([np.cos(angle), np.sin(angle)])
        return lane_graph(
            (
                lane(1, line((-50, 0), (0, 0)), successors=(2, 3)),
                lane(2, line((0, 0), (length, 0))),
                lane(3, line((0, 0), tuple(tip)), **more),
            ),
            np.zeros(3),
        )

    assert junction_lanes(fork(31 * DEGREE)).tolist() == [False, True, True]
    assert junction_lanes(fork(29 * DEGREE)).tolist() == [False, False, False]
    assert junction_lanes(fork(31 * DEGREE, 61.0)).tolist() == [False, False, False]  # ramps
    assert junction_lanes(fork(5 * DEGREE, 61.0, interpolating=True)).tolist() == [False, False, True]
    entering = lane_graph(
        (
            lane(1, line((-20, 0), (0, 0)), successors=(3,)),
            lane(2, line((0, -20), (0, 0)), successors=(3,)),
            lane(3, line((0, 0), (80, 0))),
        ),
        np.zeros(3),
    )
    assert junction_lanes(entering).tolist() == [True, True, False]
    assert junction_lanes(lane_graph((), np.zeros(3))).tolist() == []


def ramp(angle: float):
    """A lane that joins the ego's at an angle, at x = 40."""
    start = np.array([40.0, 0.0]) - 100 * np.array([np.cos(angle), np.sin(angle)])
    return (
        lane(1, line((-60, 0), (40, 0)), successors=(3,)),
        lane(2, line(tuple(start), (40, 0)), successors=(3,)),
        lane(3, line((40, 0), (300, 0))),
    )


def test_a_merge_is_a_lane_entered_by_two_in_the_same_direction():
    assert tags_of(ramp(15 * DEGREE))["type"] == "merge"
    assert tags_of(ramp(15 * DEGREE)[::2])["type"] == "straight"
    short = tags_of(ramp(15 * DEGREE), driving(3.0))  # ends before the lanes join
    assert short["type"] == "straight"
    crossing = (*ramp(15 * DEGREE), lane(4, line((40, -30), (40, 0)), successors=(3,)))
    assert tags_of(crossing)["type"] == "straight"  # a junction's exit is no merge


def test_a_log_moves_from_five_metres_on():
    ahead = tags_of((), driving(5.7 / 9))
    assert (ahead["moves"], ahead["type"]) == ("yes", "straight")
    standing = tags_of((), driving(4.7 / 9))
    assert (standing["moves"], standing["type"]) == ("no", "straight")
    jitter = np.random.default_rng(0).normal(0.0, 0.1, (91, 2)).clip(-0.2, 0.2)
    assert tags_of((), jitter)["moves"] == "no"


@pytest.mark.parametrize(("count", "expected"), [(4, "low"), (5, "medium"), (19, "medium"), (20, "high")])
def test_density_counts_road_users_within_fifty_metres_now(count, expected):
    others = [still(10.0 + i, 20.0) for i in range(count)]
    beyond = [still(0.0, 50.5)] * 30
    assert tags_of((), others=[*others, *beyond])["density"] == expected
    cones = [AgentKind.VEHICLE] * count + [AgentKind.STATIC] * 30
    assert tags_of((), others=[*others, *[still(3.0, 5.0)] * 30], kinds=cones)["density"] == expected


def test_density_counts_only_agents_valid_at_the_current_step():
    valid = np.ones((11, 91), dtype=bool)
    valid[1:, 10] = False
    tracks = make_tracks([driving(), *[still(10, 9)] * 10], valid=valid)
    assert assemble(make_recording((), tracks)).tags["density"] == "low"


def crossing_car(speed: float = 5.0, angle: float = 90.0, x: float = 40.0):
    """Crosses the ego's way just behind it, at an angle: it is at (x - 4, 0) when ego is at (x, 0)."""
    t = (np.arange(91) - 50) * 0.1
    direction = np.array([np.cos(angle * DEGREE), np.sin(angle * DEGREE)])
    return np.array([x - 4.0, 0.0]) + speed * t[:, None] * direction


def braking(by: float) -> np.ndarray:
    """10 m/s, then ``by`` less within a second."""
    speed = np.interp(np.arange(91), [41, 49], [10.0, 10.0 - by])
    x = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    return np.stack((x - x[10], np.zeros(91)), axis=-1)


@pytest.mark.parametrize(
    ("path", "others", "kinds", "counts"),
    [
        (None, [], (), False),
        (None, [still(40, 14.9)], (AgentKind.PEDESTRIAN,), True),
        (None, [still(40, 15.1)], (AgentKind.PEDESTRIAN,), False),
        (None, [still(40, 14.9)], (AgentKind.CYCLIST,), True),
        (None, [crossing_car()], (AgentKind.VEHICLE,), True),
        (None, [crossing_car(speed=0.9)], (AgentKind.VEHICLE,), False),
        (None, [crossing_car(angle=44.0)], (AgentKind.VEHICLE,), False),
        (None, [crossing_car(angle=46.0)], (AgentKind.VEHICLE,), True),
        (None, [crossing_car(angle=136.0)], (AgentKind.VEHICLE,), False),
        (None, [crossing_car() + np.array([0.0, 60.0])], (AgentKind.VEHICLE,), False),
        (braking(2.05), [], (), True),
        (braking(1.9), [], (), False),
    ],
)
def test_each_demand_counts_once_and_two_make_it_medium(path, others, kinds, counts):
    """With the demand of a dense scene, the one under test makes the difference between easy and medium."""
    crowd = [still(5.0 + i, 30.0) for i in range(20)]
    base = tags_of((), path, [*others, *crowd], (*kinds, *[AgentKind.VEHICLE] * 20) if kinds else ())
    assert base["density"] == "high"
    assert base["difficulty"] == ("medium" if counts else "easy")


def test_three_demands_are_hard_and_a_manoeuvre_is_one():
    walker = (still(40, 5.0), AgentKind.PEDESTRIAN)
    turn = tags_of((), bend(60 * DEGREE))
    assert (turn["type"], turn["difficulty"]) == ("turn_left", "easy")
    assert tags_of((), bend(60 * DEGREE), [walker[0]], [walker[1]])["difficulty"] == "medium"
    all_three = tags_of((), bend(60 * DEGREE), [walker[0], *[still(9, -9)] * 20], [walker[1], *[1] * 20])
    assert all_three["difficulty"] == "hard"


def test_lights_limits_and_lane_graph_are_those_of_the_map():
    plain = straight_road()
    bare = tuple(replace(feature, limit_mps=None) for feature in plain)
    unknown = tuple(
        replace(f, kind=RoadKind.LANE_UNDEFINED) if f.kind == RoadKind.LANE_SURFACE else f for f in bare
    )
    assert [tags_of(road)["limits"] for road in (plain, bare, unknown)] == ["measured", "default", "none"]
    assert tags_of((plain[0], *bare[1:]))["limits"] == "default"  # one lane takes the limit of its class
    assert tags_of(plain)["lights"] == "no"
    assert tags_of(plain, flags=Flag.LIGHTS)["lights"] == "no"  # the source knows that there are none
    assert tags_of(plain, lights=(light(1, 45.0, 0.0, [4] * 91),))["lights"] == "yes"
    assert tags_of(plain)["lane_graph"] == "none"
    assert tags_of(curve(forks=True))["lane_graph"] == "given"
    unlinked = [replace(f, successors=()) for f in curve(forks=True)]
    assert tags_of(unlinked)["lane_graph"] == "chained"


def test_the_kind_of_routes_is_tagged():
    assert tags_of(straight_road())["routes"] == "graph"
    assert assemble(make_recording(), routes="published").tags["routes"] == "published"
