"""Driving scenarios: kinds, flags, capacities, and the padded record that is stored.

A reader or the built-in world produces a :class:`~drivax.scenario.recording.Recording`: ragged, float64, in the map
frame of the source. ``scenario.build.assemble`` makes it a :class:`Scenario`: local frame, float32, with the shapes
of :class:`Capacity`, map segments, grid and routes. This module needs no JAX.
"""

from __future__ import annotations

import enum
import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from drivax.errors import UsageError

SCHEMA_VERSION = 3

#: Steps of a full scenario: 10 past, the current one, 80 future.
STEPS = 91
CURRENT_STEP = 10
DT_S = 0.1
#: Fewest steps of a log that is evaluated or trained on: 20 follow the current one.
LEAST_STEPS = CURRENT_STEP + 1 + 20
#: Largest number of egos in a scenario: a bank holds a bit per ego and lane (``scenario.bank.columns.LaneRow``).
MOST_EGOS = 8


class AgentKind(enum.IntEnum):
    """Class of an agent."""

    NONE = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4
    STATIC = 5


class RoadKind(enum.IntEnum):
    """Type of a map feature, numbered as in the road graph of WOMD."""

    LANE_UNDEFINED = 0
    LANE_FREEWAY = 1
    LANE_SURFACE = 2
    LANE_BIKE = 3
    LINE_UNKNOWN = 5
    LINE_BROKEN_SINGLE_WHITE = 6
    LINE_SOLID_SINGLE_WHITE = 7
    LINE_SOLID_DOUBLE_WHITE = 8
    LINE_BROKEN_SINGLE_YELLOW = 9
    LINE_BROKEN_DOUBLE_YELLOW = 10
    LINE_SOLID_SINGLE_YELLOW = 11
    LINE_SOLID_DOUBLE_YELLOW = 12
    LINE_PASSING_DOUBLE_YELLOW = 13
    EDGE_UNKNOWN = 14
    EDGE_BOUNDARY = 15
    EDGE_MEDIAN = 16
    STOP_SIGN = 17
    CROSSWALK = 18
    SPEED_BUMP = 19
    DRIVEWAY = 20


LANE_KINDS = (RoadKind.LANE_UNDEFINED, RoadKind.LANE_FREEWAY, RoadKind.LANE_SURFACE, RoadKind.LANE_BIKE)
#: Lanes for cars.
CAR_LANE_KINDS = LANE_KINDS[:3]
LINE_KINDS = tuple(kind for kind in RoadKind if 5 <= kind <= 13)
EDGE_KINDS = (RoadKind.EDGE_UNKNOWN, RoadKind.EDGE_BOUNDARY, RoadKind.EDGE_MEDIAN)
POLYGON_KINDS = (RoadKind.CROSSWALK, RoadKind.SPEED_BUMP, RoadKind.DRIVEWAY)


def among(kind: Int[np.ndarray, "*n"], group: tuple[int, ...]) -> Bool[np.ndarray, "*n"]:
    """Mask of kinds (-1 or more) in a group, by table lookup: several times as fast as ``np.isin``."""
    table = _members(group)
    return table[np.minimum(kind, len(table) - 1)]


@cache
def _members(group: tuple[int, ...]) -> Bool[np.ndarray, " kind"]:
    """Mask of the numbers in a group; the last entry stands for larger numbers and -1."""
    result = np.zeros(max(group) + 2, dtype=bool)
    result[list(group)] = True
    return result


def nonzero(mask: Bool[np.ndarray, "*axis"]) -> tuple[Int[np.ndarray, " entry"], ...]:
    """Indices of the true entries by axis: several times as fast as ``np.nonzero`` for two axes or more."""
    return np.unravel_index(mask.ravel().nonzero()[0], mask.shape)


class LightState(enum.IntEnum):
    """State of a traffic light for one lane, numbered as in WOMD; -1 unobserved."""

    UNOBSERVED = -1
    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


class Flag(enum.IntFlag):
    """Facts about a scenario; some decide which metrics are defined and which uses are refused."""

    NONE = 0
    LIGHTS = 1
    LANE_GRAPH = 2
    SPEED_LIMITS = 4
    NO_FUTURE = 8
    CHAINED_GRAPH = 16
    DEFAULT_SIZES = 32
    DIFFERENTIATED_VELOCITY = 64
    TRUNCATED_MAP = 128
    CLOSED_EDGES = 256
    OVERFLOW = 512
    JITTERED_TIME = 1024
    ROUTE = 2048
    ELEVATION = 4096
    #: Some lane without a limit gets the limit of its class (freeway, surface street).
    DEFAULT_LIMITS = 8192


@dataclass(frozen=True)
class Capacity:
    """Padded sizes of a stored scenario; items that do not fit, except routes and egos, are counted in ``overflow``.

    ``egos`` is the largest number of vehicles with a route and a goal, the recorded ego included.
    """

    name: str = "default"
    agents: int = 80
    parked: int = 256
    steps: int = STEPS
    segments: int = 4096
    features: int = 512
    lanes: int = 256
    lights: int = 32
    stops: int = 16
    routes: int = 12
    route_points: int = 400
    road_rows: int = 1024
    events: int = 4
    extension: int = 16
    grid: int = 64
    cell_m: float = 10.0
    #: Longest contiguous run of grid-sorted segments that a query reads per row of three cells.
    edge_run: int = 96
    lane_run: int = 160
    egos: int = 1

    def with_future(self, future_s: float) -> Capacity:
        """Return the capacity of scenarios with ``future_s`` seconds after the current step, 2 to 60.

        Each second beyond 8 s adds 40 m to the room for routes (144 km/h).

        Raises:
            UsageError: ``future_s`` is out of range.
        """
        if not 2.0 <= future_s <= 60.0:
            raise UsageError(f"future_s is {future_s:g}", cure="use 2 to 60 seconds")
        steps = CURRENT_STEP + 1 + round(future_s / DT_S)
        if steps == self.steps:
            return self
        points = self.route_points + 4 * max(steps - self.steps, 0)
        name = f"{self.name}-{(steps - CURRENT_STEP - 1) * DT_S:g}s"
        return replace(self, name=name, steps=steps, route_points=points)

    def with_egos(self, egos: int) -> Capacity:
        """Return the capacity of scenarios with routes for ``egos`` egos, 1 to 8.

        Raises:
            UsageError: ``egos`` is out of range.
        """
        if not 1 <= egos <= MOST_EGOS:
            raise UsageError(f"egos is {egos}", cure=f"use 1 to {MOST_EGOS}")
        return self if egos == self.egos else replace(self, name=f"{self.name}-{egos}egos", egos=egos)


def common_capacity(capacities: Iterable[Capacity]) -> Capacity:
    """Return the smallest capacity that holds scenarios of all these capacities.

    Raises:
        UsageError: They differ in steps or in the grid.
    """
    first, *others = dict.fromkeys(capacities)
    for other in others:
        for name, cure in (("steps", "convert both with one --future-s"), ("grid", ""), ("cell_m", "")):
            if (own := getattr(first, name)) != (value := getattr(other, name)):
                problem = f"capacity {other.name!r} has {name} {value:g}, {first.name!r} {own:g}"
                raise UsageError(problem, cure=cure or "convert both with one --capacity")
    most = {
        f.name: max(getattr(c, f.name) for c in (first, *others))
        for f in fields(Capacity)
        if f.name != "name"
    }
    exact = (c for c in (first, *others) if asdict(c) == most | {"name": c.name})
    return next(exact, Capacity("+".join(sorted({c.name for c in (first, *others)})), **most))


CAPACITIES = {
    "default": Capacity(),
    "large": Capacity(
        name="large", agents=128, parked=384, segments=8192, features=1024, lanes=512, lights=64, stops=32,
        edge_run=160, lane_run=256,
    ),
}  # fmt: skip


def scenario_fields(capacity: Capacity) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return names, dtypes and shapes of a stored scenario, in storage order."""
    c = capacity
    t, a, p, s, m, n = c.steps, c.agents, c.parked, c.segments, c.features, c.lanes
    k, r, o, lt, st = c.routes, c.route_points, c.road_rows, c.lights, c.stops
    cells = c.grid * c.grid
    layout: dict[str, tuple[str, tuple[int, ...]]] = {
        # Longer names are shortened (stored_name); the manifest has them in full.
        "scenario_id": ("S64", ()), "dataset": ("S16", ()), "segment": ("S64", ()), "origin": ("f8", (3,)),
        "dt_s": ("f4", ()), "current_step": ("i2", ()), "steps": ("i2", ()), "flags": ("u4", ()),
        # Agents that move (slot 0 is ego), local frame, time-major; zeros where not valid.
        "agent_xy": ("f4", (t, a, 2)), "agent_z": ("f4", (t, a)), "agent_heading": ("f4", (t, a)),
        "agent_velocity": ("f4", (t, a, 2)), "agent_valid": ("?", (t, a)),
        "agent_seen": ("?", (t, a)),  # of the valid ones, those that ego's sensors would see
        "agent_size": ("f4", (a, 3)), "agent_kind": ("i1", (a,)), "agent_id": ("i4", (a,)),
        "agent_flags": ("u1", (a,)),  # 1 ego, 2 to predict, 4 of interest
        "agent_extension": ("f4", (a, c.extension, 2)),  # 4 m apart beyond the last logged pose, on lanes or straight
        # Agents that stay where they are: one pose, and the steps at which they are observed.
        "parked_xy": ("f4", (p, 2)), "parked_z": ("f4", (p,)), "parked_heading": ("f4", (p,)),
        "parked_size": ("f4", (p, 3)), "parked_kind": ("i1", (p,)), "parked_id": ("i4", (p,)),
        "parked_valid": ("?", (t, p)), "parked_seen": ("?", (t, p)),
        # Lights and stop signs.
        "light_line": ("f4", (lt, 4)),  # stop line from left to right of the lane: x, y, x, y
        "light_z": ("f4", (lt,)), "light_lane": ("i2", (lt,)), "light_heading": ("f4", (lt,)),
        "light_exit_heading": ("f4", (lt,)),  # heading where the controlled lane ends
        "light_state": ("i1", (t, lt)), "stop_xy": ("f4", (st, 2)), "stop_lane": ("i2", (st, 4)),
        # Map segments of at most 4 m: [edges by cell | car lanes by cell | the rest], -1 where a link is missing.
        "segment_a": ("f4", (s, 3)), "segment_b": ("f4", (s, 3)), "segment_kind": ("i1", (s,)),
        "segment_feature": ("i2", (s,)), "segment_lane": ("i2", (s,)), "segment_start_m": ("f4", (s,)),
        "segment_blocks": ("i4", (4,)),  # 0, end of edges, end of lanes, end of the rest
        "feature_id": ("i8", (m,)), "feature_kind": ("i1", (m,)), "feature_closed": ("?", (m,)),
        # Lane graph with dense indices; -1 none or unknown.
        "lane_id": ("i8", (n,)), "lane_kind": ("i1", (n,)), "lane_length": ("f4", (n,)),
        "lane_width": ("f4", (n,)), "lane_limit": ("f4", (n,)), "lane_interpolating": ("?", (n,)),
        "lane_successor": ("i2", (n, 4)), "lane_predecessor": ("i2", (n, 4)),
        "lane_left": ("i2", (n,)),  # same direction only
        "lane_right": ("i2", (n,)), "lane_light": ("i2", (n,)), "lane_stop": ("?", (n,)),
        # Routes at 1 m: row 0 to the goal, row 1 the log's own (privileged), then the other candidates.
        "route_xy": ("f4", (k, r, 2)), "route_z": ("f4", (k, r)), "route_heading": ("f4", (k, r)),
        "route_lane": ("i2", (k, r)), "route_limit": ("f4", (k, r)), "route_points": ("i2", (k,)),
        "goal_xy": ("f4", (2,)),
        "log_progress": ("f4", (t,)),  # arc length of the logged ego along route 0
        # Uniform grid over the square [grid_origin, +cell * grid).
        "grid_origin": ("f4", (2,)), "grid_edge": ("i2", (cells + 1,)), "grid_lane": ("i2", (cells + 1,)),
        "grid_side": ("i4", (cells,)),  # drivable or not, 3 x 3 side cells per cell (scenario.build.grid.pack_sides)
        # Observation polylines: pieces of at most 10 m, in order of rank.
        "road_xy": ("f4", (o, 2)), "road_direction": ("f4", (o, 2)), "road_length": ("f4", (o,)),
        "road_kind": ("i1", (o,)), "road_limit": ("f4", (o,)), "road_curvature": ("f4", (o,)),
        "road_rows": ("i2", ()),
        # Labels of the built-in world.
        "event_kind": ("i1", (c.events,)), "event_start": ("i2", (c.events,)),
        "event_end": ("i2", (c.events,)), "event_actor": ("i4", (c.events, 4)),
    }  # fmt: skip
    return layout | _ego_fields(c.egos - 1, t, r) if c.egos > 1 else layout


def _ego_fields(egos: int, steps: int, points: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the fields of further egos: slot, last step, and route to the goal (as for the recorded ego)."""
    return {
        "ego_slot": ("i2", (egos,)), "ego_last_step": ("i2", (egos,)),
        "ego_on_lanes": ("?", (egos,)),  # otherwise the route is the logged path (privileged)
        "ego_route_xy": ("f4", (egos, points, 2)), "ego_route_z": ("f4", (egos, points)),
        "ego_route_heading": ("f4", (egos, points)), "ego_route_lane": ("i2", (egos, points)),
        "ego_route_limit": ("f4", (egos, points)), "ego_route_points": ("i2", (egos,)),
        "ego_goal_xy": ("f4", (egos, 2)), "ego_log_progress": ("f4", (egos, steps)),
    }  # fmt: skip


#: Names of a scenario. The manifest holds them in full.
NAMES = ("scenario_id", "dataset", "segment")
_DIGEST_DIGITS = 16


def stored_name(text: str, size: int) -> bytes:
    """Encode a name in at most ``size`` bytes; a longer name is cut and ends in ``~`` and digits of its SHA-256."""
    name = text.encode()
    if len(name) <= size:
        return name
    begin = name[: size - _DIGEST_DIGITS - 1].decode(errors="ignore").encode()  # no partial characters
    return begin + b"~" + hashlib.sha256(name).hexdigest()[:_DIGEST_DIGITS].encode()


@cache
def record_dtype(capacity: Capacity) -> np.dtype[Any]:
    """Return the dtype of a stored scenario: 64-byte aligned fields, item size a multiple of 4096."""
    layout = scenario_fields(capacity)
    offsets, end = [], 0
    for field_type in layout.values():
        offsets.append(-(-end // 64) * 64)
        end = offsets[-1] + np.dtype(field_type).itemsize
    names, formats, itemsize = list(layout), list(layout.values()), -(-end // 4096) * 4096
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})


#: Fields in which unused slots and unknown values are -1; they are 0 in all others.
MISSING = (
    "agent_id", "parked_id", "light_lane", "light_state", "stop_lane", "segment_kind", "segment_feature",
    "segment_lane", "feature_id", "feature_kind", "lane_id", "lane_kind", "lane_width", "lane_limit",
    "lane_successor", "lane_predecessor", "lane_left", "lane_right", "lane_light", "route_lane", "route_limit",
    "road_kind", "road_limit", "event_kind", "event_start", "event_end", "event_actor", "ego_slot", "ego_route_lane",
    "ego_route_limit",
)  # fmt: skip


def blank(capacity: Capacity) -> np.ndarray[Any, Any]:
    """Return a record without valid entries: zeros, and -1 for missing indices and values."""
    record = np.zeros((), record_dtype(capacity))
    for name in set(MISSING) & set(record.dtype.names or ()):
        record[name] = -1
    return record


def stack_field(records: Sequence[np.ndarray[Any, Any]], name: str, *part: Any) -> np.ndarray[Any, Any]:
    """Stack a field of records, or the same part of that field, along a new first axis."""
    values = [record[name][part] for record in records]
    if not values[0].ndim:
        return np.array(values)
    return np.concatenate(values).reshape(len(values), *values[0].shape)  # faster than np.stack


#: Smallest and largest stored value of each; -1 is none or unobserved.
_AGENT_KINDS, _ROAD_KINDS, _LIGHT_STATES = (
    (least, int(max(kind))) for least, kind in ((0, AgentKind), (-1, RoadKind), (-1, LightState))
)


@cache
def _float_names(dtype: np.dtype[Any]) -> tuple[str, ...]:
    """Return the names of the fields of floating-point numbers."""
    return tuple(name for name, field in (dtype.fields or {}).items() if field[0].base.kind == "f")


def find_impossible(record: Any) -> str | None:
    """Return the reason why a record cannot be a scenario, or None.

    Integers that size or index arrays must be within bounds, and all floating-point numbers finite.
    """
    steps, agents = record["agent_valid"].shape
    points, segments = record["route_lane"].shape[-1], len(record["segment_lane"])
    last_light = len(record["light_lane"]) - 1
    lane = (-1, int((record["lane_length"] > 0).nonzero()[0].max(initial=-1)))
    blocks, time_step = record["segment_blocks"].tolist(), float(record["dt_s"])
    bounds = {
        "steps": (1, steps), "current_step": (0, int(record["steps"]) - 1),
        "road_rows": (0, len(record["road_length"])), "segment_blocks": (0, segments), "route_points": (0, points),
        "grid_edge": (0, segments), "grid_lane": (0, segments), "segment_lane": lane, "route_lane": lane,
        "light_lane": lane, "stop_lane": lane, "lane_successor": lane, "lane_predecessor": lane, "lane_left": lane,
        "lane_right": lane, "lane_light": (-1, last_light), "segment_feature": (-1, len(record["feature_id"]) - 1),
        "agent_kind": _AGENT_KINDS, "parked_kind": _AGENT_KINDS, "light_state": _LIGHT_STATES,
        "lane_kind": _ROAD_KINDS, "segment_kind": _ROAD_KINDS, "feature_kind": _ROAD_KINDS, "road_kind": _ROAD_KINDS,
    }  # fmt: skip
    if "ego_slot" in record.dtype.fields:
        bounds |= {
            "ego_slot": (-1, agents - 1), "ego_last_step": (-1, steps - 1),
            "ego_route_points": (0, points), "ego_route_lane": lane,
        }  # fmt: skip
    for name, (least, most) in bounds.items():
        values = record[name]
        if not values.size:
            continue
        # Lists are faster than small arrays, of which most have less than 20 numbers.
        numbers = values.ravel().tolist() if values.size < 20 else (int(values.min()), int(values.max()))
        if min(numbers) < least or max(numbers) > most:
            return f"{name} has a number outside {least} to {most}"
    with np.errstate(over="ignore"):
        for name in _float_names(record.dtype):
            values = record[name].ravel()
            if not math.isfinite(values @ values):  # the fastest test; numbers beyond 10^19 are as impossible
                return f"{name} has a number that is not finite"
    if not 0.0 < time_step < 10.0:
        return f"dt_s is {time_step}"
    if not record["agent_valid"].any():
        return "agent_valid has no agent"
    return None if blocks == sorted(blocks) else f"segment_blocks are {blocks}"


@dataclass(frozen=True)
class SourceCounts:
    """Counts of the source before capping and cropping; ``drivax inspect`` shows them."""

    steps: int
    tracks: int
    tracks_valid_now: int
    map_features: dict[str, int]
    map_points: int
    lights: int
    #: Nonzero numbers of items that were dropped or interpolated, by name (``dangling_links``, ...).
    lost: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Scenario:
    """A log as fixed-shape NumPy arrays in a structured record.

    Fields are read as attributes (``scenario.agent_xy``); :func:`scenario_fields` lists them. The origin is the
    position of the ego at the current step, the axes are those of the source. Metres, m/s, radians counter-clockwise
    from +x in [-pi, pi), time step 0.1 s.

    Attributes:
        record: A zero-dimensional structured array of ``record_dtype(capacity)``.
        overflow: Nonzero numbers of agents, segments, ... that did not fit, by name.
        audit: Findings of the audit, by name (``evaluation.audit``).
        tags: Words for filters and strata.
        names: The :data:`NAMES` in full; fields of the record hold long ones shortened (:func:`stored_name`).
    """

    record: np.ndarray[Any, Any]
    capacity: Capacity
    source: SourceCounts
    overflow: dict[str, int] = field(default_factory=dict)
    audit: dict[str, float | int | bool | None] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        # Copying and unpickling look up attributes before fields are set, so reading ``record`` would recurse.
        if name.startswith("__") or name in _OWN_FIELDS:
            raise AttributeError(name)
        try:
            return self.record[name]
        except (ValueError, KeyError, IndexError):
            raise AttributeError(f"a scenario has no field {name!r}") from None

    @property
    def id(self) -> str:
        """Id of the scenario."""
        return self.text("scenario_id")

    def text(self, name: str) -> str:
        """Return ``scenario_id``, ``dataset`` or ``segment`` as the source has it."""
        return self.names.get(name) or bytes(self.record[name][()]).rstrip(b"\0").decode()

    def fit(self, capacity: Capacity) -> Scenario:
        """Return the scenario with the padding of another capacity, at least as large in all sizes."""
        if capacity == self.capacity:
            return self
        record = blank(capacity)
        for name in self.record.dtype.names or ():
            values = self.record[name]
            record[name][tuple(map(slice, values.shape))] = values
        return replace(self, record=record, capacity=capacity)

    @property
    def has(self) -> Flag:
        """Flags of the scenario."""
        return Flag(int(self.record["flags"]))

    @property
    def has_stop(self) -> Bool[np.ndarray, " sign"]:
        """Mask of the slots of stop signs that are in use: unused slots have no lane and lie at the origin."""
        return (self.stop_xy != 0).any(axis=1) | (self.stop_lane >= 0).any(axis=1)


_OWN_FIELDS = {f.name for f in fields(Scenario)}
