"""Whole recordings through ``assemble``: known answers, refusals, windows, and what must not matter."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble, count_source
from drivax.scenario.recording import Event, MapFeature, windows, with_ego
from drivax.scenario.schema import (
    CAPACITIES,
    MISSING,
    AgentKind,
    Capacity,
    Flag,
    LightState,
    RoadKind,
    blank,
    record_dtype,
)

from .recordings import (
    FAR,
    driving,
    edge,
    lane,
    light,
    line,
    make_recording,
    make_tracks,
    moved,
    straight_road,
)

CROSSWALK = MapFeature(40, RoadKind.CROSSWALK, np.array([[50.0, -2, 0], [53, -2, 0], [53, 5, 0], [50, 5, 0]]))
SIGN = MapFeature(41, RoadKind.STOP_SIGN, np.array([[48.0, -2.0, 0.0]]), lanes=(1,))


def busy_recording(features=None, **changes):
    """Ego, a car ahead, a parked car, a pedestrian that appears late; a light, a crosswalk, a stop sign, an event."""
    valid = np.ones((4, 91), dtype=bool)
    valid[3, :50] = False
    walk = np.stack((np.full(91, 50.0), np.linspace(-3, 6, 91)), axis=-1)
    tracks = make_tracks(
        [driving(), driving(8.0, x=30), np.broadcast_to([20.0, 7.0], (91, 2)), walk],
        valid=valid,
        kind=[AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN],
        heading=[np.zeros(91)] * 3 + [np.full(91, np.pi / 2)],
    )
    states = [LightState.GO] * 40 + [LightState.STOP] * 51
    return make_recording(
        (*(straight_road() if features is None else features), CROSSWALK, SIGN),
        tracks,
        lights=(light(1, 45.0, 0.0, states),),
        to_predict=(1,),
        of_interest=(1, 3),
        events=(Event(3, 20, 60, (101, 103)),),
        **changes,
    )


def same(one, other, skip=(), **tolerance) -> bool:
    return all(
        np.allclose(one.record[name], other.record[name], **tolerance)
        if one.record[name].dtype.kind == "f"
        else np.array_equal(one.record[name], other.record[name])
        for name in one.record.dtype.names
        if name not in skip
    )


def test_closed_edges_is_a_fact_about_the_crop_and_not_about_the_city():
    """An open edge 400 m away changes nothing that is stored; one next to the log clears the flag."""
    ring = edge(70, line((-50, -4), (130, -4), (130, 8), (-50, 8), (-50, -4)))
    road, far, near = lane(1, line((-40, 0), (120, 0))), line((0, 400), (50, 400)), line((0, 20), (50, 20))
    assert Flag.CLOSED_EDGES in assemble(busy_recording((road, ring))).has
    assert Flag.CLOSED_EDGES in assemble(busy_recording((road, ring, edge(71, far)))).has
    assert Flag.CLOSED_EDGES not in assemble(busy_recording((road, ring, edge(71, near)))).has
    assert Flag.CLOSED_EDGES not in assemble(busy_recording((road, edge(71, far)))).has
    plain, other = (assemble(busy_recording((road, ring, *more))) for more in ((), (edge(71, far),)))
    assert same(plain, other)


def test_assembled_record_equals_hand_computation():
    scenario = assemble(busy_recording())
    assert (scenario.id, scenario.tags["dataset"], scenario.overflow) == ("hand-made", "test", {})
    expected = Flag.LIGHTS | Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.CLOSED_EDGES | Flag.ROUTE
    assert scenario.has == expected & ~Flag.LANE_GRAPH  # two lanes without successors are no graph
    assert scenario.agent_id[:4].tolist() == [100, 101, 103, -1]
    assert scenario.agent_flags[:4].tolist() == [1, 6, 4, 0]
    assert scenario.agent_kind[:4].tolist() == [1, 1, 2, 0]
    assert scenario.parked_id[:2].tolist() == [102, -1]
    assert scenario.parked_xy[0].tolist() == [20, 7]
    assert scenario.parked_valid[:, 0].all()
    assert not scenario.parked_valid[:, 1:].any()
    assert scenario.agent_xy[10, 0].tolist() == [0, 0]
    assert scenario.agent_xy[90, 0] == pytest.approx([80, 0])
    assert scenario.agent_valid[:, 2].tolist() == [False] * 50 + [True] * 41
    assert not scenario.agent_xy[:50, 2].any()
    assert scenario.agent_size[0] == pytest.approx([4.6, 1.9, 1.5])
    assert scenario.light_line[0] == pytest.approx([45, 1.75, 45, -1.75])
    assert scenario.light_state[[39, 40], 0].tolist() == [6, 4]
    assert (scenario.light_state[:, 1:] == -1).all()
    assert scenario.lane_light[:3].tolist() == [0, -1, -1]
    assert scenario.lane_stop[:2].tolist() == [True, False]
    assert scenario.lane_width[:2].tolist() == [3.5, 3.5]
    assert (scenario.lane_left[0], scenario.lane_right[1], scenario.lane_left[1]) == (1, 0, -1)
    assert scenario.stop_xy[0].tolist() == [48, -2]
    assert scenario.route_points[0] > 200
    assert scenario.route_limit[0, 0] == pytest.approx(13.4)
    assert scenario.goal_xy == pytest.approx([80, 0])
    assert scenario.log_progress == pytest.approx(20 + np.arange(91.0), abs=1e-3)
    assert scenario.event_kind.tolist() == [3, -1, -1, -1]
    assert scenario.event_actor[0].tolist() == [101, 103, -1, -1]
    assert scenario.road_rows == (scenario.road_length > 0).sum()


def test_segments_refer_to_their_lane_and_feature():
    scenario = assemble(busy_recording())
    blocks = scenario.segment_blocks
    assert blocks[0] == 0
    assert (scenario.segment_kind[: blocks[1]] == RoadKind.EDGE_BOUNDARY).all()
    on_lane = slice(blocks[1], blocks[2])
    side = np.round(scenario.segment_a[on_lane, 1] / 3.5).astype(int)
    assert scenario.segment_lane[on_lane].tolist() == side.tolist()
    assert scenario.lane_id[scenario.segment_lane[on_lane]].tolist() == (1 + side).tolist()
    start = scenario.segment_start_m[on_lane]
    assert start == pytest.approx(scenario.segment_a[on_lane, 0] + 60, abs=1e-3)
    rest = slice(blocks[2], blocks[3])
    assert set(scenario.feature_id[scenario.segment_feature[rest]].tolist()) == {40}
    assert scenario.feature_closed[scenario.segment_feature[rest]].all()
    assert (scenario.segment_kind[blocks[3] :] == -1).all()


def test_the_map_is_cropped_but_lanes_of_routes_stay_whole():
    """Check-list 9: crop to the box of the log and 100 m, keep the lanes that routes need."""
    scenario = assemble(busy_recording())
    edges = slice(0, scenario.segment_blocks[1])
    assert scenario.segment_a[edges, 0].min() > -10 - 100 - 4
    assert scenario.segment_b[edges, 0].max() < 80 + 100 + 4
    lanes = slice(scenario.segment_blocks[1], scenario.segment_blocks[2])
    assert scenario.segment_b[lanes, 0].max() == pytest.approx(300.0)


def test_assembly_is_independent_of_a_distant_map_origin():
    near, far = assemble(busy_recording()), assemble(moved(busy_recording(), FAR))
    assert far.origin == pytest.approx(FAR)
    assert same(near, far, skip=("origin",), atol=2e-4)


def test_assembly_is_deterministic():
    assert assemble(busy_recording()).record.tobytes() == assemble(busy_recording()).record.tobytes()


def test_order_of_features_and_tracks_does_not_change_ego():
    plain = busy_recording()
    order = np.array([2, 0, 3, 1])
    fields = ("xy", "z", "heading", "velocity", "size", "valid", "kind", "track_id")
    tracks = replace(plain.tracks, **{name: getattr(plain.tracks, name)[order] for name in fields})
    shuffled = assemble(
        replace(
            plain, tracks=tracks, ego=1, to_predict=(3,), of_interest=(3, 2), features=plain.features[::-1]
        )
    )
    straight = assemble(plain)
    for name in ("agent_xy", "agent_id", "agent_flags", "parked_id", "route_xy", "log_progress", "grid_edge"):
        assert np.allclose(getattr(straight, name), getattr(shuffled, name), atol=1e-5), name


def test_unused_slots_hold_the_padding_values_of_the_schema():
    record = blank(CAPACITIES["default"])
    for name in record.dtype.names:
        assert (record[name] == (-1 if name in MISSING else type(record[name].flat[0])())).all(), name
    assert assemble(busy_recording()).record.dtype == record_dtype(CAPACITIES["default"])


def test_counts_are_those_of_the_source():
    counts = count_source(busy_recording())
    assert (counts.steps, counts.tracks, counts.tracks_valid_now, counts.lights) == (91, 4, 3, 1)
    assert counts.map_features == {
        "lane": 2, "road_line": 0, "road_edge": 1, "crosswalk": 1, "speed_bump": 0, "stop_sign": 1, "driveway": 0,
    }  # fmt: skip
    assert counts.map_points == sum(len(f.points) for f in busy_recording().features)
    assert assemble(busy_recording()).source == counts


@pytest.mark.parametrize("steps", [1, 11, 30, 31, 66])
def test_short_recordings_are_stored_masked(steps):
    """Those with fewer than 20 steps after the current one are flagged."""
    scenario = assemble(
        make_recording(tracks=make_tracks([driving(steps=steps)], heading=np.zeros((1, steps))))
    )
    assert (Flag.NO_FUTURE in scenario.has) == (steps < 31)
    assert scenario.steps == steps
    assert scenario.agent_valid[:, 0].sum() == steps
    assert Flag.NO_FUTURE not in assemble(make_recording()).has


def test_recording_without_a_map_is_assembled():
    scenario = assemble(make_recording(()))
    assert scenario.has == Flag.NONE
    assert scenario.segment_blocks.tolist() == [0, 0, 0, 0]
    assert not scenario.grid_edge.any()
    assert scenario.route_points[0] > 140


def test_flags_are_measured_rather_than_taken_from_the_reader():
    lying = make_recording((), flags=Flag.LANE_GRAPH | Flag.LIGHTS | Flag.TRUNCATED_MAP | Flag.ROUTE)
    # A source may know that there are no lights; everything else that the data show is not believed.
    assert assemble(lying).has == Flag.TRUNCATED_MAP | Flag.LIGHTS
    hilly = lane(1, line((-60, 0), (300, 0), z=0.0))
    hilly.points[:, 2] = np.linspace(0, 5, len(hilly.points))
    assert Flag.ELEVATION in assemble(make_recording([hilly])).has
    times = np.arange(91) * 0.1
    times[50:] += 0.0021
    assert Flag.JITTERED_TIME in assemble(make_recording(timestamps_s=times)).has
    assert Flag.JITTERED_TIME not in assemble(make_recording(timestamps_s=np.arange(91) * 0.1 + 7)).has
    unsized = make_tracks([driving()], size=(np.nan, 0.0, -1.0))
    assert Flag.DEFAULT_SIZES in assemble(make_recording(tracks=unsized)).has


def test_overflow_is_counted_and_flagged():
    small = Capacity(
        agents=2, segments=200, features=2, lanes=1, routes=2, route_points=100, road_rows=10, events=0, parked=0,
        stops=0, lights=0,
    )  # fmt: skip
    scenario = assemble(busy_recording(), small)
    assert scenario.overflow == {
        "agents": 1, "parked": 1, "segments": scenario.overflow["segments"], "lanes": 1, "features": 2, "lights": 1,
        "stops": 1, "road_rows": scenario.overflow["road_rows"], "events": 1,
    }  # fmt: skip
    assert Flag.OVERFLOW in scenario.has
    assert scenario.lane_id.tolist() == [1]  # the lane of the route
    assert scenario.agent_id.tolist() == [100, 101]
    assert scenario.route_points[0] == 100


def fan(x):
    """A lane with six successors, a hill on them."""
    ends = [line((x + 20, 0), (x + 40, 0.5 * i - 1)) for i in range(6)]
    for points in ends:
        points[:, 2] = np.linspace(0, 5, len(points))
    first = lane(700, line((x, 0), (x + 20, 0)), limit_mps=10.0, successors=tuple(range(701, 707)))
    return (first, *(lane(701 + i, points, limit_mps=None) for i, points in enumerate(ends)))


def city(x):
    """Six successors of one lane, 40 lights without a lane, 17 stop signs, each with a lane, from ``x`` on."""
    signs = (
        MapFeature(800 + i, RoadKind.STOP_SIGN, np.array([[x + i, 9.0, 0]]), lanes=(700,)) for i in range(17)
    )
    return (*fan(x), *signs), tuple(light(900 + i, x + i, 30.0, [4] * 91) for i in range(40))


def test_overflow_and_flags_do_not_speak_of_the_city_outside_the_crop():
    """The crop ends 100 m ahead of the log, at x = 180 m."""
    outside, inside = (
        assemble(
            replace(busy_recording(straight_road()), features=(*straight_road(), *features), lights=lights)
        )
        for features, lights in (city(400.0), city(120.0))
    )
    assert outside.overflow == {} and outside.source.map_features["lane"] == 9
    of_city = Flag.OVERFLOW | Flag.ELEVATION | Flag.DEFAULT_LIMITS | Flag.LANE_GRAPH
    assert not outside.has & of_city
    assert inside.overflow == {"lane_links": 2, "lights_without_lane": 40, "stops": 1}
    assert inside.has & of_city == of_city


def test_default_sizes_speak_of_stored_agents():
    tracks = make_tracks([driving(), driving(8.0, x=500.0)])
    tracks.size[1] = 0.0
    recording = make_recording(tracks=tracks)
    assert Flag.DEFAULT_SIZES in assemble(recording).has
    assert Flag.DEFAULT_SIZES not in assemble(recording, Capacity(agents=1)).has


def test_lane_of_the_route_that_leaves_the_grid_is_no_overflow():
    """The grid is a square of 640 m around the log; the lane that ego drives goes on for 2 km."""
    scenario = assemble(make_recording(straight_road(end=2000.0)[:2]))
    assert scenario.overflow == {} and Flag.OVERFLOW not in scenario.has
    x = scenario.segment_b[: scenario.segment_blocks[2], 0]
    assert 340 < x.max() < 360  # the middle of the log is at 30 m


def test_dangling_references_of_the_source_are_counted():
    """Check-list 11: dense lane indices, dangling links and unknown lanes of the route counted, not followed."""
    road = straight_road()
    linked = (replace(road[0], successors=(7, 8), predecessors=(2, 9), right_neighbours=(5,)), *road[1:])
    recording = replace(
        busy_recording(features=linked),
        route_lanes=(1, 77),
        route_corridor=(1, 2, 88, 89),
        lost={"without_type": 2, "dangling_links": 1},
    )
    assert assemble(recording).source.lost == {
        "without_type": 2, "dangling_links": 4, "dangling_neighbours": 1, "route_lanes_missing": 1,
        "route_corridor_missing": 2,
    }  # fmt: skip
    assert assemble(busy_recording()).source.lost == {}


def test_implausible_limits_and_widths_become_unknown():
    """Sizes, widths and limits beyond all reason are unknown; they would not fit into float32."""
    road = tuple(
        replace(f, limit_mps=1e300, width_m=1e300) if f.kind == RoadKind.LANE_SURFACE else f
        for f in straight_road()
    )
    tracks = make_tracks([driving()], size=(1e300, 2.0, 1.5))
    scenario = assemble(make_recording(road, tracks))
    assert scenario.lane_limit[:2].tolist() == [-1.0, -1.0]
    assert scenario.lane_width[:2].tolist() == [3.5, 3.5]  # measured instead
    assert (scenario.road_limit[: scenario.road_rows] == -1.0).all()
    assert scenario.agent_size[0] == pytest.approx([4.9, 2.0, 1.5])
    assert Flag.DEFAULT_SIZES in scenario.has


def broken(**changes):
    return replace(busy_recording(), **changes)


def with_tracks(**changes):
    recording = busy_recording()
    return replace(recording, tracks=replace(recording.tracks, **changes))


def unchecked(record, **changes):
    """A changed copy that no constructor has checked: tests run with checked constructors, users do not."""
    changed = copy.copy(record)
    for name, value in changes.items():
        object.__setattr__(changed, name, value)
    return changed


def at(array, index, value):
    array = array.copy()
    array[index] = value
    return array


TRACKS = busy_recording().tracks
REFUSED = [
    (with_tracks(valid=at(TRACKS.valid, (0, 10), False)), "the ego is not valid at the current step 10"),
    (with_tracks(xy=at(TRACKS.xy, (1, 7, 0), np.nan)), "tracks.xy of track 101 at step 7 is not finite"),
    (with_tracks(heading=at(TRACKS.heading, (1, 7), np.inf)), "tracks.heading of track 101 at step 7"),
    (broken(tracks=unchecked(TRACKS, z=TRACKS.z[:, 1:])), r"tracks.z has shape \(4, 90\), not \(4, 91\)"),
    (with_tracks(kind=at(TRACKS.kind, 0, 77)), "an agent kind is unknown"),
    (with_tracks(track_id=at(TRACKS.track_id, 0, 2**31)), "track ids do not fit"),
    (broken(ego=9), "track row 9 of 4 tracks"),
    (broken(to_predict=(4,)), "track row 4 of 4 tracks"),
    (broken(current_step=91), "current step 91 of 91 steps"),
    (broken(timestamps_s=np.zeros(0)), "there are no steps"),
    (broken(features=(unchecked(SIGN, kind=99),)), "feature 41 is of unknown kind 99"),
    (broken(timestamps_s=np.zeros(91)), "timestamps do not increase"),
    (broken(timestamps_s=np.arange(91) * 0.5), "steps of 0.500 s instead of 0.1 s; resample"),
    (broken(scenario_id="a\nb"), r"scenario_id 'a\\nb' is empty or contains control characters"),
    (broken(dataset="d" * 17), "dataset .* longer than 16 bytes"),
    (broken(dataset=""), "dataset '' is empty"),
    (broken(features=(unchecked(SIGN, points=np.zeros((3, 2))),)), r"points of feature 41 have shape \(3, 2\)"),
    (broken(features=(lane(8, np.full((3, 3), np.nan)),)), "feature 8 has a point that is not finite"),
    (broken(features=(edge(8, np.zeros((0, 3))),)), "points of feature 8 have shape"),
    (broken(features=straight_road() + straight_road()), "two lanes have the id 1"),
    (broken(features=(lane(8, line((0, 0), (2e5, 0), step=5e4)),)), "feature 8 has a point more than 100 km away"),
    (broken(features=(lane(2**63, line((0, 0), (9, 0))),)), "the feature id 9223372036854775808 does not fit"),
    (broken(features=tuple(lane(i, line((0, i), (9e4, i), step=1e4)) for i in range(6))), "are 540 km long"),
    (with_tracks(xy=at(TRACKS.xy, (0, 7, 0), 1e30)), "the ego jumps or is faster than 100 m/s at step 7"),
    (with_tracks(velocity=at(TRACKS.velocity, (0, 7, 0), -1e30)), "the ego jumps or is faster than 100 m/s at step 7"),
    (broken(timestamps_s=np.arange(91) * 0.1 + 0.6 * (np.arange(91) > 49)), r"step 50 comes 0.700 s .* windows\(\)"),
    (broken(lights=(light(1, 1e9, 0, [4] * 91),)), "a light is more than 100 km away from the ego"),
    (broken(lights=(light(1, 0, 0, [4]),)), "the light of lane 1 has no state from -1 to 8 per step"),
    (broken(lights=(light(1, np.nan, 0, [4] * 91),)), "the light of lane 1 has no finite stop point"),
]  # fmt: skip


@pytest.mark.parametrize(("recording", "message"), REFUSED, ids=[message[:34] for _, message in REFUSED])
def test_invalid_recordings_are_refused_with_record_and_cure(recording, message):
    with pytest.raises(DataError, match=message) as caught:
        assemble(recording)
    assert caught.value.record == recording.scenario_id
    assert caught.value.cure
    assert "\n" not in str(caught.value)


def test_invalid_steps_may_hold_anything():
    valid = at(TRACKS.valid, (1, slice(5, 9)), False)
    junk = at(TRACKS.xy, (1, slice(5, 9)), np.nan)
    scenario = assemble(with_tracks(valid=valid, xy=junk))
    assert not scenario.agent_xy[5:9, 1].any()
    assert np.isfinite(scenario.agent_xy).all()


def test_long_recordings_must_be_cut_with_windows():
    steps = 200
    tracks = make_tracks([driving(steps=steps), driving(x=20.0, steps=steps)])
    long = make_recording(
        tracks=tracks,
        lights=(light(1, 90.0, 0.0, np.arange(steps) % 9),),
        events=(Event(1, 0, 5, (100,)), Event(2, 100, 120, (101,))),
        current_step=0,
    )
    with pytest.raises(DataError, match=r"200 steps, more than 91; cut it with windows\(\)"):
        assemble(long)
    cut = list(windows(long))
    assert [w.scenario_id for w in cut] == ["hand-made@0", "hand-made@40", "hand-made@80"]
    assert {w.segment for w in cut} == {"hand-made"}
    assert {w.current_step for w in cut} == {10}
    assert cut[1].tracks.xy[0, 0].tolist() == tracks.xy[0, 40].tolist()
    assert cut[1].lights[0].states[0] == 40 % 9
    assert [(e.kind, e.start, e.end) for e in cut[1].events] == [(2, 60, 80)]
    assert [(e.kind, e.start, e.end) for e in cut[2].events] == [(2, 20, 40)]
    assert assemble(cut[2]).agent_xy[90, 0] == pytest.approx([80, 0], abs=1e-4)
    assert [len(list(windows(long, stride=stride))) for stride in (1, 91, 109, 110)] == [110, 2, 2, 1]
    short = make_recording()
    assert [w is short for w in windows(short)] == [True]
    with pytest.raises(UsageError, match="a length of 0 steps"):
        next(windows(long, length=0))
    assert [w.current_step for w in windows(replace(short, current_step=20))] == [10]
    assert [(w.scenario_id, len(w.timestamps_s)) for w in windows(long, 20, 161)] == [
        ("hand-made@0", 161), ("hand-made@20", 161),
    ]  # fmt: skip
    assert [(w.scenario_id, w.current_step) for w in windows(long, length=200)] == [("hand-made", 10)]
    eleven_seconds = make_recording(tracks=make_tracks([driving(steps=110)]))  # as in Argoverse 2
    assert [w.scenario_id for w in windows(eleven_seconds)] == ["hand-made@0"]
    with pytest.raises(UsageError, match="a stride of 0 steps"):
        list(windows(long, stride=0))


def test_windows_without_the_ego_are_left_out_and_counted():
    valid = np.ones((1, 200), dtype=bool)
    valid[0, 40:60] = False  # the second of three windows has its current step at 50
    long = make_recording(
        tracks=make_tracks([driving(steps=200)], valid=valid), current_step=0, lost={"boxes": 3}
    )
    cut = list(windows(long))
    assert [w.scenario_id for w in cut] == ["hand-made@0", "hand-made@80"]
    assert [w.lost for w in cut] == [{"boxes": 3, "windows_without_ego": 1}] * 2
    assert assemble(cut[1]).source.lost == {"boxes": 3, "windows_without_ego": 1}
    gone = replace(long, tracks=replace(long.tracks, valid=np.zeros((1, 200), dtype=bool)))
    with pytest.raises(DataError, match="not valid at the current step of any of 3 windows; skip"):
        list(windows(gone))


def test_another_vehicle_can_be_the_ego():
    recording = replace(busy_recording(), route_lanes=(1,), route_corridor=(1, 2))
    other = with_ego(recording, 1)
    assert (other.scenario_id, other.segment, other.route_lanes) == ("hand-made#101", "hand-made", ())
    assert other.route_corridor == ()
    scenario = assemble(other)
    assert scenario.agent_id[0] == 101
    assert scenario.agent_flags[0] == 1 | 2 | 4
    assert scenario.origin.tolist() == [30, 0, 0]
    assert with_ego(recording, 0) is recording
    for row in (3, 4, -1):  # a pedestrian that is not there yet, and no rows
        with pytest.raises(UsageError, match=f"track row {row} is not a vehicle"):
            with_ego(recording, row)
