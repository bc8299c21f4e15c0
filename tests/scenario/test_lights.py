from __future__ import annotations

import numpy as np
import pytest

from drivax.scenario.build.lanes import LaneSegments, lane_graph, place_lights, place_stops
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import LightState, RoadKind

from .recordings import arc, lane, light, line

ZERO = np.zeros(3)
PATH = np.array([[0.0, 0.0]])


def placed(features, lights, most=8):
    graph = lane_graph(features, ZERO)
    on = LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)
    return place_lights(lights, on, ZERO, PATH, 100.0, most)


def test_a_stop_line_lies_across_its_lane_from_left_to_right():
    features = (
        lane(1, line((20, 0), (20, 40)), width_m=3.0),
        lane(2, arc((0, 0), 30.0, 0.0, np.pi / 2, step=0.1)),
    )
    states = [LightState.STOP, LightState.UNOBSERVED, LightState.GO]
    lights = placed(features, [light(1, 20, 10, states), light(2, 30, 0, [4, 4, 4])])
    assert lights.line[0] == pytest.approx([18.5, 10, 21.5, 10])
    assert lights.line[1] == pytest.approx([30 - 1.85, 0, 30 + 1.85, 0], abs=0.1)
    assert lights.heading == pytest.approx([np.pi / 2, np.pi / 2], abs=0.05)
    assert lights.exit_heading == pytest.approx([np.pi / 2, np.pi], abs=0.05)
    assert lights.state.tolist() == [states, [4, 4, 4]]
    assert lights.lane.tolist() == [0, 1]


def test_a_light_without_its_lane_takes_the_nearest_direction_or_is_counted():
    features = (lane(1, line((0, 0), (40, 0))),)
    lights = placed(features, [light(77, 10, 1, [4]), light(78, 10, 30, [4])])
    assert lights.lane.tolist() == [-1]
    assert lights.line[0] == pytest.approx([10, 2.85, 10, -0.85])
    assert lights.overflow == {"lights_without_lane": 1}
    assert placed((), [light(1, 0, 0, [4])]).overflow == {"lights_without_lane": 1}
    assert placed((), [light(1, 101, 0, [4])]).overflow == {}  # beyond the margin lanes are cropped too
    assert len(placed((), []).z) == 0


def test_a_light_without_its_lane_ignores_lanes_on_a_bridge():
    road, bridge = lane(1, line((0, 0), (40, 0))), lane(2, line((10, 40), (10, -40), z=6.0))
    far = lane(3, line((0, 60), (40, 60)))
    below, above = light(77, 10, 1.5, [4]), light(78, 10, 1.5, [4])
    above.stop_point[2] = 6.0
    for order in ((road, bridge), (bridge, road)):
        assert placed(order, [below, above]).heading == pytest.approx([0.0, -np.pi / 2])
    assert placed((bridge, far), [below]).overflow == {"lights_without_lane": 1}
    # On a map of one level the height may be that of the lamp.
    above.stop_point[2] = 5.0
    assert placed((road,), [above]).heading == [0.0]


def test_the_nearest_lights_are_kept():
    features = tuple(lane(i, line((10 * i, 0), (10 * i, 9))) for i in range(5))
    lights = placed(features, [light(i, 10 * i, 0, [4]) for i in (3, 1, 4, 0, 2)], most=3)
    assert lights.lane.tolist() == [0, 1, 2]
    assert lights.overflow == {"lights": 2}


def test_stop_signs_refer_to_the_lanes_they_control():
    features = (
        *(lane(i, line((0, i), (9, i))) for i in range(6)),
        MapFeature(50, RoadKind.STOP_SIGN, np.array([[9.0, 3, 0]]), lanes=(2, 99, 4)),
        MapFeature(51, RoadKind.STOP_SIGN, np.array([[1.0, 1, 0]]), lanes=(0, 1, 2, 3, 4)),
        MapFeature(52, RoadKind.STOP_SIGN, np.array([[90.0, 0, 0]])),
    )
    stops = place_stops(features, lane_graph(features, ZERO), ZERO, PATH, 100.0, 2)
    assert stops.xy.tolist() == [[1, 1], [9, 3]]
    assert stops.lane.tolist() == [[0, 1, 2, 3], [2, 4, -1, -1]]
    assert stops.overflow == {"stops": 1, "stop_lanes": 1}


def test_stop_signs_outside_the_crop_neither_count_nor_take_slots():
    far = [MapFeature(60 + i, RoadKind.STOP_SIGN, np.array([[101.0 + i, 0, 0]])) for i in range(3)]
    corner = MapFeature(
        70, RoadKind.STOP_SIGN, np.array([[99.0, 99.0, 0]])
    )  # 140 m away, inside the margin of 100 m
    graph = lane_graph((), ZERO)
    stops = place_stops((*far, corner), graph, ZERO, PATH, 100.0, 2)
    assert stops.xy.tolist() == [[101, 0], [99, 99]]
    assert stops.overflow == {}
    near = MapFeature(71, RoadKind.STOP_SIGN, np.array([[-50.0, 0, 0]]))
    stops = place_stops((*far, corner, near), graph, ZERO, PATH, 100.0, 1)
    assert (stops.xy.tolist(), stops.overflow) == ([[-50, 0]], {"stops": 1})
