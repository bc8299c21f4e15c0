"""PDM-Closed's proposals: lines along the route, and IDM unrolled along each of them against forecast agents."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, SIN, gap, overlap
from drivax.geometry.vectors import norm
from drivax.planners.pdm.forecast import Forecast
from drivax.planners.pdm.tracking import Reference
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import project
from drivax.simulator.idm import IdmParameters, idm_acceleration

#: Points of a line, 1 m apart: what a car on a motorway passes in 4 s, and more ahead of it.
POINTS = 160
#: Length of the boxes that form a corridor, and stride of the route points on which agents are projected, m.
_PIECE_M, _STRIDE = 4, 2
#: Curvature at a point is measured between the points this far before and after it.
_REACH = 2
#: Gap of a free road, m.
_FREE_M = 1e4
#: Columns of a line.
LINE_X, LINE_Y, LINE_COS, LINE_SIN, LINE_CURVATURE, LINE_ALONG, LINE_Z = range(7)


@record
class Lines:
    """P lines along the route, each with points 1 m apart along itself, of which the first is abreast of ego."""

    # x, y, cosine and sine of the heading, curvature (1/m), distance along the route from ego (m), and height above
    # the route at ego (m)
    points: Float[Array, "P M 7"]
    route: Float[Array, "R 7"]  # Rows of ``bank.routes`` every 2 m ahead; straight on beyond the end
    remaining_m: Scalar  # Length of the route ahead of ego; -1 without a route
    limit: Scalar  # Speed limit of the route abreast of ego, m/s; not positive where unknown

    @classmethod
    def along_route(
        cls, bank: ScenarioBank, row: Integer, along_m: Scalar,
        offsets_m: tuple[float, ...], box: Float[Array, " 6"],
    ) -> Lines:  # fmt: skip
        """Build lines at lateral offsets from the route, or straight ahead of ego's ``box`` without a route.

        ``along_m`` is ego's arc length along its route; offsets are positive to the left. Parallel lines share their
        normals, so all of them start abreast of ego.
        """
        has_route = bank.route_points[row] > 1
        remaining_m = jnp.where(has_route, bank.route_points[row] - 1.0 - along_m, -1.0)

        def rows(distance_m: Float[Array, " M"]) -> Float[Array, "M 7"]:
            """Return rows of the route at distances from ego."""
            on_route_m = jnp.clip(distance_m, 0.0, jnp.maximum(remaining_m, 0.0))
            points, _ = route_ahead(bank, row, along_m, on_route_m)
            straight = jnp.zeros(7).at[RouteColumn.XY].set(box[:2])
            points = jnp.where(has_route, points, straight.at[RouteColumn.HEADING].set(box[COS : SIN + 1]))
            heading = points[:, RouteColumn.HEADING]
            heading = heading / jnp.maximum(norm(heading), 1e-6)[:, None]
            xy = points[:, RouteColumn.XY] + (distance_m - on_route_m)[:, None] * heading
            return points.at[:, RouteColumn.XY].set(xy).at[:, RouteColumn.HEADING].set(heading)

        distance_m = jnp.arange(POINTS, dtype=jnp.float32)
        centre = rows(distance_m)
        points = jnp.stack([_line(rows, centre, distance_m, offset) for offset in offsets_m])
        limit = jnp.where(has_route, centre[0, RouteColumn.LIMIT], 0.0)
        return cls(points, centre[::_STRIDE], remaining_m, limit)

    def at(self, arc_m: Float[Array, "P *T"]) -> Float[Array, "P *T 7"]:
        """Interpolate rows at arc lengths of each line."""
        index = jnp.clip(arc_m.astype(jnp.int32), 0, POINTS - 2)
        fraction = jnp.clip(arc_m - index, 0.0, 1.0)[..., None]
        take = jax.vmap(lambda line, index: line[index])
        return take(self.points, index) * (1.0 - fraction) + take(self.points, index + 1) * fraction

    def route_distances(self, xy: Float[Array, "*T 2"]) -> Float[Array, "*T"]:
        """Return the distances along the route, from ego on, of points next to it."""
        valid = jnp.ones(self.route.shape[0], bool)
        offsets = jnp.arange(self.route.shape[0], dtype=jnp.float32) * _STRIDE
        flat = xy.reshape(-1, 2)
        return project(self.route, valid, offsets, flat, jnp.ones_like(flat))[0].reshape(xy.shape[:-1])

    def corridors(self, width: Scalar) -> Float[Array, "P C 6"]:
        """Return the corridor of a width along each line, as boxes."""
        first, last = self.points[:, :-1:_PIECE_M], self.points[:, _PIECE_M::_PIECE_M]
        count = min(first.shape[1], last.shape[1])
        a, b = first[:, :count, : LINE_Y + 1], last[:, :count, : LINE_Y + 1]
        length = jnp.maximum(norm(b - a), 1e-6)[..., None]
        return jnp.concatenate([(a + b) / 2, (b - a) / length, length, jnp.full_like(length, width)], axis=-1)


def _line(
    rows: Callable[[Array], Array], centre: Float[Array, "M 7"], distance_m: Float[Array, " M"], offset: float
) -> Float[Array, "M 7"]:
    """Return one line with evenly spaced points, from the rows of the route at ``distance_m``."""

    def offset_xy(row: Float[Array, "M 7"]) -> Float[Array, "M 2"]:
        normal = jnp.stack([-row[:, RouteColumn.SIN], row[:, RouteColumn.COS]], axis=-1)
        return row[:, RouteColumn.XY] + offset * normal

    along_m, row = distance_m, centre
    if offset:
        steps = norm(jnp.diff(offset_xy(centre), axis=0))
        arc_m = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
        along_m = jnp.interp(distance_m, arc_m, distance_m) + jnp.maximum(distance_m - arc_m[-1], 0.0)
        row = rows(along_m)
    cos, sin = row[:, RouteColumn.COS], row[:, RouteColumn.SIN]
    c0, s0, c1, s1 = cos[: -2 * _REACH], sin[: -2 * _REACH], cos[2 * _REACH :], sin[2 * _REACH :]
    curvature = jnp.arctan2(c0 * s1 - s0 * c1, c0 * c1 + s0 * s1) / (2.0 * _REACH)
    height = row[:, RouteColumn.Z] - centre[0, RouteColumn.Z]
    curvature = jnp.pad(curvature, _REACH, mode="edge")
    return jnp.stack([*offset_xy(row).T, cos, sin, curvature, along_m, height], axis=1)


@record
class Proposals:
    """Proposals along P lines with F target speeds, at T steps from now on."""

    arc_m: Float[Array, "P F T"]  # Arc length along the line
    speed: Float[Array, "P F T"]  # m/s

    def reference(self, lines: Lines) -> Reference:
        """Return the flattened proposals: target speeds of one line after each other."""
        rows = lines.at(self.arc_m)
        flat = rows.reshape(-1, *rows.shape[2:])
        speed = self.speed.reshape(-1, self.speed.shape[-1])
        return Reference(flat[..., : LINE_SIN + 1], speed, flat[..., LINE_CURVATURE])


def unroll_idm(
    lines: Lines, others: Forecast, size: Vector, speed: Scalar, desired: Float[Array, " F"], stop_m: Scalar,
    parameters: IdmParameters, updates: range,
) -> Proposals:  # fmt: skip
    """Simulate IDM along every line, from ego's speed to each desired speed (m/s), by Euler steps of 0.1 s.

    ``updates`` has the steps at which the leader is updated, and stops after the last step of the simulation. The
    leader is, of the agents whose box reaches into the corridor of ego's width and whose centre is ahead, the one
    nearest to ego's box. Its gap shrinks by ego's motion until the next update. ``stop_m`` is the distance from ego's
    front to the nearest stop line that requires a stop, infinite for none.
    """
    count = lines.points.shape[0], desired.shape[0]
    boxes = others.at(jnp.arange(0, updates.stop, updates.step) * DT_S)
    is_inside = _on_corridor(lines.corridors(size[1]), boxes) & others.valid
    distances = lines.route_distances(boxes[..., :2])
    stop_along_m = stop_m + size[0] / 2
    length, width = (jnp.full(count, extent) for extent in size)

    def follow_leader(state: tuple[Array, Array], forecast: tuple[Array, ...]) -> Any:
        """Find the leader of each proposal, and follow it until the next update."""
        arc_m, speed = state
        box, along_m, is_inside = forecast
        row = lines.at(arc_m)
        ego = jnp.stack([*jnp.moveaxis(row[..., : LINE_SIN + 1], -1, 0), length, width], axis=-1)
        is_ahead = is_inside[:, None] & (along_m > row[..., LINE_ALONG, None])
        gaps = jnp.where(is_ahead, gap(ego[:, :, None], box), _FREE_M)
        leader, gap_m = first_smallest(gaps), jnp.min(gaps, axis=-1)
        velocity = others.velocity[leader]
        leader_speed = velocity[..., 0] * row[..., LINE_COS] + velocity[..., 1] * row[..., LINE_SIN]
        stop_gap_m = jnp.maximum(stop_along_m - row[..., LINE_ALONG] - size[0] / 2, 0.0)
        is_before_stop = stop_along_m > row[..., LINE_ALONG]
        stop_gap_m = jnp.where(is_before_stop, jnp.minimum(stop_gap_m, _FREE_M), _FREE_M)
        leader_speed = jnp.where(stop_gap_m < gap_m, 0.0, leader_speed)
        gap_m = jnp.minimum(stop_gap_m, gap_m)
        states = []
        for _ in range(updates.step):
            effective_gap_m = jnp.maximum(gap_m, parameters.min_gap_m)
            acceleration = idm_acceleration(speed, desired, effective_gap_m, leader_speed, parameters)
            arc_m, gap_m = arc_m + DT_S * speed, gap_m - DT_S * speed
            speed = jnp.maximum(speed + DT_S * acceleration, 0.0)
            states.append((arc_m, speed))
        return (arc_m, speed), jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)

    start = jnp.zeros(count), jnp.full(count, speed)
    forecasts = (boxes, distances, jnp.moveaxis(is_inside, 1, 0))
    _, states = jax.lax.scan(follow_leader, start, forecasts)

    def in_time(first: Array, rest: Array) -> Array:
        """Return the values at all steps along the last axis."""
        rest = jnp.moveaxis(rest.reshape(-1, *count), 0, -1)
        return jnp.concatenate([first[..., None], rest], axis=-1)

    return Proposals(*(in_time(first, rest) for first, rest in zip(start, states, strict=True)))


def _on_corridor(corridors: Float[Array, "P C 6"], boxes: Float[Array, "U K 6"]) -> Bool[Array, "P U K"]:
    """Return the mask of boxes that reach into each corridor, at each time."""
    return overlap(corridors[:, None, :, None], boxes[None, :, None]).any(axis=2)
