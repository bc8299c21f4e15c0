"""Observation groups of road, agents and route: any selection of their columns, for one present step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, constants

#: Rows of a group and their mask.
Group = tuple[Float[Array, "K F"], Bool[Array, " K"]]


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
        motion: x, y, heading, speed.
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
    """Return the first ``count`` pieces of road of some ``layers`` in a box around ego.

    Args:
        road_at: Positions and layers of the bank's pieces.
        road: These pieces.
        curvature: Their ``road_curvature``.
        ego: The driven agent.
        count: Number of rows K.
        columns: Numbers of the columns F among all of the group.
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
        routes: Routes, their numbers of points, and the places on ego's, relative to ego (m), on which agents are
            projected.
        frame: Boxes, velocities, validity and kinds of all agents (``simulator.types.Frame``).
        ego: The driven agent.
        count: Number of rows K.
        columns: Numbers of the columns F among all of the group.
        kinds: Kinds of agents, in the order of the columns of their types.
        rules: Units: the numbers of ``AgentRows`` in ``native/agent_rows.cc``.
    """
    box, velocity, valid, kind = frame
    places = _int(ego.slot), _int(ego.index), _int(ego.row), ego.route_m, ego.has_route
    batched = (box, velocity, valid, _int(kind), *places, ego.motion, ego.direction)
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
        goal: As in the bank.
        ego: The driven agent.
        columns: Numbers of the columns F among all of the group.
        offsets_m: Places of the K points.
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
