from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.scenario.build.assemble import assemble
from experiment_scripts import load_script

from .recordings import driving, make_recording, make_tracks

routes = load_script("data.routes")


def test_coverage_is_the_share_of_steps_within_reach():
    path = driving()
    path[40:60, 1] = 1.6  # 20 of 91 steps are 1.6 m beside the lane
    scenario = assemble(make_recording(tracks=make_tracks([path], heading=np.zeros((1, 91)))))
    scenario = replace(scenario, record=scenario.record.copy())
    scenario.record["route_xy"][0, :, 1] = 0.0
    scenario.record["route_xy"][2:] += 50.0
    assert routes.coverage(scenario)[0] == pytest.approx(71 / 91)
    assert routes.coverage(scenario, reach_m=1.7)[0] == 1.0
    assert routes.coverage(scenario)[-1] == 0.0  # an empty row
    assert routes.coverage(scenario)[1] == 1.0
    assert routes.candidate_coverage(scenario) == pytest.approx(71 / 91)  # the log's own route does not count


def test_log_route_is_not_a_candidate():
    assert routes.candidate_coverage(assemble(make_recording(()))) == 0.0


def test_lanes_cover_nearby_vehicles_of_the_same_direction():
    """Lanes at y = 0 and y = 3.5 to the east."""
    beside = driving()
    beside[50:60, 1] = 1.75  # between the lanes
    beside[60:70, 1] = 3.0
    along = make_recording(tracks=make_tracks([beside], heading=np.zeros((1, 91))))
    assert routes.lane_coverage(assemble(along)) == pytest.approx(81 / 91)
    assert routes.lane_coverage(assemble(along), reach_m=1.8) == 1.0
    back = make_recording(tracks=make_tracks([driving()], heading=np.full((1, 91), np.pi)))
    assert routes.lane_coverage(assemble(back)) == 0.0
    assert routes.lane_coverage(assemble(make_recording(()))) == 0.0
