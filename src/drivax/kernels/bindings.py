"""A function for each native kernel, by group: simulation, queries of the map, observations, encoder of a set.

The JAX functions that call them define what they compute, and pass their constants as ``rules``: the numbers of a
structure in the kernel's file in ``native``. Leading axes N and M are those of all scenarios and routes of a bank.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from drivax.kernels.library import call, constants, in_use

#: Arrays of all scenarios (``scenario.bank.scenario_bank``): agents, sizes, parked agents and their steps, lights.
Logs = tuple[
    Float[Array, "N T A 8"], Float[Array, "N S 4"], Float[Array, "N S 8"], Shaped[Array, "N W S"],
    Int[Array, "N T L"],
]  # fmt: skip
#: Routes, the numbers of their points, and stop lines of all scenarios.
Maps = tuple[Float[Array, "M R 7"], Int[Array, " M"], Float[Array, "N F L"]]
#: Rows of an observation group and their mask.
Group = tuple[Float[Array, "K F"], Bool[Array, " K"]]
#: Kernel and bias of both layers of a set encoder, and the widths that are compiled.
Layers = Sequence[tuple[Float[Array, "_ _"], Float[Array, " _"]]]
_WIDTHS = (32, 64)


class Agents(NamedTuple):
    """All agents at a step.

    Attributes:
        box: x, y (m), cosine and sine of the heading, length, width (m).
        velocity: m/s.
        z: Height of the box centre, m.
        valid: Whether the slot has an agent.
        kind: ``scenario.schema.AgentKind``.
    """

    box: Float[Array, "S 6"]
    velocity: Float[Array, "S 2"]
    z: Float[Array, " S"]
    valid: Bool[Array, " S"]
    kind: Int[Array, " S"]


def read_frame(
    logs: Logs, index: Int[Array, ""], step: Int[Array, ""], slot: Int[Array, ""], motion: Float[Array, " 4"],
    direction: Float[Array, " 2"],
) -> tuple[Agents, Int[Array, " L"]]:  # fmt: skip
    """Return the agents at a step, the driven one with ``motion`` but its logged height, and the states of lights.

    The simulated height is left out because measuring changes it: this way, XLA computes the frame once per step.

    Args:
        logs: Arrays of all scenarios.
        index: Scenario.
        step: Step of the log.
        slot: Slot of the driven agent; no agent is driven if it is beyond the slots of moving agents.
        motion: The driven agent's x, y (m), heading (rad) and speed (m/s).
        direction: Cosine and sine of its heading.
    """
    slots, lights = logs[1].shape[1], logs[4].shape[2]
    results = [
        jax.ShapeDtypeStruct(shape, dtype)
        for shape, dtype in (
            ((slots, 6), jnp.float32), ((slots, 2), jnp.float32), ((slots,), jnp.float32),
            ((slots,), jnp.bool_), ((slots,), jnp.int32), ((lights,), jnp.int8),
        )
    ]  # fmt: skip
    *agents, states = call("read_frames", results, logs, (index, step, slot, motion, direction))
    return Agents(*agents), states


def measure_contacts(
    agents: Agents, previous: tuple[Float[Array, "S 2"], Bool[Array, " S"]], slot: Int[Array, ""],
    speed: Float[Array, ""], unlawful: Bool[Array, ""], before: Int[Array, " S"], rules: Mapping[str, float],
) -> tuple[Int[Array, " S"], Bool[Array, ""], Int[Array, ""], Float[Array, ""]]:  # fmt: skip
    """Return contact codes, whether a new contact is at fault, type of the nearest new contact, time to collision (s).

    Args:
        agents: All agents.
        previous: Their velocities and ``valid`` one step before.
        slot: Slot of the driven agent.
        speed: The larger of its speeds before and after the step, m/s.
        unlawful: Whether it is at fault in a lateral hit.
        before: Contact codes one step before.
        rules: ``ContactRules`` in ``native/contacts.cc``.
    """
    slots = agents.valid.shape
    results = [
        jax.ShapeDtypeStruct(shape, dtype)
        for shape, dtype in ((slots, jnp.int8), ((), jnp.bool_), ((), jnp.int8), ((), jnp.float32))
    ]
    batched = (*agents, *previous, slot, speed, unlawful, before)
    codes, at_fault, kind, time_s = call(
        "measure_contacts", results, (), batched, attributes=constants(rules)
    )
    return codes, at_fault, kind, time_s


def look_ahead(
    maps: Maps, agents: Agents, lights: Int[Array, " L"], numbers: Sequence[Int[Array, ""]],
    route_m: Float[Array, ""], speed: Float[Array, ""], min_gap_m: Float[Array, ""], rules: Mapping[str, float],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:  # fmt: skip
    """Return the inputs of a car-following driver: gap to the nearest obstacle (m), its speed, desired speed (m/s).

    Args:
        maps: Routes, numbers of their points, and stop lines of all scenarios.
        agents: All agents; their kinds are not used.
        lights: States of the lights.
        numbers: Slot, scenario and route of the driven agent, and row of the arc lengths of stop lines on that route.
        route_m: Arc length of the driven agent along its route, m.
        speed: Speed of the driven agent, m/s.
        min_gap_m: Gap that the driver keeps behind a standing leader, m.
        rules: ``FollowingRules`` in ``native/following.cc``.
    """
    number = jax.ShapeDtypeStruct((), jnp.float32)
    batched = (*agents[:4], lights.astype(jnp.int8), *numbers, route_m, speed, min_gap_m)
    gap_m, leader_mps, desired_mps = call(
        "look_ahead", [number] * 3, maps, batched, attributes=constants(rules)
    )
    return gap_m, leader_mps, desired_mps


class SegmentGrid(NamedTuple):
    """Segments of all scenarios of a bank, sorted by the cells of their grids.

    Attributes:
        segments: Segments of lanes or of edges, by feature.
        start: Index of the first segment of each cell, and of the end of the last cell.
        origin: Smallest x, y of each grid, m.
        cell_m, longest_run: Size of a cell, m; largest number of segments in three neighbouring cells of a row.
        long_ego: Whether corners of some ego can lie outside the cells around its centre.
    """

    segments: Float[Array, "N features S"]
    start: Int[Array, "N cells1"]
    origin: Float[Array, "N 2"]
    cell_m: float
    longest_run: int
    long_ego: bool

    @property
    def _constants(self) -> dict[str, float]:
        return {"cell_m": self.cell_m, "longest_run": self.longest_run, "long_ego": self.long_ego}


class Box(NamedTuple):
    """Box of a vehicle: centre (m), heading (cosine, sine), corners (m), and the height of the ground (m)."""

    centre: Float[Array, "2"]
    heading: Float[Array, "2"]
    corners: Float[Array, "4 2"]
    ground: Float[Array, ""]


class Lanes(NamedTuple):
    """Values of ``queries.LaneHits``; ``nearest_z`` is the height of the nearest lane, near or not."""

    near: Bool[Array, "*batch"]
    corners_near: Bool[Array, "*batch 4"]
    on_corridor: Bool[Array, "*batch"]
    wrong_way: Bool[Array, "*batch"]
    straddling: Bool[Array, "*batch"]
    leaving_lane: Bool[Array, "*batch"]
    limit: Float[Array, "*batch"]
    nearest_z: Float[Array, "*batch"]


def supports_grid(
    grid: SegmentGrid, corners: Float[Array, "corners 2"], *others: Float[Array, "..."]
) -> bool:
    """Return whether native kernels are in use and support these arrays: float32, int16 cell starts, four corners."""
    types = {array.dtype for array in (grid.segments, corners, *others)}
    is_compiled = types == {jnp.dtype(jnp.float32)} and grid.start.dtype == jnp.int16 and len(corners) == 4
    return is_compiled and in_use()


def query_lanes(
    grid: SegmentGrid, map_box: Float[Array, "N 4"], index: Int[Array, ""], box: Box, ego: Int[Array, ""],
    routed: Bool[Array, ""], rules: Mapping[str, float],
) -> Lanes:  # fmt: skip
    """Query the lanes around a box.

    Args:
        grid: Segments of lanes.
        map_box: Smallest and largest x, y of each map, m.
        index: Scenario.
        box: Pose of the box.
        ego: Number of the scenario's ego whose corridor counts.
        routed: Whether lanes of the corridor come before other lanes that fit.
        rules: ``cutoff_m``, ``level_m``, ``margin_m``, ``goes_on_m``, ``joint_m`` and ``parallel_cos``.
    """
    flag, number = (jax.ShapeDtypeStruct((), dtype) for dtype in (jnp.bool_, jnp.float32))
    corner_flags = jax.ShapeDtypeStruct((4,), jnp.bool_)
    results = [flag, corner_flags, flag, flag, flag, flag, number, number]
    common = jax.lax.stop_gradient([*grid[:3], map_box])
    batched = jax.lax.stop_gradient([index, ego, *box, routed])
    attributes = constants({**grid._constants, **rules})
    return Lanes(*call("query_lanes", results, common, batched, attributes=attributes))


def query_edges(
    grid: SegmentGrid, sides: Int[Array, "N cells"], index: Int[Array, ""], centre: Float[Array, "2"],
    corners: Float[Array, "4 2"], near_lane: Bool[Array, "4"], ground: Float[Array, ""],
    rules: Mapping[str, float],
) -> Float[Array, "4"]:  # fmt: skip
    """Return the distances of corners beyond the nearest edge, m: positive off the road.

    Args:
        grid: Segments of edges.
        sides: Packed drivable sides of the parts of cells, ``split`` along each axis.
        index: Scenario.
        centre: Centre of the box, m.
        corners: Corners of the box, m.
        near_lane: Whether a lane is near each corner.
        ground: Height of the ground, m.
        rules: ``cutoff_m``, ``level_m``, and for the parts of cells ``split`` and ``not_drivable``.
    """
    results = [jax.ShapeDtypeStruct((4,), jnp.float32)]
    batched = (index, centre, corners, near_lane, ground)
    attributes = constants({**grid._constants, **rules})
    return call("query_edges", results, (*grid[:3], sides), batched, attributes=attributes)[0]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ego:
    """The driven agent, unbatched.

    Attributes:
        index: Scenario.
        row: Row of its route.
        slot: Slot in frames.
        route_m: Arc length along its route, m.
        has_route: Whether it has a route on lanes.
        motion: x, y (m), heading (rad), speed (m/s).
        direction: Cosine and sine of the heading.
    """

    index: Int[Array, ""]
    row: Int[Array, ""]
    slot: Int[Array, ""]
    route_m: Float[Array, ""]
    has_route: Bool[Array, ""]
    motion: Float[Array, " 4"]
    direction: Float[Array, " 2"]


def observe_road(
    road_at: Float[Array, "N 3 O"], road: Float[Array, "N O 7"], curvature: Float[Array, "N O"], ego: Ego,
    count: int, columns: Sequence[int], layers: Sequence[int], rules: Mapping[str, float],
) -> Group:  # fmt: skip
    """Return the first ``count`` pieces of road that lie in a box around ego and are of some ``layers``.

    Args:
        road_at: Positions and layers of all pieces in the bank.
        road: All columns of these pieces.
        curvature: Their ``road_curvature``.
        ego: The driven agent.
        count: Number of rows K.
        columns: Numbers of the F columns among all columns of the group.
        layers: Numbers of the layers.
        rules: Range and units: the numbers of ``RoadRows`` in ``native/road_rows.cc``.
    """
    common, batched = (road_at, road, curvature), (_int(ego.index), ego.motion, ego.direction)
    attributes = constants(rules) | {"columns": _numbers(columns), "layers": _numbers(layers)}
    rows, mask = call("observe_road", _shapes(count, columns), common, batched, attributes=attributes)
    return rows, mask


def observe_agents(
    sizes: Float[Array, "N S 4"], routes: tuple[Float[Array, "M R 7"], Int[Array, " M"], Float[Array, " P"]],
    frame: tuple[Float[Array, "S 6"], Float[Array, "S 2"], Bool[Array, " S"], Int[Array, " S"]], ego: Ego,
    count: int, columns: Sequence[int], kinds: Sequence[int], rules: Mapping[str, float],
) -> Group:  # fmt: skip
    """Return the ``count`` agents that are nearest to ego, nearest first.

    Args:
        sizes: ``agent_box`` of the bank.
        routes: Routes, their numbers of points, and the arc lengths relative to ego (m) of the points on its route that
            agents are projected on.
        frame: Boxes, velocities, validity and kinds of all agents (``simulator.types.Frame``).
        ego: The driven agent.
        count: Number of rows K.
        columns: Numbers of the F columns among all columns of the group.
        kinds: Kinds of agents, in the order of the columns of their types.
        rules: Units: the numbers of ``AgentRows`` in ``native/agent_rows.cc``.
    """
    box, velocity, valid, kind = frame
    ego_state = _int(ego.slot), _int(ego.index), _int(ego.row), ego.route_m, ego.has_route
    batched = (box, velocity, valid, _int(kind), *ego_state, ego.motion, ego.direction)
    attributes = constants(rules) | {"columns": _numbers(columns), "kinds": _numbers(kinds)}
    rows, mask = call(
        "observe_agents", _shapes(count, columns), (sizes, *routes), batched, attributes=attributes
    )
    return rows, mask


def observe_route(
    routes: tuple[Float[Array, "M R 7"], Int[Array, " M"]], goal: Float[Array, "M 2"], ego: Ego,
    columns: Sequence[int], offsets_m: Float[Array, " K"], rules: Mapping[str, float],
) -> Group:  # fmt: skip
    """Return the points of ego's route at ``offsets_m`` ahead of it.

    Args:
        routes: Routes and their numbers of points.
        goal: x, y of each route's goal, m.
        ego: The driven agent.
        columns: Numbers of the F columns among all columns of the group.
        offsets_m: Arc lengths of the K points relative to ego, m.
        rules: Window of the curvature and units: the numbers of ``RouteRows`` in ``native/route_rows.cc``.
    """
    batched = (_int(ego.row), ego.route_m, ego.has_route, ego.motion, ego.direction)
    attributes = constants(rules) | {"columns": _numbers(columns)}
    shapes = _shapes(offsets_m.shape[0], columns)
    rows, mask = call("observe_route", shapes, (*routes, goal, offsets_m), batched, attributes=attributes)
    return rows, mask


def _shapes(count: int, columns: Sequence[int]) -> list[jax.ShapeDtypeStruct]:
    shapes = {(count, len(columns)): jnp.float32, (count,): jnp.bool_}
    return [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes.items()]


def _int(value: Array) -> Array:
    return jnp.asarray(value, jnp.int32)


def _numbers(values: Sequence[int]) -> np.ndarray:
    return np.asarray(values, np.int32)


def supports_layers(layers: Layers, activation: str) -> bool:
    """Return whether native kernels are in use and support these layers: two of one compiled width, with relu."""
    widths = {bias.shape[0] for _, bias in layers}
    is_compiled = len(layers) == 2 and len(widths) == 1 and widths <= set(_WIDTHS)
    return is_compiled and activation == "relu" and in_use()


def encode_sets(
    layers: Layers, rows: Float[Array, "*batch row inputs"], valid: Bool[Array, "*batch row"]
) -> tuple[Float[Array, "*batch width"], Int[Array, "*batch width"]]:
    """Return the maximum of zero and the valid rows after the layers, and the row of each maximum; -1 for zeros."""
    width = layers[1][1].shape
    results = [jax.ShapeDtypeStruct(width, dtype) for dtype in (jnp.float32, jnp.int32)]
    output, winner = call("encode_sets", results, _flat(layers), (rows, valid), valid.ndim - 1)
    return output, winner


def differentiate_sets(
    layers: Layers, rows: Float[Array, "*batch row inputs"], winner: Int[Array, "*batch width"],
    gradient: Float[Array, "*batch width"],
) -> Layers:  # fmt: skip
    """Return the gradient of the layers, summed over the batch; the first of equal rows takes all of it."""
    weights = _flat(layers)
    results = [jax.ShapeDtypeStruct(weight.shape, jnp.float32) for weight in weights]
    batched, axes = (rows, winner, gradient), winner.ndim - 1
    kernel1, bias1, kernel2, bias2 = call("differentiate_sets", results, weights, batched, axes, sums=True)
    return (kernel1, bias1), (kernel2, bias2)


def _flat(layers: Layers) -> list[Array]:
    return [weight for layer in layers for weight in layer]
