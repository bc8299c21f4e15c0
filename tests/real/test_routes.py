"""Candidate routes cover the logs of real recordings (``../shared/data``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from drivax.datasets.reader import BadRecord
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows, with_ego
from drivax.scenario.schema import AgentKind, Flag
from experiment_scripts import load_script

routes = load_script("data.routes")


@dataclass(frozen=True)
class Source:
    """A real file whose format has a lane graph, and the logs in it that no candidate covers.

    ``exceptions`` are scenario ids. Each is a car that drives between lanes, cuts a corner, or drives where the map
    lacks its lane: the test asserts that for more than 5 % of its steps no lane of its direction is within 1.5 m, so no
    route along lanes could cover it.
    """

    module: str
    reader: str
    path: str
    needs: str
    exceptions: frozenset[str] = field(default_factory=frozenset)


_OVERPASS, _MIAMI = "eb4b91b10ca94ff2", "3b3570b4-7b0b-3268-a571-b0889dbf40b6"
SOURCES = {
    "womd": Source(
        "womd.scenario_reader", "WomdScenario", "womd/motion_data_one_scenario.tfrecord", "google.protobuf",
        frozenset({"637f20cafde22ff8#1662"}),
    ),
    "scenarionet": Source(
        "scenarionet.reader", "ScenarioNet", f"scenarionet/sd_waymo_v1.2_{_OVERPASS}.pkl", "numpy",
        frozenset(f"{_OVERPASS}@{rest}" for rest in ("0#5", "80#29", "80#33")),
    ),
    "av2-motion": Source(
        "argoverse.motion", "ArgoverseMotion", "av2/*/scenario_*.parquet", "pyarrow",
        frozenset({"0a1e6f0a-1817-4a98-b02e-db8c9327d151@0#139310"}),
    ),
    "av2-sensor": Source(
        "argoverse.sensor", "ArgoverseSensor", "av2_sensor/*/annotations*.feather", "pyarrow",
        frozenset(f"{_MIAMI}@{rest}" for rest in ("0#17", "0#35", "0#58")),
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=SOURCES)
def source(request) -> Source:
    return SOURCES[request.param]


@pytest.fixture(scope="module")
def recordings(source: Source, real_data: Path) -> list[Recording]:
    """The windows of the file."""
    for package in (source.needs, "shapely"):
        pytest.importorskip(package, reason=f"needs {package}")
    reader = getattr(import_module(f"drivax.datasets.{source.module}"), source.reader)()
    records = [record for file in sorted(real_data.glob(source.path)) for record in reader.read(file)]
    assert records
    assert not [record for record in records if isinstance(record, BadRecord)]
    return [window for record in records for window in windows(record)]


def moving_vehicles(recording: Recording) -> list[int]:
    """Rows of vehicles that are valid at the current step and whose positions are more than 3 m apart."""
    tracks = recording.tracks
    is_vehicle = (tracks.kind == AgentKind.VEHICLE) & tracks.valid[:, recording.current_step]
    return [
        int(row)
        for row in np.flatnonzero(is_vehicle)
        if np.ptp(tracks.xy[row, tracks.valid[row]], axis=0).max() > 3.0
    ]


def test_some_candidate_covers_the_log_of_every_ego_that_moves(source, recordings):
    moving = 0
    for recording in recordings:
        scenario = assemble(recording)
        assert Flag.LANE_GRAPH in scenario.has
        assert Flag.CHAINED_GRAPH not in scenario.has
        if scenario.tags["moves"] == "yes":
            moving += 1
            assert Flag.ROUTE in scenario.has
            assert routes.candidate_coverage(scenario) >= routes.SHARE, scenario.id
    assert moving == (
        0 if source.module == "womd.scenario_reader" else len(recordings)
    )  # WOMD's ego is parked


def test_some_candidate_covers_the_logs_of_vehicles_on_lanes(source, recordings):
    """Every moving vehicle of every second window whose log ends on lanes, taken as ego; exceptions by name."""
    uncovered, routed = set(), 0
    for recording in recordings[::2]:
        for row in moving_vehicles(recording):
            scenario = assemble(with_ego(recording, row))
            if scenario.tags["moves"] == "no" or Flag.ROUTE not in scenario.has:
                continue
            routed += 1
            if routes.candidate_coverage(scenario) < routes.SHARE:
                uncovered.add(scenario.id)
                assert routes.lane_coverage(scenario) < routes.SHARE, scenario.id
    assert uncovered <= source.exceptions
    assert routed >= 4


def test_published_routes_on_real_maps(recordings):
    scenario = assemble(recordings[0], routes="published")
    for row in (0, *range(2, scenario.capacity.routes)):
        points = scenario.route_points[row]
        if points:
            step = np.hypot(*np.diff(scenario.route_xy[row, :points].astype(np.float64), axis=0).T)
            assert step == pytest.approx(np.ones(points - 1), abs=0.03)
    assert (scenario.route_points[2:] > 0).sum() <= 10
    assert scenario.tags["routes"] == "published"
