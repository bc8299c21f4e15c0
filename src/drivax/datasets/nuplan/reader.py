"""Reader of nuPlan: SQLite logs and GeoPackage maps, version 1.1, without GDAL and without the devkit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drivax.datasets import parsing
from drivax.datasets.nuplan import log as nuplan_log
from drivax.datasets.nuplan.log import Agents, Piece, TimeLine
from drivax.datasets.nuplan.map import City, city_map, corridor, feature_id, find_map
from drivax.datasets.nuplan.map_features import features_around
from drivax.datasets.nuplan.sqlite import SQLITE_MAGIC, Database, open_database
from drivax.datasets.parsing import flatten, place_tags
from drivax.datasets.reader import BadRecord, Description
from drivax.errors import DataError
from drivax.scenario.recording import STRIDE, Light, MapFeature, Recording
from drivax.scenario.schema import CURRENT_STEP, STEPS

FORMAT = "nuplan"
DATASET = "nuplan"
#: Tables that tell a nuPlan log from other SQLite files.
_TELLING = ("lidar_pc", "lidar_box", "ego_pose", "scenario_tag")


@dataclass(frozen=True)
class NuPlan:
    """Reads nuPlan logs: one recording per scene at 10 Hz, all of a log in one segment."""

    name: str = FORMAT
    patterns: tuple[str, ...] = ("*_veh-*.db",)
    companions: tuple[str, ...] = ("map.gpkg", "nuplan-maps-*.json")

    def recognise(self, path: Path) -> bool:
        """Whether the file is SQLite and has the tables of a nuPlan log."""
        try:
            with path.open("rb") as file:
                if file.read(len(SQLITE_MAGIC)) != SQLITE_MAGIC:
                    return False
            with open_database(path) as database:
                return all(database.columns(table) for table in _TELLING)
        except (OSError, DataError):
            return False

    def describe(self, path: Path) -> Description:
        """What the log holds, and whether its map is there."""
        with open_database(path) as database:
            log = _open_log(database, path)
            pieces = nuplan_log.pieces(log.line)
        times = log.line.time_us
        scenes = len({piece.scene for piece in pieces})
        notes = [
            f"map {log.map_name}",
            f"{(times[-1] - times[0]) * 1e-6:.0f} s of driving in {scenes} scenes",
        ]
        missing: tuple[str, ...] = ()
        try:
            find_map(path, log.map_name)
        except DataError as error:
            missing = (f"maps/{log.map_name}/<version>/map.gpkg",)
            notes.append(str(error))
        return Description("nuPlan", "SQLite log", None, len(pieces), tuple(notes), missing)

    def count(self, path: Path) -> int:
        """Number of windows of 91 steps at the usual stride; 0 where the log cannot be read."""
        try:
            with open_database(path) as database:
                pieces = nuplan_log.pieces(nuplan_log.time_line(database))
        except DataError:
            return 0
        return sum(max(len(piece.sweeps) - STEPS, 0) // STRIDE + 1 for piece in pieces)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """One recording per scene in order of time, and in their place the scenes that cannot be read."""
        try:
            with open_database(path) as database:
                log = _open_log(database, path)
                city = city_map(find_map(path, log.map_name))
                agents = nuplan_log.agents(database)
                for piece in nuplan_log.pieces(log.line):
                    try:
                        yield _recording(log, piece, agents, city)
                    except DataError as error:
                        yield BadRecord.of(error, path, piece.name)
        except DataError as error:
            yield BadRecord.of(error, path)


@dataclass(frozen=True)
class _Log:
    """An open log: its name, the name of its map, its time line."""

    database: Database
    name: str
    map_name: str
    line: TimeLine


def _open_log(database: Database, path: Path) -> _Log:
    for table, columns in nuplan_log.TABLES.items():
        database.require(table, *columns)
    name, map_name = nuplan_log.log_names(database, path)
    return _Log(database, name, map_name, nuplan_log.time_line(database))


def _recording(log: _Log, piece: Piece, agents: Agents, city: City) -> Recording:
    """The recording of one piece."""
    if len(piece.sweeps) <= CURRENT_STEP:
        raise DataError(
            f"{len(piece.sweeps)} steps without a gap, fewer than {CURRENT_STEP + 1}", cure="skip this record"
        )
    tracks, lost = nuplan_log.tracks(log.database, log.line, piece, agents)
    features, lost_features = features_around(city, tracks.xy[0])
    tracks, features = flatten(tracks, features)
    lights, lost_lights = _lights(log, piece, city, features)
    lanes = {feature.feature_id for feature in features}
    route, unknown = corridor(city, nuplan_log.roadblocks(log.database, piece))
    lost = {**lost, **lost_features, "lights": lost_lights, "roadblocks": unknown}
    types = nuplan_log.scenario_types(log.database, log.line, piece)
    tags = {"source_format": FORMAT} | place_tags(log.map_name)
    return Recording(
        scenario_id=piece.name,
        dataset=DATASET,
        segment=log.name,
        timestamps_s=nuplan_log.timestamps(log.line, piece),
        current_step=CURRENT_STEP,
        ego=0,
        tracks=tracks,
        features=features,
        lights=lights,
        route_corridor=tuple(lane for lane in route if lane in lanes),
        tags=tags | ({"scenario_types": "|".join(types)} if types else {}),
        lost={name: count for name, count in lost.items() if count},
    )


def _lights(
    log: _Log, piece: Piece, city: City, features: tuple[MapFeature, ...]
) -> tuple[tuple[Light, ...], int]:
    """Lights of the connectors around the drive, with stop points where connectors begin.

    Returns:
        The lights, and how many connectors with a light the whole map does not have.
    """
    starts = {feature.feature_id: feature.points[0].tolist() for feature in features}
    lights = parsing.Lights(len(piece.sweeps))
    unknown = set()
    for step, connector, state in nuplan_log.light_states(log.database, log.line, piece):
        good = isinstance(connector, int) and 0 <= connector < 2**32
        lane = feature_id("lane_connectors", connector) if good else -1
        if lane in starts:
            lights.observe(step, lane, state, starts[lane])
        elif lane not in city.lanes:
            unknown.add(connector)
    return lights.collected(), len(unknown)
