"""Recordings and scenarios from plain arrays, with errors that name the argument."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int8

from drivax.errors import UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.tracks import DEFAULT_EGO_SIZE, DEFAULT_SIZES
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks, differentiate, interpolate
from drivax.scenario.schema import (
    CURRENT_STEP,
    DT_S,
    LANE_KINDS,
    AgentKind,
    Flag,
    LightState,
    RoadKind,
    Scenario,
)

Array = np.ndarray[Any, Any]

_AGENT_KEYS = ("xy", "heading", "valid", "size", "kind", "velocity", "z", "id")
_ROAD_KEYS = ("lanes", "edges", "crosswalks", "stop_signs")
_LANE_KEYS = ("points", "successors", "left", "right", "limit_mps", "width_m", "kind")
_LIGHT_KEYS = ("lane", "states", "stop_point")
_KINDS = {kind.name.lower(): kind for kind in AgentKind if kind}
_LANE_KINDS = {"surface": RoadKind.LANE_SURFACE, "freeway": RoadKind.LANE_FREEWAY, "bike": RoadKind.LANE_BIKE}
_COLOURS = {"red": LightState.STOP, "yellow": LightState.CAUTION, "green": LightState.GO,
            "unknown": LightState.UNKNOWN, None: LightState.UNOBSERVED}  # fmt: skip


def recording_from_arrays(
    scenario_id: str, agents: Mapping[str, Any], roads: Mapping[str, Any],
    lights: Sequence[Mapping[str, Any]] = (), route: Sequence[int] = (), ego: int = 0,
    dt_s: float = DT_S, dataset: str = "own",
) -> Recording:  # fmt: skip
    """Return a recording of any length from plain arrays in one map frame: metres, radians anticlockwise from +x, m/s.

    Args:
        scenario_id: Name of the recording; windows that are cut from it share it as their segment.
        agents: ``xy`` [agent, time, 2], ``heading`` [agent, time], ``valid`` [agent, time]; box ``size`` [agent, 3] or
            [agent, time, 3] (length, width, height; defaults where it is missing or 0). Optional: ``kind``, one
            per agent ("vehicle", "pedestrian", "cyclist", "other", "static"; vehicles if missing); ``velocity``
            [agent, time, 2] (differentiated positions if missing); ``z`` [agent, time] of the box centre (required if
            the roads have heights); ``id``, integers. Invalid entries may hold anything.
        roads: ``lanes``, a sequence of mappings with ``points`` [point, 2 or 3] in driving direction and optionally
            ``successors``, ``left``, ``right`` (indices in this sequence; neighbours have the same direction),
            ``limit_mps``, ``width_m``, ``kind`` ("surface", "freeway", "bike"); if no lane has successors, lanes are
            joined where they touch. ``edges``, polylines [point, 2 or 3] with the drivable side on the left. Optional:
            ``crosswalks``, polygons; ``stop_signs``, mappings with ``point`` and ``lanes`` (indices).
        lights: Mappings with ``lane`` (index), ``states``, one per step ("red", "yellow", "green", "unknown", None
            if unobserved, or :class:`~drivax.scenario.schema.LightState`), and optionally ``stop_point``, x, y or
            x, y, z (otherwise the beginning of the lane; without z at the height of the lane).
        route: Indices of the lanes of the intended route in order, if known.
        ego: Row of the ego vehicle among the agents.
        dt_s: Seconds between steps; resample agents with steps other than 0.1 s first (:func:`resample`).
        dataset: Short name of the source.

    Raises:
        UsageError: An argument is missing or misspelt, or has another shape or an invalid value.
    """
    if not abs(dt_s - DT_S) <= 1e-3:  # refuses NaN, too
        cure = f"call drivax.scenario.resample(agents, {dt_s}) first, and leave dt_s out"
        raise UsageError(f"dt_s is {dt_s}, scenarios have steps of {DT_S} s", cure=cure)
    _check_keys(agents, _AGENT_KEYS, "agents")
    _check_keys(roads, _ROAD_KEYS, "roads")
    roads = {name: _items(values, f'roads["{name}"]') for name, values in roads.items()}
    features = tuple(_features(roads))
    has_heights = any(feature.points[:, 2].any() for feature in features)
    tracks = _tracks(agents, ego, needs_z=has_heights)
    steps = tracks.valid.shape[1]
    lanes = features[: len(roads.get("lanes", ()))]
    return Recording(
        scenario_id=scenario_id,
        dataset=dataset,
        segment=scenario_id,
        timestamps_s=np.arange(steps) * DT_S,
        current_step=min(CURRENT_STEP, steps - 1),
        ego=ego,
        tracks=tracks,
        features=features,
        lights=tuple(
            _light(light, f"lights[{i}]", lanes, steps) for i, light in enumerate(_items(lights, "lights"))
        ),
        route_lanes=_lane_indices(route, len(lanes), "route"),
        flags=Flag.NONE if "velocity" in agents else Flag.DIFFERENTIATED_VELOCITY,
        tags={"source_format": "arrays"},
    )


def scenario_from_arrays(
    scenario_id: str, agents: Mapping[str, Any], roads: Mapping[str, Any],
    lights: Sequence[Mapping[str, Any]] = (), route: Sequence[int] = (), ego: int = 0,
    dt_s: float = DT_S, dataset: str = "own",
) -> Scenario:  # fmt: skip
    """Return a scenario from plain arrays of at most 91 steps; the current step is 10, or the last of fewer.

    Arguments and errors are those of :func:`recording_from_arrays` and :func:`~drivax.scenario.build.assemble`; cut
    longer recordings with :func:`drivax.scenario.recording.windows`.
    """
    return assemble(recording_from_arrays(scenario_id, agents, roads, lights, route, ego, dt_s, dataset))


def resample(agents: Mapping[str, Any], dt_s: float) -> dict[str, Any]:
    """Resample agents of :func:`recording_from_arrays`, with steps ``dt_s`` apart, to 10 Hz by linear interpolation.

    Headings turn along the shorter arc. A new step is valid if it falls on a valid step or between two neighbouring
    valid steps. The result has no velocities: they follow from the new positions.
    """
    _check_keys(agents, _AGENT_KEYS, "agents")
    if not 0.0 < dt_s <= 10.0:
        raise UsageError(f"dt_s is {dt_s}", cure="give the seconds between two steps")
    valid = _array(agents, "valid", bool, (None, None))
    count, steps = valid.shape
    new_steps = int(np.floor((steps - 1) * dt_s / DT_S + 1e-6)) + 1
    at = np.minimum(np.arange(new_steps) * (DT_S / dt_s), steps - 1)
    # Undo rounding: a new step that falls on an old step must not need the neighbour of that step.
    at = np.where(np.abs(at - np.rint(at)) < 1e-6, np.rint(at), at)
    is_valid = valid[:, np.floor(at).astype(np.int64)] & valid[:, np.ceil(at).astype(np.int64)]

    def resample_field(name: str, shape: tuple[int, ...]) -> Array:
        """Interpolate a field of the agents at the new steps."""
        values = _array(agents, name, float, (count, steps, *shape))
        return interpolate(values, valid, at, angle=name == "heading")

    shapes: dict[str, tuple[int, ...]] = {"xy": (2,), "heading": ()}
    shapes |= {"z": ()} if "z" in agents else {}
    shapes |= {"size": (3,)} if np.ndim(agents.get("size", ())) == 3 else {}
    result = {name: agents[name] for name in ("kind", "id", "size") if name in agents}
    return result | {"valid": is_valid} | {key: resample_field(key, shape) for key, shape in shapes.items()}


def _check_keys(mapping: Any, keys: Sequence[str], what: str) -> None:
    """Refuse anything but a mapping with some of the keys; ``what`` names it in errors."""
    if not isinstance(mapping, Mapping):
        raise UsageError(f"{what} is not a mapping", cure=f"give a dictionary with {', '.join(keys)}")
    for key in mapping:
        if key not in keys:
            raise UsageError(f"{what} has an unknown key {key!r}", cure=f"use {', '.join(keys)}")


def _items(values: Any, what: str) -> list[Any]:
    """Return the items of an iterable as a list; refuse text."""
    try:
        if not isinstance(values, str):
            return list(values)
    except TypeError:
        pass
    raise UsageError(f"{what} is {values!r}", cure="give a list")


def _number(value: Any, what: str) -> float | None:
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what} is {value!r}", cure="give a number") from error


def _array(agents: Mapping[str, Any], name: str, kind: type, shape: tuple[int | None, ...]) -> Array:
    """Return an array of the agents; in its expected ``shape``, None stands for any size."""
    if name not in agents:
        raise UsageError(f'agents["{name}"] is missing', cure="see recording_from_arrays")
    try:
        values = np.array(agents[name], dtype=kind)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f'agents["{name}"] is not an array of numbers', cure="give one row per agent"
        ) from error
    sizes = [actual if size is None else size for size, actual in zip(shape, values.shape, strict=False)]
    if values.ndim != len(shape) or values.shape != tuple(sizes):
        expected = tuple("any" if size is None else size for size in shape)
        problem = f'agents["{name}"] has shape {values.shape}, not {expected}'
        raise UsageError(problem, cure="see recording_from_arrays")
    return values


def _zero_invalid(values: Array, valid: Array) -> Array:
    """Replace invalid entries by zeros."""
    return np.where(valid.reshape(valid.shape + (1,) * (values.ndim - valid.ndim)), values, 0.0)


def _tracks(agents: Mapping[str, Any], ego: int, needs_z: bool) -> Tracks:
    valid = _array(agents, "valid", bool, (None, None))
    count, steps = valid.shape
    xy = _zero_invalid(_array(agents, "xy", float, (count, steps, 2)), valid)
    if not 0 <= ego < count:
        raise UsageError(f"ego is {ego}, there are {count} agents", cure="give its row in agents")
    kind = _kinds(agents, count)
    size = _zero_invalid(_sizes(agents, count, steps), valid)
    if "velocity" in agents:
        velocity = _zero_invalid(_array(agents, "velocity", float, (count, steps, 2)), valid)
    else:
        velocity = differentiate(xy, valid, np.arange(steps) * DT_S)
    if "z" in agents:
        z = _zero_invalid(_array(agents, "z", float, (count, steps)), valid)
    elif needs_z:
        raise UsageError('the roads have heights, agents["z"] is missing', cure="give z of the box centres")
    else:
        default_height_m = np.array([DEFAULT_SIZES[AgentKind(code)][2] for code in kind])
        default_height_m[ego] = DEFAULT_EGO_SIZE[2]
        # The roads are at z = 0, so the centre of a box is at half its height.
        z = _zero_invalid(np.where(size[..., 2] > 0, size[..., 2], default_height_m[:, None]) / 2, valid)
    heading = _zero_invalid(_array(agents, "heading", float, (count, steps)), valid)
    track_id = _array(agents, "id", float, (count,)) if "id" in agents else np.arange(count)
    if (track_id != np.floor(track_id)).any():
        raise UsageError('agents["id"] has a number that is not an integer', cure="number the agents")
    return Tracks(xy, z, heading, velocity, size, valid, kind, track_id.astype(np.int64))


def _kinds(agents: Mapping[str, Any], count: int) -> Int8[np.ndarray, " agent"]:
    kinds = _items(agents.get("kind", ["vehicle"] * count), 'agents["kind"]')
    if len(kinds) != count:
        raise UsageError(f'agents["kind"] has {len(kinds)} entries, not {count}', cure="give one per agent")
    codes = [_member(kind, _KINDS, AgentKind, f'agents["kind"][{row}]') for row, kind in enumerate(kinds)]
    return np.array(codes, np.int8)


def _sizes(agents: Mapping[str, Any], count: int, steps: int) -> Array:
    """Box sizes ``[agent, time, 3]``; zeros stand for default sizes."""
    if "size" not in agents:
        return np.zeros((count, steps, 3))
    if np.ndim(agents["size"]) == 3:
        return _array(agents, "size", float, (count, steps, 3))
    return np.repeat(_array(agents, "size", float, (count, 3))[:, None], steps, axis=1)


def _member(value: Any, names: Mapping[Any, Any], kinds: type[Any], what: str) -> Any:
    """Return the member of an enumeration that a member, a number or a name stands for."""
    try:
        return names[value] if isinstance(value, str) or value is None else kinds(value)
    except (KeyError, ValueError, TypeError) as error:
        words = ", ".join(repr(name) for name in names)
        raise UsageError(f"{what} is {value!r}", cure=f"use {words}") from error


def _features(roads: Mapping[str, Any]) -> Iterator[MapFeature]:
    """Lanes, edges, crosswalks and stop signs, numbered in this order: the id of a lane is its index."""
    lane_count, number = len(roads.get("lanes", ())), itertools.count()
    for i, lane in enumerate(roads.get("lanes", ())):
        yield _lane(next(number), lane, f'roads["lanes"][{i}]', lane_count)
    for name, kind, minimum in (("edges", RoadKind.EDGE_BOUNDARY, 2), ("crosswalks", RoadKind.CROSSWALK, 3)):
        for i, line in enumerate(roads.get(name, ())):
            yield MapFeature(next(number), kind, _points(line, f'roads["{name}"][{i}]', minimum))
    for i, sign in enumerate(roads.get("stop_signs", ())):
        what = f'roads["stop_signs"][{i}]'
        _check_keys(sign, ("point", "lanes"), what)
        if "point" not in sign:
            raise UsageError(f'{what}["point"] is missing', cure="see recording_from_arrays")
        point = _points([sign["point"]], f'{what}["point"]', 1)
        controls = _lane_indices(sign.get("lanes", ()), lane_count, what)
        yield MapFeature(next(number), RoadKind.STOP_SIGN, point, lanes=controls)


def _points(line: Any, what: str, minimum: int) -> Array:
    """Points ``[point, 3]``; heights are 0 if the line has none."""
    try:
        points = np.array(line, dtype=np.float64)
    except (TypeError, ValueError) as error:
        cure = "give (x, y) or (x, y, z) per point"
        raise UsageError(f"{what} is not an array of points", cure=cure) from error
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) < minimum:
        cure = f"give at least {minimum} rows of x, y or x, y, z"
        raise UsageError(f"{what} has shape {points.shape}", cure=cure)
    if not np.isfinite(points).all():
        raise UsageError(f"{what} has a point that is not finite", cure="leave it out")
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _lane(number: int, lane: Any, what: str, lane_count: int) -> MapFeature:
    _check_keys(lane, _LANE_KEYS, what)
    if "points" not in lane:
        raise UsageError(f'{what}["points"] is missing', cure="see recording_from_arrays")
    kind = _member(lane.get("kind", "surface"), _LANE_KINDS, RoadKind, f'{what}["kind"]')
    if kind not in LANE_KINDS:
        raise UsageError(f'{what}["kind"] is {kind!r}', cure=f"use {', '.join(map(repr, _LANE_KINDS))}")
    return MapFeature(
        feature_id=number,
        kind=kind,
        points=_points(lane["points"], f'{what}["points"]', 2),
        limit_mps=_number(lane.get("limit_mps"), f'{what}["limit_mps"]'),
        width_m=_number(lane.get("width_m"), f'{what}["width_m"]'),
        successors=_lane_indices(lane.get("successors", ()), lane_count, f'{what}["successors"]'),
        left_neighbours=_lane_indices(lane.get("left", ()), lane_count, f'{what}["left"]'),
        right_neighbours=_lane_indices(lane.get("right", ()), lane_count, f'{what}["right"]'),
    )


def _lane_indices(indices: Any, lane_count: int, what: str) -> tuple[int, ...]:
    """Check the index or indices of lanes, and return them as a tuple."""
    lanes = [indices] if isinstance(indices, int | np.integer) else _items(indices, what)
    for lane in lanes:
        if not isinstance(lane, int | np.integer) or not 0 <= lane < lane_count:
            raise UsageError(f"{what} names lane {lane!r}, there are {lane_count}", cure="count lanes from 0")
    return tuple(int(lane) for lane in lanes)


def _light(light: Any, what: str, lanes: Sequence[MapFeature], steps: int) -> Light:
    _check_keys(light, _LIGHT_KEYS, what)
    for name in ("lane", "states"):
        if name not in light:
            raise UsageError(f'{what}["{name}"] is missing', cure="see recording_from_arrays")
    indices = _lane_indices(light["lane"], len(lanes), f'{what}["lane"]')
    if len(indices) != 1:
        raise UsageError(f'{what}["lane"] names {len(indices)} lanes', cure="give one light per lane")
    states = _items(light["states"], f'{what}["states"]')
    if len(states) != steps:
        raise UsageError(f'{what}["states"] has {len(states)} entries, not {steps}', cure="give one per step")
    codes = [_member(state, _COLOURS, LightState, f'{what}["states"]') for state in states]
    stop, line = light.get("stop_point"), lanes[indices[0]].points
    point = line[0] if stop is None else _points([stop], f'{what}["stop_point"]', 1)[0]
    if stop is not None and len(stop) == 2:
        point[2] = line[np.hypot(*(line[:, :2] - point[:2]).T).argmin(), 2] + 0.0  # turns -0 into 0
    return Light(indices[0], point, np.array(codes, np.int8))
