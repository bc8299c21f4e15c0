"""The scenario bank: scenarios stacked on the device, an argument of all simulation.

Padding that no scenario uses is trimmed. The layout is that of the reads of a step: agents are time-major (a frame is a
contiguous read), map segments are feature-major (a grid query is three contiguous reads per feature).
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt, UInt32

from drivax.errors import DataError, DrivaxError
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import RoadLayer, SizeColumn
from drivax.scenario.bank.strands import corridor_lanes, lane_strands
from drivax.scenario.record import record, static
from drivax.scenario.schema import (
    EDGE_KINDS,
    LANE_KINDS,
    LEAST_STEPS,
    POLYGON_KINDS,
    Capacity,
    RoadKind,
    Scenario,
    among,
)

#: Types of map queries: a number, an index, and a point or direction.
Scalar = Float[Array, ""]
Integer = Int[Array, ""]
Vector = Float[Array, " 2"]
#: Sizes are multiples of this, so that banks of similar scenarios share programs.
_MULTIPLE = 8
#: Lane width where the source gives none, m.
DEFAULT_LANE_WIDTH_M = 3.7
#: Limits of a lane's class where the source gives none, m/s (semantics, ``speeding``).
CLASS_LIMIT_MPS = {int(RoadKind.LANE_FREEWAY): 29.1, int(RoadKind.LANE_SURFACE): 13.4}
#: Arc length of stop lines that are not on the route.
NEVER_M = 1e6
#: Steps in a word of ``parked_when``.
WORD = 32


@dataclass(frozen=True)
class Sizes:
    """Sizes of the arrays of a bank; banks of the same sizes run the same compiled programs.

    Attributes:
        agents, slots: Moving agents; slots of a frame for moving and parked agents.
        edges, lanes, road: Segments of road edges and of car lanes, and pieces of road to observe.
        edge_run, lane_run: Longest run of a row of three grid cells.
        graphs: Lanes of the graph.
        long_ego: Whether some ego is too long for a single grid query.
    """

    agents: int
    slots: int
    lights: int
    edges: int
    lanes: int
    edge_run: int
    lane_run: int
    graphs: int
    road: int
    long_ego: bool

    @classmethod
    def whole(cls, capacity: Capacity) -> Sizes:
        """Return the sizes of a capacity."""
        own = {name: getattr(capacity, name) for name in ("agents", "lights", "edge_run", "lane_run")}
        own |= {"edges": capacity.segments, "lanes": capacity.segments, "graphs": capacity.lanes}
        slots = capacity.agents + capacity.parked
        return cls(**own, slots=slots, road=capacity.road_rows, long_ego=False)

    @classmethod
    def used(cls, scenarios: Iterable[Scenario]) -> Sizes:
        """Return the sizes that one or more scenarios of one capacity use."""
        needed = [_needed(scenario) for scenario in scenarios]
        if not needed:
            raise DrivaxError("a bank needs at least one scenario", cure="check the set and its filters")
        return cls(*(max(getattr(sizes, field.name) for sizes in needed) for field in fields(cls)))


def last_used(mask: Any) -> np.ndarray[Any, Any]:
    """Number of columns of ``mask [N, columns]`` up to the last true one, per row."""
    return np.where(mask.any(1), mask.shape[1] - np.argmax(mask[:, ::-1], axis=1), 0)


def _needed(scenario: Scenario) -> Sizes:
    capacity, record = scenario.capacity, scenario.record
    masks = {
        "agents": record["agent_valid"].any(0), "parked": record["parked_valid"].any(0),
        "lights": (record["light_state"] >= 0).any(0), "graphs": record["lane_length"] > 0,
    }  # fmt: skip
    ends = {name: int(last_used(np.asarray(mask)[None])[0]) for name, mask in masks.items()}
    agents = max(1, _rounded(ends["agents"], capacity.agents))
    slots = _rounded(ends["agents"] + ends["parked"], capacity.agents + capacity.parked)
    _, edges, segments = (int(number) for number in record["segment_blocks"][:3])
    half_m = float(np.hypot(*record["agent_size"][0, :2])) / 2
    return Sizes(
        agents=agents,
        slots=max(slots, agents),
        lights=max(1, _rounded(ends["lights"], capacity.lights)),
        edges=edges,
        lanes=segments - edges,
        edge_run=_longest_run(record["grid_edge"], capacity.grid),
        lane_run=_longest_run(record["grid_lane"], capacity.grid),
        graphs=max(1, _rounded(ends["graphs"], capacity.lanes)),
        road=max(1, int(record["road_rows"])),
        # Edges count up to 3 m from a corner; the 3 x 3 block is exact within a cell less half a segment.
        long_ego=half_m + 3.0 > capacity.cell_m - 2.0,
    )


def _rounded(count: int, most: int) -> int:
    return min(most, -(-count // _MULTIPLE) * _MULTIPLE)


def _longest_run(start: np.ndarray[Any, Any], grid: int) -> int:
    """Longest run over three neighbouring cells of a grid row, rounded up to a multiple of 8."""
    begin, end = (part.reshape(grid, grid).astype(np.int64) for part in (start[:-1], start[1:]))
    return -(-max(int((end[:, 2:] - begin[:, :-2]).max()), 1) // _MULTIPLE) * _MULTIPLE


@record
class ScenarioBank:
    """Scenarios on the device: N scenarios, T steps, A moving agents, S slots of a frame.

    The slots of parked agents follow those of the moving agents of the same scenario, so that a frame has as many slots
    as the largest scenario needs.

    Attributes:
        agents: Moving agents, :class:`AgentColumn`; slot 0 is ego.
        agent_box: Size and kind of all agents, :class:`SizeColumn`.
        parked: Parked agents in their slots, :class:`AgentColumn`.
        parked_when: Steps at which parked agents are observed: bit ``t % 32`` of word ``t // 32``.
        light_line: Stop lines, :class:`LightRow`.
        edges, lanes: Segments of road edges (drivable side on the left) and of car lanes, sorted by grid cell,
            :class:`EdgeRow` and :class:`LaneRow`.
        lane_strands: Strand, neighbours and end of every lane of the graph, :class:`StrandColumn`.
        grid_edge, grid_lane: Start of the run of each cell in ``edges`` and ``lanes`` (row-major, plus the end).
        grid_side: Drivable sides beyond the cut-off of all edges (``scenario.build.grid.packed``).
        map_box: Smallest and largest x, y of edges and lanes.
        routes: Points 1 m apart, :class:`RouteColumn`; route 0 leads to the goal, route 1 is the log's own.
        log_progress, log_ahead: Arc length of the logged ego along route 0; distance that it still drives, m.
        road: Pieces of road to observe, in order of rank, :class:`RoadColumn`.
        road_at, road_curvature: x, y and layer of the same pieces; their curvature, left positive, 1/m.
        flags: ``scenario.schema.Flag`` bits.
        last_step: Last step of each log; beyond it, up to T, there is only padding.
        identity: Seeds of the random numbers of a scenario (:func:`identities`).
        extension: Points 4 m apart beyond the last logged pose of moving agents, along their lane: x, y.
        cell_m, edge_run, lane_run: Grid cell size; longest run of a row of three cells.
        long_ego: Whether some ego is too long for a single grid query.
        trimmed: Whether unused padding was cut.
    """

    agents: Float[Array, "N T A 8"]
    agent_box: Float[Array, "N S 4"]
    parked: Float[Array, "N S 8"]
    parked_when: UInt[Array, "N W S"]
    light_line: Float[Array, "N 10 L"]
    light_state: Int[Array, "N T L"]
    edges: Float[Array, "N 5 E"]
    lanes: Float[Array, "N 8 C"]
    lane_strands: Float[Array, "N G 6"]
    grid_edge: Int[Array, "N cells1"]
    grid_lane: Int[Array, "N cells1"]
    grid_side: Int[Array, "N cells"]
    grid_origin: Float[Array, "N 2"]
    map_box: Float[Array, "N 4"]
    routes: Float[Array, "N 2 R 7"]
    route_points: Int[Array, "N 2"]
    goal: Float[Array, "N 2"]
    log_progress: Float[Array, "N T"]
    log_ahead: Float[Array, "N T"]
    road: Float[Array, "N O 7"]
    road_at: Float[Array, "N 3 O"]
    road_curvature: Float[Array, "N O"]
    flags: UInt[Array, " N"]
    last_step: Int[Array, " N"]
    identity: UInt[Array, " N"]
    extension: Float[Array, "N A X 2"]
    cell_m: float = static()
    edge_run: int = static()
    lane_run: int = static()
    long_ego: bool = static()
    trimmed: bool = static()

    def __len__(self) -> int:
        return self.agents.shape[0]

    @property
    def steps(self) -> int:
        """Number of steps T, of which a short log fills fewer."""
        return self.agents.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of the bank on the device."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self))

    def length_m(self, index: Integer, slot: int | Integer) -> Scalar:
        """Length of an agent, m."""
        return self.agent_box[index, slot, SizeColumn.LENGTH]

    def height_m(self, index: Integer, slot: int | Integer) -> Scalar:
        """Height of an agent, m."""
        return self.agent_box[index, slot, SizeColumn.HEIGHT]

    def part(self, rows: Int[Array, " n"]) -> ScenarioBank:
        """Select scenarios."""
        return jax.tree.map(lambda leaf: leaf[rows], self)

    @classmethod
    def from_scenarios(
        cls, scenarios: Iterable[Scenario], *, trim: bool | Sizes = True, allow_no_future: bool = False
    ) -> ScenarioBank:
        """Stack scenarios of one capacity.

        ``trim`` cuts unused padding, or cuts to given sizes: banks of the same sizes share compiled programs, smaller
        banks are faster. ``allow_no_future`` accepts logs with fewer than 20 steps after the current one.

        Raises:
            DrivaxError: There are no scenarios, their capacities differ, or a log is too short.
        """
        kept = list(scenarios)
        for scenario in kept:
            if scenario.steps < LEAST_STEPS and not allow_no_future:
                cure = "leave it out (flag!=NO_FUTURE)"
                raise DataError(too_short(int(scenario.steps)), record=scenario.id, cure=cure)
            if scenario.capacity != kept[0].capacity:
                own, others = (f"{c.name!r} ({c.steps} steps)" for c in (scenario.capacity, kept[0].capacity))
                cure = "convert all sets with one --capacity and --future-s"
                raise DataError(f"has capacity {own}, others {others}", record=scenario.id, cure=cure)
        own = Sizes.used(kept)
        sizes = trim if isinstance(trim, Sizes) else own if trim else Sizes.whole(kept[0].capacity)
        arrays = _stack_agents(kept, sizes) | _stack_routes(kept) | _stack_lights(kept, sizes)
        arrays |= _stack_road(kept, sizes) | _stack_maps(kept, sizes)
        return cls(
            **{name: jnp.asarray(value) for name, value in arrays.items()},
            cell_m=kept[0].capacity.cell_m, edge_run=sizes.edge_run, lane_run=sizes.lane_run,
            long_ego=own.long_ego or sizes.long_ego, trimmed=trim is True,
        )  # fmt: skip


def too_short(steps: int) -> str:
    """Say that a log has fewer steps than one that is evaluated or trained on."""
    return f"has {steps} steps, fewer than {LEAST_STEPS} (20 after the current one)"


def identities(names: Iterable[tuple[str, str]]) -> UInt32[np.ndarray, " n"]:
    """Return a number per scenario from its data set and id, independent of set, order and batch.

    It is a four-byte BLAKE2b digest of data set, id and the number of earlier scenarios of that name: copies differ.
    """
    seen: Counter[tuple[str, str]] = Counter()
    numbers = []
    for name in names:
        digest = hashlib.blake2b("\0".join((*name, str(seen[name]))).encode(), digest_size=4).digest()
        numbers.append(int.from_bytes(digest, "little"))
        seen[name] += 1
    return np.array(numbers, np.uint32)


_Arrays = dict[str, np.ndarray[Any, Any]]


def _column(scenarios: Sequence[Scenario], name: str) -> np.ndarray[Any, Any]:
    return np.stack([scenario.record[name] for scenario in scenarios])


def _columns(scenarios: Sequence[Scenario], prefix: str, *names: str) -> list[np.ndarray[Any, Any]]:
    return [_column(scenarios, f"{prefix}_{name}") for name in names]


def _join(*parts: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Concatenate columns in float32; parts with one dimension less than the first are single columns."""
    rank = parts[0].ndim
    return np.concatenate([p if p.ndim == rank else p[..., None] for p in parts], -1, dtype=np.float32)


def _stack_agents(scenarios: Sequence[Scenario], sizes: Sizes) -> _Arrays:
    names = ("xy", "z", "heading", "velocity", "valid", "size", "kind")
    xy, z, heading, velocity, valid, size, kind = _columns(scenarios, "agent", *names)
    agents = _join(xy, z, np.cos(heading), np.sin(heading), velocity, valid)
    box = _join(size, kind)[:, : sizes.agents]
    return {
        "agents": agents[:, :, : sizes.agents],
        "extension": _column(scenarios, "agent_extension")[:, : sizes.agents],
        "flags": _column(scenarios, "flags"),
        "last_step": _column(scenarios, "steps").astype(np.int32) - 1,
        "identity": identities([(scenario.text("dataset"), scenario.id) for scenario in scenarios]),
        **_stack_parked(scenarios, sizes.slots, last_used(valid.any(1)), box),
    }


def _stack_parked(
    scenarios: Sequence[Scenario], slots: int, first: np.ndarray[Any, Any], box: np.ndarray[Any, Any]
) -> _Arrays:
    """Parked agents, from slot ``first`` of their scenario on, and the boxes of all agents."""
    names = ("xy", "z", "heading", "valid", "size", "kind")
    xy, z, heading, valid, size, kind = _columns(scenarios, "parked", *names)
    count = last_used(valid.any(1))
    scenario, place = chosen = np.nonzero(np.arange(valid.shape[2]) < count[:, None])
    at = scenario, first[scenario] + place
    rows = np.zeros((len(scenarios), slots, 8), np.float32)
    xy, z, heading = xy[chosen], z[chosen], heading[chosen]
    rows[at] = _join(xy, z, np.cos(heading), np.sin(heading), np.zeros((len(z), 2)), np.ones(len(z)))
    boxes = np.zeros((len(scenarios), slots, 4), np.float32)
    boxes[:, : box.shape[1]] = box
    boxes[at] = np.concatenate([size, kind[..., None]], -1)[chosen]
    when = np.zeros((len(scenarios), valid.shape[1], slots), bool)
    when[scenario, :, at[1]] = valid[scenario, :, place]
    return {"agent_box": boxes, "parked": rows, "parked_when": as_words(when)}


def as_words(when: Bool[np.ndarray, "N T S"]) -> UInt[np.ndarray, "N W S"]:
    """Pack steps into bits of words, as in ``ScenarioBank.parked_when``."""
    steps = when.shape[1]
    padded = np.pad(when, ((0, 0), (0, -steps % WORD), (0, 0)))
    bits = padded.reshape(len(when), -1, WORD, when.shape[2]).astype(np.uint32)
    return (bits << np.arange(WORD, dtype=np.uint32)[:, None]).sum(axis=2, dtype=np.uint32)


def _stack_routes(scenarios: Sequence[Scenario]) -> _Arrays:
    names = ("xy", "z", "heading", "limit", "lane")
    xy, z, heading, limit, lane = (column[:, :2] for column in _columns(scenarios, "route", *names))
    return {
        "routes": _join(xy, z, np.cos(heading), np.sin(heading), limit, lane),
        "route_points": _column(scenarios, "route_points")[:, :2].astype(np.int32),
        "goal": _column(scenarios, "goal_xy"),
        "log_progress": _column(scenarios, "log_progress"),
        "log_ahead": _log_ahead(scenarios),
    }


def _log_ahead(scenarios: Sequence[Scenario]) -> np.ndarray[Any, Any]:
    """Distance that each logged ego drives from every step on, without gaps of the log."""
    xy, valid = _column(scenarios, "agent_xy")[:, :, 0], _column(scenarios, "agent_valid")[:, :, 0]
    moved = np.hypot(*np.moveaxis(np.diff(xy, axis=1), -1, 0)) * (valid[:, 1:] & valid[:, :-1])
    ahead = np.cumsum(moved[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([ahead, np.zeros_like(ahead[:, :1])], axis=1).astype(np.float32)


def _stack_lights(scenarios: Sequence[Scenario], sizes: Sizes) -> _Arrays:
    line, state = _column(scenarios, "light_line").astype(np.float64), _column(scenarios, "light_state")
    z, heading, exits = _columns(scenarios, "light", "z", "heading", "exit_heading")
    middle, along = (line[..., :2] + line[..., 2:]) / 2, line[..., 2:] - line[..., :2]
    half = np.hypot(*np.moveaxis(along, -1, 0)) / 2
    x, y = np.moveaxis(middle, -1, 0)
    right = wrap(exits.astype(np.float64) - heading) < -np.pi / 4
    arc = np.stack([_stop_arcs(scenario, at) for scenario, at in zip(scenarios, middle, strict=True)])
    rows = [x, y, np.cos(heading), np.sin(heading), half, z, np.cos(exits), np.sin(exits), right, arc]
    return {
        "light_line": np.stack(rows, axis=1, dtype=np.float32)[:, :, : sizes.lights],
        "light_state": state[:, :, : sizes.lights],
    }


def _stop_arcs(scenario: Scenario, middle: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Arc length along the route to the goal where it is nearest to the stop lines of its lanes."""
    count = int(scenario.route_points[0])
    lanes = scenario.light_lane
    mine = np.flatnonzero((lanes >= 0) & np.isin(lanes, scenario.route_lane[0]))
    arcs = np.full(len(lanes), NEVER_M)
    if count and len(mine):
        x, y = scenario.route_xy[0, :count].T.astype(np.float64)
        heading = scenario.route_heading[0, :count].astype(np.float64)
        dx, dy = middle[mine, 0, None] - x, middle[mine, 1, None] - y
        near = np.argmin(dx * dx + dy * dy, axis=1)
        row = np.arange(len(mine))
        arcs[mine] = near + dx[row, near] * np.cos(heading[near]) + dy[row, near] * np.sin(heading[near])
    return arcs


def _stack_maps(scenarios: Sequence[Scenario], sizes: Sizes) -> _Arrays:
    blocks = _column(scenarios, "segment_blocks").astype(np.int64)
    # Queries read whole runs, so a run must fit behind the last start.
    edges = np.full((len(scenarios), 5, sizes.edges + sizes.edge_run), 1e6, np.float32)
    lanes = np.full((len(scenarios), 8, sizes.lanes + sizes.lane_run), 1e6, np.float32)
    box = np.zeros((len(scenarios), 4), np.float32)
    for row, scenario in enumerate(scenarios):
        e, end = blocks[row, 1:3]
        a, b = scenario.segment_a[:end], scenario.segment_b[:end]
        ends = np.stack([*a[:, :2].T, *b[:, :2].T, (a[:, 2] + b[:, 2]) / 2])
        edges[row, :, :e] = ends[:, :e]
        lanes[row, :, : end - e] = [*ends[:, e:], *_lane_values(scenario, scenario.segment_lane[e:end])]
        points = np.concatenate([a[:, :2], b[:, :2]])
        if len(points):
            box[row] = [*points.min(0), *points.max(0)]
    return {
        "edges": edges,
        "lanes": lanes,
        "lane_strands": np.stack([lane_strands(scenario) for scenario in scenarios])[:, : sizes.graphs],
        "grid_edge": _column(scenarios, "grid_edge").astype(np.int16),
        "grid_lane": (_column(scenarios, "grid_lane") - blocks[:, 1:2]).astype(np.int16),
        "grid_side": _column(scenarios, "grid_side"),
        "grid_origin": _column(scenarios, "grid_origin"),
        "map_box": box,
    }


def _stack_road(scenarios: Sequence[Scenario], sizes: Sizes) -> _Arrays:
    names = ("xy", "direction", "length", "kind", "limit", "curvature")
    columns = (column[:, : sizes.road] for column in _columns(scenarios, "road", *names))
    xy, direction, length, kind, limit, curvature = columns
    layers = np.stack([among(kind, kinds) for kinds in (LANE_KINDS, EDGE_KINDS, POLYGON_KINDS)], axis=-1)
    there = np.arange(sizes.road) < _column(scenarios, "road_rows")[:, None]
    layer = np.where(there & layers.any(-1), np.argmax(layers, axis=-1), RoadLayer.NONE)
    return {
        "road": _join(xy, direction, length, layer, limit),
        "road_at": np.stack([xy[..., 0], xy[..., 1], layer], axis=1, dtype=np.float32),
        "road_curvature": curvature.astype(np.float32),
    }


def _lane_values(scenario: Scenario, lane: Int[np.ndarray, " segment"]) -> tuple[Any, Any, Any]:
    """Half width, limit and number of the lane of each segment, as in :class:`LaneRow`."""
    width = scenario.lane_width[lane]
    half = np.where(width > 0, width, DEFAULT_LANE_WIDTH_M) / 2
    return half, _lane_limits(scenario)[lane], lane + 0.5 * corridor_lanes(scenario)[lane]


def _lane_limits(scenario: Scenario) -> Float[np.ndarray, " lane"]:
    """Limit of each lane, m/s; of connectors the highest of the lanes that they join, if known; else of the class."""
    limit = scenario.lane_limit
    links = np.concatenate([scenario.lane_predecessor, scenario.lane_successor], axis=1)
    joined = np.where(links >= 0, limit[links], -1.0).max(axis=1)
    limit = np.where(scenario.lane_interpolating & (joined > 0), joined, limit)
    for kind, fallback in CLASS_LIMIT_MPS.items():
        limit = np.where((limit <= 0) & (scenario.lane_kind == kind), fallback, limit)
    return limit
