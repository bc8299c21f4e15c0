from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.report.pictures.drawing import LAYERS, Drawing, road_lines, surroundings
from drivax.report.pictures.palette import DARK, LEGEND, LIGHT, agent_colour, light_colour, road_layer
from drivax.scenario.schema import AgentKind, LightState, RoadKind

from .conftest import RADIUS_M, offset_path, on_arc


def test_shuffled_segments_are_joined_to_whole_lines(scenarios):
    lines = road_lines(scenarios[0])
    assert [len(lines[name]) for name in LAYERS] == [1, 1, 1, 1, 2]
    assert len(lines["lane"][0]) == 61
    expected = on_arc(np.linspace(-40, 140, 61), -1.8)[0]
    np.testing.assert_allclose(lines["lane"][0], expected, atol=1e-4)
    np.testing.assert_array_equal(lines["crosswalk"][0][0], lines["crosswalk"][0][-1])


def test_lines_end_at_the_box(scenarios):
    # A low band across the left curve: the edge on the right leaves it and does not come back.
    lines = road_lines(scenarios[0], (-1000.0, -1000.0, 1000.0, 20.0))
    middles = [(line[1:] + line[:-1]) / 2 for group in lines.values() for line in group]
    assert middles and max(float(m[:, 1].max()) for m in middles) <= 20.0
    whole = sum(len(line) - 1 for group in road_lines(scenarios[0]).values() for line in group)
    assert 0 < sum(map(len, middles)) < whole
    nothing = road_lines(scenarios[0], (5000.0, 5000.0, 6000.0, 6000.0))
    assert set(nothing) == set(LAYERS) and not any(nothing.values())


def test_padding_is_not_drawn(scenarios):
    drawing = Drawing.of(scenarios[0], surroundings(scenarios[0], []))
    assert drawing.light_line.shape == (1, 2, 2) and drawing.light_state.shape == (91, 1)
    assert drawing.stops.shape == (1, 2) and drawing.goal.shape == (1, 2)
    assert drawing.route.shape == (100, 2)
    np.testing.assert_allclose(
        np.linalg.norm(drawing.route - (0, RADIUS_M), axis=1), RADIUS_M + 1.8, atol=1e-4
    )
    record = scenarios[0].record.copy()
    record["route_points"][:] = 0
    assert Drawing.of(replace(scenarios[0], record=record), surroundings(scenarios[0], [])).route.shape == (
        0,
        2,
    )


def test_shapes_of_a_step_hold_each_present_agent_once(scenarios):
    scenario = scenarios[0]
    drawing = Drawing.of(scenario, surroundings(scenario, []))
    outlines = {shape.fill: len(shape.lines) for shape in drawing.traffic(30) if shape.level == 4}
    assert outlines == {"parked": 1, "vehicle": 1, "pedestrian": 1, "cyclist": 1}, (
        "the far vehicle is left out"
    )
    lights = {shape.line: len(shape.lines) for shape in drawing.traffic(30) if shape.level == 3}
    assert lights == {"unknown": 0, "red": 1, "amber": 0, "green": 0}
    path = offset_path(scenario, 20.0)
    trail, log, ego, arrow = drawing.ego(path, 60)
    assert len(trail.lines[0]) == 61 and (log.line, ego.fill, arrow.fill) == ("log", "ego", "outline")
    np.testing.assert_allclose(ego.lines[0][:4].mean(axis=0), path[60, :2], atol=1e-5)
    path[60] = np.nan
    assert [shape.line for shape in drawing.ego(path, 60)] == ["ego", "log"], "an absent ego has no box"


def test_every_kind_has_a_colour_in_both_themes():
    names = {agent_colour(kind) for kind in AgentKind} | {light_colour(state) for state in LightState}
    names |= {road_layer(kind) for kind in RoadKind} | {name for name, _ in LEGEND}
    assert names <= set(LIGHT) and set(LIGHT) == set(DARK)
    assert {light_colour(LightState.STOP), light_colour(LightState.GO)} == {"red", "green"}
    assert road_layer(RoadKind.EDGE_MEDIAN) == "edge" and road_layer(RoadKind.LINE_UNKNOWN) == "line"
