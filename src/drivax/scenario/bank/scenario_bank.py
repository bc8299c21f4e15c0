"""The scenario bank: scenarios stacked on the device, an argument of all simulation.

Padding that no scenario uses is trimmed. The layout suits the reads of a simulation step: agents are time-major (a
frame is a contiguous read), map segments are feature-major (a grid query is three contiguous reads per feature).
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt, UInt32

from drivax.errors import DataError, UsageError
from drivax.scenario.bank.columns import AgentColumn, RoadLayer, SizeColumn
from drivax.scenario.bank.routes_and_strands import (
    corridor_lanes,
    interleave,
    lane_strands,
    most_egos,
    of_ego,
    stack_lights,
    stack_routes,
)
from drivax.scenario.bank.sizes import BATCH, Sizes, last_used
from drivax.scenario.record import record, static
from drivax.scenario.schema import (
    EDGE_KINDS,
    LANE_KINDS,
    LEAST_STEPS,
    POLYGON_KINDS,
    RoadKind,
    Scenario,
    stack_field,
)

#: Types of map queries: a number, an index, and a point or direction.
Scalar = Float[Array, ""]
Integer = Int[Array, ""]
Vector = Float[Array, " 2"]
#: Lane width where the source gives none, m.
DEFAULT_LANE_WIDTH_M = 3.7
#: Limits of a lane's class where the source gives none, m/s (metric ``speeding``).
CLASS_LIMIT_MPS = {int(RoadKind.LANE_FREEWAY): 29.1, int(RoadKind.LANE_SURFACE): 13.4}
#: Steps in a word of ``parked_when``.
WORD = 32
#: Coordinates of unused segments, m.
_FAR_M = 1e6
#: Threads that stack; NumPy releases the lock of the interpreter in its loops.
_THREADS = min(os.cpu_count() or 1, 8)
#: Alignment of arrays that JAX takes over without a copy, bytes.
_ALIGNMENT = 64
#: Layer of a kind of road; the last entry is that of -1.
_LAYERS = np.full(max(RoadKind) + 2, RoadLayer.NONE, np.float32)
for _layer, _kinds in enumerate((LANE_KINDS, EDGE_KINDS, POLYGON_KINDS)):
    _LAYERS[list(_kinds)] = _layer

#: Arrays of a bank with a row per ego.
PER_EGO = ("routes", "route_points", "on_lanes", "goal", "log_progress", "log_ahead", "last_step")

_Record = Shaped[np.ndarray, ""]
_Arrays = dict[str, np.ndarray[Any, Any]]


@record
class ScenarioBank:
    """Scenarios on the device: N scenarios, T steps, A moving agents, S slots of a frame, K egos per scenario.

    The slots of parked agents follow those of the moving agents of the same scenario, so that a frame has as many slots
    as the largest scenario needs. What belongs to the route of an ego has M = N * K rows: row ``index * K + k`` for the
    k-th ego of scenario ``index``, of which the first is the recorded one. Without further egos the row is the index.

    Attributes:
        egos: Slots of the egos, 0 first, -1 for none.
        agents: Moving agents, :class:`AgentColumn`; slot 0 is ego.
        agent_box: Size and kind of all agents, :class:`SizeColumn`.
        parked: Parked agents in their slots, :class:`AgentColumn`.
        parked_when: Steps at which parked agents are observed: bit ``t % 32`` of word ``t // 32``.
        light_line, light_state: Stop lines, :class:`LightRow`, and their ``LightState`` at each step.
        edges, lanes: Segments of road edges (drivable side on the left) and of car lanes, sorted by grid cell,
            :class:`EdgeRow` and :class:`LaneRow`.
        lane_strands: Strand, neighbours and end of every lane of the graph, :class:`StrandColumn`.
        grid_edge, grid_lane: Start of the run of each cell in ``edges`` and ``lanes`` (row-major, plus the end).
        grid_side: Drivable sides beyond the cut-off of all edges (``scenario.build.grid.pack_sides``).
        grid_origin, map_box: Smallest x, y of the grid; smallest and largest x, y of edges and lanes.
        routes, route_points: Points 1 m apart of the routes to the goals, :class:`RouteColumn`, and their numbers.
        on_lanes: Whether the route lies on lanes; otherwise it is the logged path, which is privileged.
        goal: End of the log on the route: x, y.
        log_routes, log_route_points: Points 1 m apart of the logged paths of the recorded egos, and their numbers.
        log_progress, log_ahead: Arc length of the logged ego along its route; distance that it still drives, m.
        road: Pieces of road to observe, in order of rank, :class:`RoadColumn`.
        road_at, road_curvature: x, y and layer of the same pieces; their curvature, left positive, 1/m.
        flags: ``scenario.schema.Flag`` bits.
        last_step: Last step of the log of each ego; for the recorded one that of the scenario, followed by padding.
        identity: Seeds of the random numbers of a scenario (:func:`identities`).
        extension: Points 4 m apart beyond the last logged pose of moving agents, along lanes or straight on: x, y.
        chances: Cumulative probability that a training episode begins in each scenario, in units of ``1 / (2^32 - 1)``;
            None: all are equal.
        reward_factors: Factors of the reward terms in training, by name; None: all are 1.
        cell_m, edge_run, lane_run: Grid cell size; longest run of a row of three cells.
        long_ego: Whether some ego is too long for a single grid query.
        trimmed: Whether padding was cut to what these scenarios use; not if sizes were passed.
    """

    agents: Float[Array, "N T A 8"]
    agent_box: Float[Array, "N S 4"]
    parked: Float[Array, "N S 8"]
    parked_when: UInt[Array, "N W S"]
    light_line: Float[Array, "N F L"]
    light_state: Int[Array, "N T L"]
    edges: Float[Array, "N 5 E"]
    lanes: Float[Array, "N 8 C"]
    lane_strands: Float[Array, "N G 6"]
    grid_edge: Int[Array, "N cells1"]
    grid_lane: Int[Array, "N cells1"]
    grid_side: Int[Array, "N cells"]
    grid_origin: Float[Array, "N 2"]
    map_box: Float[Array, "N 4"]
    egos: Int[Array, "N K"]
    routes: Float[Array, "M R 7"]
    route_points: Int[Array, " M"]
    on_lanes: Bool[Array, " M"]
    log_routes: Float[Array, "N R 7"]
    log_route_points: Int[Array, " N"]
    goal: Float[Array, "M 2"]
    log_progress: Float[Array, "M T"]
    log_ahead: Float[Array, "M T"]
    road: Float[Array, "N O 7"]
    road_at: Float[Array, "N 3 O"]
    road_curvature: Float[Array, "N O"]
    flags: UInt[Array, " N"]
    last_step: Int[Array, " M"]
    identity: UInt[Array, " N"]
    extension: Float[Array, "N A X 2"]
    chances: UInt[Array, " N"] | None
    reward_factors: dict[str, Float[Array, ""]] | None
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

    @property
    def most_egos(self) -> int:
        """Number of egos K that each scenario has rows for."""
        return self.egos.shape[1]

    def row_of(self, index: Any, slot: int | Integer) -> Any:
        """Row of the route of an agent; that of the recorded ego for agents without a route."""
        if self.most_egos == 1:
            return index
        return index * self.most_egos + jnp.argmax(self.egos[index] == slot).astype(jnp.int32)

    def scenario_of(self, row: Integer) -> Integer:
        """Index of the scenario of a row."""
        return row if self.most_egos == 1 else row // self.most_egos

    def ego_number(self, row: int | Integer) -> int | Integer:
        """Number of an ego in its scenario, 0 for the recorded one."""
        return 0 if self.most_egos == 1 else row % self.most_egos

    def ego_slot(self, row: int | Integer) -> int | Integer:
        """Slot of the ego of a row, -1 for a row without one."""
        return 0 if self.most_egos == 1 else self.egos.reshape(-1)[row]

    def part(self, rows: Int[Array, " n"]) -> ScenarioBank:
        """Select scenarios by index, without what training adds (chances and reward factors)."""
        ego_rows = (rows[:, None] * self.most_egos + jnp.arange(self.most_egos)).reshape(-1)

        def select(path: tuple[Any, ...], leaf: Array) -> Array:
            return leaf[ego_rows if path[0].name in PER_EGO else rows]

        return jax.tree_util.tree_map_with_path(select, replace(self, chances=None, reward_factors=None))

    @classmethod
    def from_scenarios(
        cls, scenarios: Iterable[Scenario], *, trim: bool | Sizes = True, allow_no_future: bool = False
    ) -> ScenarioBank:
        """Stack scenarios of one capacity.

        ``trim`` cuts unused padding, or cuts to sizes that hold all scenarios (:meth:`Sizes.used`): banks of the same
        sizes share compiled programs, smaller banks are faster. ``allow_no_future`` accepts logs with fewer than 20
        steps after the current one.

        Raises:
            DrivaxError: There are no scenarios, their capacities differ, a log is too short, or sizes are too small or
                exceed the capacity.
        """
        logs = list(scenarios)
        for scenario in logs:
            if scenario.steps < LEAST_STEPS and not allow_no_future:
                cure = "leave it out (flag!=NO_FUTURE)"
                raise DataError(too_short(int(scenario.steps)), record=scenario.id, cure=cure)
            if scenario.capacity != logs[0].capacity:
                names = [f"{c.name!r} ({c.steps} steps)" for c in (scenario.capacity, logs[0].capacity)]
                cure = "convert all sets with one --capacity and --future-s"
                raise DataError(f"has capacity {names[0]}, others {names[1]}", record=scenario.id, cure=cure)
        used = Sizes.used(logs)
        sizes = trim if isinstance(trim, Sizes) else used if trim else Sizes.whole(logs[0].capacity)
        sizes = replace(sizes, long_ego=sizes.long_ego or used.long_ego)
        room, need = asdict(sizes), asdict(used)
        if too_small := [f"{name} {room[name]} < {need[name]}" for name in room if room[name] < need[name]]:
            cure = "use Sizes.used of all scenarios"
            raise UsageError(f"sizes are too small: {', '.join(too_small)}", cure=cure)
        if sizes.agents > (most := logs[0].capacity.agents):
            problem = f"sizes are too large: agents {sizes.agents} > {most} of the capacity"
            raise UsageError(problem, cure="use Sizes.used of scenarios of this capacity")
        arrays = _stack(logs, sizes)
        return cls(
            **{name: jax.device_put(value, may_alias=True) for name, value in arrays.items()},
            cell_m=logs[0].capacity.cell_m, edge_run=sizes.edge_run, lane_run=sizes.lane_run,
            long_ego=sizes.long_ego, trimmed=trim is True, chances=None,
            reward_factors=None,
        )  # fmt: skip


def too_short(steps: int) -> str:
    """Return the error message for a log with too few steps to evaluate or train on."""
    return f"has {steps} steps, fewer than {LEAST_STEPS} (20 after the current one)"


def _stack(scenarios: Sequence[Scenario], sizes: Sizes) -> _Arrays:
    """Return the arrays of a bank by name, aligned so that JAX shares their memory."""
    records = [scenario.record for scenario in scenarios]
    shapes = {
        "agents": (len(scenarios[0].agent_z), sizes.agents, 8),
        # Queries read whole runs, so a run must fit behind the last start.
        "edges": (5, sizes.edges + sizes.edge_run),
        "lanes": (8, sizes.lanes + sizes.lane_run),
        "map_box": (4,),
    }
    large_arrays = [_aligned((len(records), *shape), np.dtype(np.float32)) for shape in shapes.values()]
    # The first record gives the names, shapes and types of the other arrays.
    arrays = {
        name: _aligned((len(records), *values.shape[1:]), values.dtype)
        for name, values in _stack_batch(records[:1], sizes).items()
    }

    def fill(rows: slice) -> None:
        """Write a batch of scenarios into all arrays."""
        batch = records[rows]
        targets = zip(*(array[rows] for array in large_arrays), strict=True)
        for log, values, target in zip(batch, _lane_values(batch), targets, strict=True):
            agents, edges, lanes, box = target
            _fill_agents(agents, log)
            _fill_segments(edges, lanes, box, values, log)
        for name, values in _stack_batch(batch, sizes).items():
            arrays[name][rows] = values

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(fill, (slice(first, first + BATCH) for first in range(0, len(records), BATCH))))
    for name in PER_EGO:
        arrays[name] = arrays[name].reshape(-1, *arrays[name].shape[2:])
    names = [(scenario.text("dataset"), scenario.id) for scenario in scenarios]
    return arrays | dict(zip(shapes, large_arrays, strict=True)) | {"identity": identities(names)}


def _aligned(shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    """Return an uninitialised array whose memory JAX takes over without a copy."""
    size = int(np.prod(shape)) * dtype.itemsize
    memory = np.empty(size + _ALIGNMENT, np.uint8)
    begin = -memory.ctypes.data % _ALIGNMENT
    return memory[begin : begin + size].view(dtype).reshape(shape)


def identities(names: Iterable[tuple[str, str]]) -> UInt32[np.ndarray, " n"]:
    """Return a unique number per scenario from its data set and id, independent of set, order and batch.

    It is a four-byte BLAKE2b digest of data set, id and a count of earlier scenarios of that name, so that copies
    differ. The count skips digests of earlier scenarios (40 % of sets of 65,000 scenarios have such a collision): only
    these few numbers depend on the set.
    """
    counts: Counter[tuple[str, str]] = Counter()
    numbers: dict[int, None] = {}
    for name in names:
        while (number := _digest(*name, str(counts[name]))) in numbers:
            counts[name] += 1
        numbers[number] = None
        counts[name] += 1
    return np.array(list(numbers), np.uint32)


def _digest(*texts: str) -> int:
    return int.from_bytes(hashlib.blake2b("\0".join(texts).encode(), digest_size=4).digest(), "little")


def _stack_batch(records: Sequence[_Record], sizes: Sizes) -> _Arrays:
    arrays = _stack_agents(records, sizes) | stack_routes(records) | stack_lights(records, sizes.lights)
    return arrays | _stack_road(records, sizes) | _stack_grid(records, sizes)


def _fill_agents(agents: Float[np.ndarray, "time agent 8"], log: _Record) -> None:
    """Write the moving agents of a record in place: they are the largest array of a bank, so no copy is made."""
    xy, z, heading, velocity, valid = (
        log[f"agent_{name}"][:, : agents.shape[1]] for name in ("xy", "z", "heading", "velocity", "valid")
    )
    agents[..., AgentColumn.X], agents[..., AgentColumn.Y] = xy[..., 0], xy[..., 1]
    agents[..., AgentColumn.Z], agents[..., AgentColumn.VALID] = z, valid
    agents[..., AgentColumn.VX], agents[..., AgentColumn.VY] = velocity[..., 0], velocity[..., 1]
    np.cos(heading, out=agents[..., AgentColumn.COS])
    np.sin(heading, out=agents[..., AgentColumn.SIN])


def _stack_agents(records: Sequence[_Record], sizes: Sizes) -> _Arrays:
    agents = slice(0, sizes.agents)
    size, kind = (stack_field(records, f"agent_{name}", agents) for name in ("size", "kind"))
    valid = stack_field(records, "agent_valid")
    return {
        "extension": stack_field(records, "agent_extension", agents),
        "flags": stack_field(records, "flags"),
        **_stack_parked(records, sizes.slots, last_used(valid.any(1)), interleave(size, kind)),
    }


def _stack_parked(
    records: Sequence[_Record], slots: int, first: Int[np.ndarray, " n"], box: Float[np.ndarray, "n agent 4"]
) -> _Arrays:
    """Return the parked agents, from slot ``first`` of their scenario on, and the boxes of all agents.

    ``box`` holds those of the moving agents.
    """
    valid = stack_field(records, "parked_valid")
    count = last_used(valid.any(1))
    parked = slice(0, int(count.max()))
    xy, z, heading, size, kind = (
        stack_field(records, f"parked_{name}", parked) for name in ("xy", "z", "heading", "size", "kind")
    )
    mask = np.arange(parked.stop) < count[:, None]
    scenario, number = np.nonzero(mask)
    slot = scenario, first[scenario] + number
    poses = np.zeros((len(records), slots, 8), np.float32)
    velocity, is_observed = np.zeros((*z.shape, 2)), np.ones(z.shape)
    poses[slot] = interleave(xy, z, np.cos(heading), np.sin(heading), velocity, is_observed)[mask]
    boxes = np.zeros((len(records), slots, 4), np.float32)
    boxes[:, : box.shape[1]] = box
    boxes[slot] = interleave(size, kind)[mask]
    words = as_words(valid[:, :, parked])
    when = np.zeros((len(records), words.shape[1], slots), np.uint32)
    when[scenario, :, slot[1]] = words[scenario, :, number]
    return {"agent_box": boxes, "parked": poses, "parked_when": when}


def as_words(when: Bool[np.ndarray, "N T S"]) -> UInt[np.ndarray, "N W S"]:
    """Pack steps into bits of words, as in ``ScenarioBank.parked_when``."""
    padded = np.pad(when, ((0, 0), (0, -when.shape[1] % WORD), (0, 0)))
    parts = np.packbits(padded, axis=1, bitorder="little").astype(np.uint32)
    parts = parts.reshape(len(when), padded.shape[1] // WORD, WORD // 8, when.shape[2])
    return np.bitwise_or.reduce(parts << np.arange(0, WORD, 8, dtype=np.uint32)[:, None], axis=2)


def _stack_road(records: Sequence[_Record], sizes: Sizes) -> _Arrays:
    names = ("xy", "direction", "length", "kind", "limit", "curvature")
    xy, direction, length, kind, limit, curvature = (
        stack_field(records, f"road_{name}", slice(0, sizes.road)) for name in names
    )
    is_piece = np.arange(kind.shape[1]) < stack_field(records, "road_rows")[:, None]
    layer = np.where(is_piece, _LAYERS[np.minimum(kind, len(_LAYERS) - 1)], np.float32(RoadLayer.NONE))
    return {
        "road": interleave(xy, direction, length, layer, limit),
        "road_at": np.stack([xy[..., 0], xy[..., 1], layer], axis=1),
        "road_curvature": curvature,
    }


def _fill_segments(
    edges: Float[np.ndarray, "5 edge"], lanes: Float[np.ndarray, "8 lane"], box: Float[np.ndarray, "4"],
    values: Float[np.ndarray, "3 lane1"], log: _Record,
) -> None:  # fmt: skip
    """Write the edges and lanes of a record in place, and the box around them; ``values`` are :func:`_lane_values`."""
    edge_end, lane_end = log["segment_blocks"][1:3].tolist()
    a, b, count = log["segment_a"][:lane_end].T, log["segment_b"][:lane_end].T, lane_end - edge_end
    ends = np.empty((5, lane_end), np.float32)
    ends[0:2], ends[2:4], ends[4] = a[:2], b[:2], (a[2] + b[2]) / 2
    edges[:, :edge_end], edges[:, edge_end:] = ends[:, :edge_end], _FAR_M
    lanes[:5, :count] = ends[:, edge_end:]
    lanes[5:, :count] = values[:, log["segment_lane"][edge_end:lane_end]]
    lanes[:, count:] = _FAR_M
    low, high = (ends[:4].min(axis=1), ends[:4].max(axis=1)) if lane_end else np.zeros((2, 4), np.float32)
    np.minimum(low[:2], low[2:], out=box[:2])
    np.maximum(high[:2], high[2:], out=box[2:])


def _lane_values(records: Sequence[_Record]) -> Float[np.ndarray, "n 3 lane1"]:
    """Return half width, limit and index of each lane, as in :class:`LaneRow`; the last column is for no lane (-1)."""
    count = int(last_used(stack_field(records, "lane_length") > 0).max())
    lanes = np.append(np.arange(count), -1)
    width = stack_field(records, "lane_width", lanes)
    half = np.where(width > 0, width, DEFAULT_LANE_WIDTH_M) / 2
    index = lanes.astype(np.float64)
    for ego in range(most_egos(records)):
        route = (of_ego(records, f"route_{name}", ego, 0) for name in ("lane", "points"))
        index = index + 0.5 ** (ego + 1) * corridor_lanes(records, *route)[:, lanes]
    values = np.stack([half, _lane_limits(records, lanes), index], axis=1, dtype=np.float32)
    values[..., -1] = DEFAULT_LANE_WIDTH_M / 2, -1.0, -1.0  # -1 reads the last lane of a full table
    return values


def _lane_limits(records: Sequence[_Record], lanes: Int[np.ndarray, " lane"]) -> Float[np.ndarray, "n lane"]:
    """Return the limit of each lane, m/s, -1 unknown.

    For connectors it is the highest of the lanes that they join, if known. Lanes without a limit have that of their
    class.
    """
    limit, kind, is_connector, *links = (
        stack_field(records, f"lane_{name}", lanes)
        for name in ("limit", "kind", "interpolating", "predecessor", "successor")
    )
    link = np.concatenate(links, axis=2)
    scenario = np.arange(len(records))[:, None, None]
    highest = np.where(link >= 0, limit[scenario, link], -1.0).max(axis=2)
    limit = np.where(is_connector & (highest > 0), highest, limit)
    for road_kind, class_limit in CLASS_LIMIT_MPS.items():
        limit = np.where((limit <= 0) & (kind == road_kind), class_limit, limit)
    return limit


def _stack_grid(records: Sequence[_Record], sizes: Sizes) -> _Arrays:
    # Stored lane starts index all segments; the bank holds lanes apart from edges, so subtract the number of edges.
    edge_count = stack_field(records, "segment_blocks", 1).astype(np.int16)
    return {
        "lane_strands": lane_strands(records)[:, : sizes.graphs],
        "grid_edge": stack_field(records, "grid_edge"),
        "grid_lane": stack_field(records, "grid_lane") - edge_count[:, None],
        "grid_side": stack_field(records, "grid_side"),
        "grid_origin": stack_field(records, "grid_origin"),
    }
