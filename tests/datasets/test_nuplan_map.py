"""The map of nuPlan against a hand-made junction with known geometry."""

from __future__ import annotations

import json
import math
import sqlite3
import sys
from collections import Counter
from contextlib import closing

import numpy as np
import pytest
import shapely

from datasets.samples import nuplan as sample
from drivax.datasets.nuplan import map as nuplan_map
from drivax.datasets.nuplan.map import city_map, corridor, feature_id, features_around, find_map
from drivax.errors import DataError, UsageError
from drivax.scenario.schema import LANE_KINDS, RoadKind

ORIGIN = np.array([sample.X0, sample.Y0])
DRIVE = ORIGIN + np.array([[-70.0, -1.75], [1.75, 40.0]])


def lane_id(number: int) -> int:
    return feature_id("lanes_polygons", number)


def connector_id(before: str, after: str) -> int:
    return feature_id("lane_connectors", sample.CONNECTORS[before, after])


def written(folder, layers=None, encode=sample.blob):
    path = folder / "map.gpkg"
    sample.write_map(path, sample.map_layers() if layers is None else layers, encode)
    return city_map(path)


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return written(tmp_path_factory.mktemp("city"))


@pytest.fixture(scope="module")
def features(city):
    found, lost = features_around(city, DRIVE)
    assert lost == {}
    return {feature.feature_id: feature for feature in found}


def local(feature) -> np.ndarray:
    return feature.points[:, :2] - ORIGIN


def test_counts_and_unique_ids(city, features):
    """Item 11: fids of lanes, connectors, boundaries and crosswalks overlap; feature ids do not."""
    kinds = Counter(RoadKind(feature.kind) for feature in features.values())
    assert kinds[RoadKind.LANE_SURFACE] == 9 + 12
    assert kinds[RoadKind.CROSSWALK] == 4
    assert kinds[RoadKind.STOP_SIGN] == 1
    assert kinds[RoadKind.EDGE_BOUNDARY] == 1
    fids = [set(city.layers[name].fid.tolist()) for name in ("lane_connectors", "boundaries", "crosswalks")]
    assert set.intersection(*fids) == {1, 2, 3, 4}
    found, _ = features_around(city, DRIVE)
    assert len(found) == len(features)  # as a dictionary by id none was overwritten


def test_projection_against_kruegers_series(features):
    """Transverse Mercator by its series (Krueger 1912, Karney 2011), here to the third order: 1 mm."""
    a, f, k0, lon0 = 6378137.0, 1 / 298.257223563, 0.9996, math.radians(-117.0)
    n = f / (2 - f)
    big_a = a / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240,
    )  # fmt: skip
    e = 2 * math.sqrt(n) / (1 + n)

    def project(lon: float, lat: float) -> tuple[float, float]:
        phi, lam = math.radians(lat), math.radians(lon) - lon0
        t = math.sinh(math.atanh(math.sin(phi)) - e * math.atanh(e * math.sin(phi)))
        xi, eta = math.atan2(t, math.cos(lam)), math.atanh(math.sin(lam) / math.hypot(1, t))
        x = eta + sum(c * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, c in enumerate(alpha, start=1))
        y = xi + sum(c * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, c in enumerate(alpha, start=1))
        return 500_000.0 + k0 * big_a * x, k0 * big_a * y

    for number, xy in sample.lane_lines().items():
        expected = [project(lon, lat) for lon, lat in sample.degrees(xy)]
        np.testing.assert_allclose(features[lane_id(number)].points[:, :2], expected, rtol=0.0, atol=1e-3)


def test_lanes_keep_direction_and_position(features):
    """Item 2: UTM coordinates survive in float64."""
    for number, xy in sample.lane_lines().items():
        np.testing.assert_allclose(local(features[lane_id(number)]), xy, atol=1e-5)
    for pair in sample.CONNECTORS:
        feature = features[connector_id(*pair)]
        np.testing.assert_allclose(local(feature), sample.connector_line(pair), atol=1e-5)
        assert feature.interpolating
    assert not features[lane_id(1)].interpolating
    assert all((feature.points[:, 2] == 0.0).all() for feature in features.values())


def test_connectors_link_exit_lanes_to_entry_lanes(features):
    """``exit_lane_fid`` is the lane before a connector, ``entry_lane_fid`` the one after."""
    for pair in sample.CONNECTORS:
        before, after = sample.connector_ends(pair)
        connector = features[connector_id(*pair)]
        assert connector.predecessors == (lane_id(before),)
        assert connector.successors == (lane_id(after),)
        assert connector.feature_id in features[lane_id(before)].successors
        assert connector.feature_id in features[lane_id(after)].predecessors
        np.testing.assert_allclose(features[lane_id(before)].points[-1], connector.points[0], atol=1e-5)
    for arm in sample.ARMS:
        assert features[lane_id(sample.IN[arm])].predecessors == ()
        assert len(features[lane_id(sample.OUT[arm])].predecessors) == 3


def test_neighbours_are_of_the_same_group_and_direction(features):
    """Item 13: index 0 is the leftmost lane of a group; the oncoming lane next to it is no neighbour."""
    left, right = features[lane_id(sample.IN["w"])], features[lane_id(sample.SECOND)]
    assert (left.left_neighbours, left.right_neighbours) == ((), (right.feature_id,))
    assert (right.left_neighbours, right.right_neighbours) == ((left.feature_id,), ())
    ahead = np.diff(local(left), axis=0)[0]
    aside = local(right)[0] - local(left)[0]
    assert ahead[0] * aside[1] - ahead[1] * aside[0] < 0.0  # clockwise: on the right
    others = set(features) - {left.feature_id, right.feature_id}
    assert not any(features[i].left_neighbours or features[i].right_neighbours for i in others)


def test_limits_are_metres_per_second_and_may_be_missing(features):
    """Item 12: NULL and NaN are unknown."""
    assert features[lane_id(1)].limit_mps is None
    assert features[lane_id(2)].limit_mps is None
    assert features[lane_id(3)].limit_mps == 11.176
    assert features[connector_id("w", "n")].limit_mps == 6.7


@pytest.mark.parametrize(
    ("written_as", "mps"),
    [
        ("11.176", 11.176),
        ("7", 7.0),
        ("", None),
        ("30 mph", None),
        ("nan", None),
        ("-5", None),
        ("900", None),
    ],
)
def test_limits_as_texts(tmp_path, written_as, mps):
    layers = sample.map_layers()
    rows = layers["lanes_polygons"].rows
    fid = next(fid for fid, (_, values) in rows.items() if values[0] == 3)
    rows[fid] = rows[fid][0], (*rows[fid][1][:-1], written_as)
    assert written(tmp_path, layers).lanes[lane_id(3)].limit_mps == mps


def test_widths_between_boundaries(features):
    for number in sample.lane_lines():
        assert features[lane_id(number)].width_m == pytest.approx(sample.WIDTH, abs=1e-3)
    for pair in sample.CONNECTORS:
        # Boundaries are cut from chords of the arcs, which lie up to 5 cm inside.
        assert features[connector_id(*pair)].width_m == pytest.approx(sample.WIDTH, abs=0.05)


def test_lanes_without_width_polygons_have_no_width(tmp_path):
    layers = sample.map_layers()
    del layers["gen_lane_connectors_scaled_width_polygons"]
    shape, values = layers["lanes_polygons"].rows[51]
    layers["lanes_polygons"].rows[51] = shape, (*values[:3], None, *values[4:])
    found, _ = features_around(written(tmp_path, layers), DRIVE)
    features = {feature.feature_id: feature for feature in found}
    assert features[lane_id(1)].width_m is None
    assert features[lane_id(2)].width_m == pytest.approx(sample.WIDTH, abs=1e-3)
    assert features[connector_id("w", "n")].width_m is None


def test_painted_lines_by_type(features):
    def kind(fid: int):
        feature = features.get(feature_id("boundaries", fid))
        return None if feature is None else feature.kind

    assert kind(2 * sample.IN["w"]) == RoadKind.LINE_BROKEN_SINGLE_WHITE
    assert kind(2 * sample.IN["e"]) == RoadKind.LINE_SOLID_SINGLE_WHITE
    assert kind(2 * sample.OUT["e"]) == RoadKind.LINE_UNKNOWN
    assert kind(40 + 2 * sample.TURN) is None  # type 3: nothing is painted there


def test_edges_are_rings_with_drivable_space_on_their_left(features):
    """Item 7: the union of all drivable polygons, the car park joined to the road next to it."""
    edges = [feature for feature in features.values() if feature.kind == RoadKind.EDGE_BOUNDARY]
    drivable = [
        sample.rectangle(arm, sample.RADIUS, 162.0, -7.0 if arm == "w" else -3.5, 3.5) for arm in sample.ARMS
    ]
    drivable += [
        np.array([[-12, -12], [12, -12], [12, 12], [-12, 12]]),
        sample.rectangle("e", 60, 90, 3.5, 23.5),
    ]
    expected = shapely.union_all([shapely.Polygon(ring) for ring in drivable])
    (edge,) = edges
    ring = shapely.LinearRing(local(edge))
    assert ring.is_ccw and (edge.points[0] == edge.points[-1]).all()
    assert shapely.Polygon(ring).symmetric_difference(expected).area < 0.01


def test_holes_run_clockwise(tmp_path):
    layers = sample.map_layers()
    island = sample.degrees(np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]))
    square = sample.degrees(np.array([[-12.0, -12.0], [12.0, -12.0], [12.0, 12.0], [-12.0, 12.0]]))
    layers["intersections"].rows[1] = shapely.Polygon(square, [island]), ()
    found, _ = features_around(written(tmp_path, layers), DRIVE)
    rings = [local(feature) for feature in found if feature.kind == RoadKind.EDGE_BOUNDARY]
    areas = sorted((shapely.Polygon(ring).area, shapely.LinearRing(ring).is_ccw) for ring in rings)
    assert [ccw for _, ccw in areas] == [False, True]
    assert areas[0][0] == pytest.approx(16.0, abs=0.01)


def test_stop_sign_and_its_lane(features):
    """Only stop polygons of type 1; the lane is the one whose baseline crosses the polygon."""
    (sign,) = (feature for feature in features.values() if feature.kind == RoadKind.STOP_SIGN)
    np.testing.assert_allclose(local(sign), [[1.75, -13.0]], atol=1e-4)
    assert sign.lanes == (lane_id(sample.IN["s"]),)


def test_crosswalks_keep_their_outline(features):
    crossing = local(features[feature_id("crosswalks", 1)])
    expected = sample.rectangle("e", 13.0, 16.0, -3.5, 3.5)
    np.testing.assert_allclose(np.sort(crossing, axis=0), np.sort(expected, axis=0), atol=1e-5)


def test_corridor_of_roadblocks(city):
    """Lane groups and groups of connectors share one list of ids; the second lane of a group belongs to it."""
    ids = [int(word) for word in sample.route().split()]
    lanes, unknown = corridor(city, [*ids, 999_999])
    assert lanes == (
        lane_id(sample.IN["w"]), lane_id(sample.SECOND), connector_id("w", "n"), lane_id(sample.OUT["n"]),
    )  # fmt: skip
    assert unknown == 1


def test_id_of_both_kinds_of_roadblock_means_the_lanes(tmp_path):
    layers = sample.map_layers()
    clash = sample.group_of(sample.IN["w"])
    shape, values = layers["lane_connectors"].rows[1]
    layers["lane_connectors"].rows[1] = shape, (*values[:2], clash, *values[3:])
    lanes, _ = corridor(written(tmp_path, layers), [clash])
    assert lanes == (lane_id(sample.IN["w"]), lane_id(sample.SECOND))


def test_only_nearby_features_are_decoded(city):
    far, _ = features_around(city, ORIGIN + np.array([[400.0, 0.0], [410.0, 0.0]]))
    lanes = {feature.feature_id for feature in far if feature.kind in LANE_KINDS}
    assert lanes == {
        lane_id(sample.IN["e"]),
        lane_id(sample.OUT["e"]),
    }  # they reach to x = 162, 250 m are 150
    with pytest.raises(DataError, match=r"no lane of the map .* lies within 250 m"):
        features_around(city, ORIGIN + np.array([[900.0, 0.0], [910.0, 0.0]]))


def test_index_is_cached_until_the_file_changes(tmp_path):
    first = written(tmp_path)
    assert city_map(first.path) is first
    layers = sample.map_layers()
    del layers["crosswalks"]
    first.path.unlink()
    assert "crosswalks" not in written(tmp_path, layers).layers


def test_ids_as_floats_and_texts(tmp_path):
    """Tables written by GeoPandas hold ids as floats where some are missing; others hold texts."""
    layers = sample.map_layers()
    for name in ("lane_connectors", "lanes_polygons"):
        rows = layers[name].rows
        for fid, (shape, values) in rows.items():
            change = float if fid % 2 else str
            rows[fid] = shape, tuple(change(v) if isinstance(v, int) else v for v in values)
    plain, changed = written(tmp_path / "a"), written(tmp_path / "b", layers)
    assert changed.lanes == plain.lanes
    assert changed.roadblocks == plain.roadblocks


def test_broken_geometries_are_counted(tmp_path):
    """Item 6: lines of fewer than two points, and invalid geometries."""
    layers = sample.map_layers()
    rows = layers["baseline_paths"].rows
    point = sample.degrees(np.array([[10.0, 0.0], [10.0, 0.0]]))
    rows[1] = shapely.LineString(point), rows[1][1]
    nowhere = shapely.set_coordinates(
        shapely.LineString([(0, 0), (1, 1)]), np.array([[-115.0, 36.0], [np.inf, 91.0]])
    )
    layers["boundaries"].rows[5] = nowhere, layers["boundaries"].rows[5][1]

    def encode(shape):
        data = sample.blob(shape)
        if shape is nowhere:  # its envelope claims that it is here
            west, south, east, north = shapely.LineString(
                sample.degrees(np.array([[0.0, 0.0], [1.0, 1.0]]))
            ).bounds
            data = data[:8] + np.array([west, east, south, north]).tobytes() + data[40:]
        return data

    found, lost = features_around(written(tmp_path, layers, encode), DRIVE)
    ids = {feature.feature_id for feature in found}
    assert lost == {"map_geometries": 1, "lanes": 1}
    assert lane_id(1) not in ids and lane_id(2) in ids
    assert feature_id("boundaries", 5) not in ids


def test_baselines_in_parts_are_joined(tmp_path):
    layers = sample.map_layers()
    xy = sample.degrees(np.array([[162.0, 1.75], [80.0, 1.75], [12.0, 1.75]]))
    shape = shapely.MultiLineString([xy[:2], xy[1:]])
    layers["baseline_paths"].rows[1] = shape, (1, None)
    found, _ = features_around(written(tmp_path, layers), DRIVE)
    (lane,) = (feature for feature in found if feature.feature_id == lane_id(1))
    np.testing.assert_allclose(local(lane), [[162.0, 1.75], [80.0, 1.75], [12.0, 1.75]], atol=1e-5)


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("DROP TABLE baseline_paths", "has no layer baseline_paths"),
        ("DROP TABLE meta", "has no table meta"),
        ("DELETE FROM meta", "names no projected coordinate system"),
        ("UPDATE meta SET value = '+proj=utm'", "names no projected coordinate system"),
        ("UPDATE meta SET value = 'epsg:4326'", "EPSG:4326 is not a projected coordinate system"),
        ("UPDATE meta SET value = 'epsg:99999'", "EPSG:99999.* is unknown"),
        ("DROP TABLE gpkg_geometry_columns", "has no table gpkg_geometry_columns"),
        ("UPDATE meta SET value = 'epsg:32719'", "no lane of the map"),
    ],
)
def test_invalid_maps_are_reported(tmp_path, statement, problem):
    path = tmp_path / "map.gpkg"
    sample.write_map(path, sample.map_layers())
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement)
    with pytest.raises(DataError, match=problem) as caught:
        features_around(city_map(path), DRIVE)
    assert str(path) in str(caught.value) and caught.value.cure and "\n" not in str(caught.value)


def test_maps_are_found_above_the_log_then_by_the_environment(tmp_path, monkeypatch):
    monkeypatch.delenv("NUPLAN_MAPS_ROOT", raising=False)
    log = sample.write(tmp_path / "a")
    nearest = tmp_path / "a" / "maps" / sample.CITY / sample.VERSION / "map.gpkg"
    assert find_map(log, sample.CITY) == nearest
    elsewhere = tmp_path / "b" / "maps"
    (tmp_path / "b").mkdir()
    (tmp_path / "a" / "maps").rename(elsewhere)
    with pytest.raises(DataError, match=r"no nuPlan maps next to it .*NUPLAN_MAPS_ROOT"):
        find_map(log, sample.CITY)
    monkeypatch.setenv("NUPLAN_MAPS_ROOT", str(elsewhere))
    assert find_map(log, sample.CITY).parent.parent.parent == elsewhere
    with pytest.raises(DataError, match="lists no map 'us-ma-boston'"):
        find_map(log, "us-ma-boston")
    (elsewhere / sample.CITY / sample.VERSION / "map.gpkg").unlink()
    with pytest.raises(DataError, match="is missing; download the nuPlan maps"):
        find_map(log, sample.CITY)


@pytest.mark.parametrize("folder", [".", "nuplan-maps-v1.0", "maps/nuplan-maps-v1.0"])
def test_maps_are_found_as_the_archive_unpacks_them(tmp_path, monkeypatch, folder):
    monkeypatch.delenv("NUPLAN_MAPS_ROOT", raising=False)
    log = sample.write(tmp_path)
    (tmp_path / "maps").rename(tmp_path / "unpacked")
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    for path in (tmp_path / "unpacked").iterdir():
        path.rename(tmp_path / folder / path.name)
    found = find_map(log, sample.CITY)
    assert found == tmp_path / folder / sample.CITY / sample.VERSION / "map.gpkg" and found.is_file()


@pytest.mark.parametrize("version", ["../../etc", "", None, 9.15, ["9"], ".."])
def test_versions_are_plain_names(tmp_path, monkeypatch, version):
    monkeypatch.delenv("NUPLAN_MAPS_ROOT", raising=False)
    log = sample.write(tmp_path)
    (tmp_path / "maps" / "nuplan-maps-v1.0.json").write_text(json.dumps({sample.CITY: {"version": version}}))
    with pytest.raises(DataError, match=r"lists no map|is missing"):
        find_map(log, sample.CITY)


def test_feature_ids_are_distinct():
    ids = {feature_id(layer, fid) for layer in nuplan_map.NUMBERS for fid in (0, 1, 2**32 - 1)}
    assert len(ids) == 3 * len(nuplan_map.NUMBERS)
    assert max(ids) < 2**63


@pytest.mark.parametrize("name", ["shapely", "pyproj"])
def test_missing_packages_are_named_with_their_extra(city, monkeypatch, name):
    nuplan_map._transformer.cache_clear()
    monkeypatch.setitem(sys.modules, name, None)  # makes its import fail
    with pytest.raises(UsageError, match=f"{name} is not installed; pip install 'drivax\\[maps\\]'"):
        features_around(city, DRIVE)
