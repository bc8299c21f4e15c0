"""PDM-Closed's proposals: lines along the route, and IDM unrolled along each of them against forecast agents."""

from __future__ import annotations

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

#: Points of a line, 1 m apart: 4 s on a motorway, and what is ahead then.
POINTS = 160
#: Pieces of the corridor, m; every second point is measured when others are projected on the route.
_PIECE_M, _EVERY = 4, 2
#: Points on either side between which curvature is measured.
_BEND = 2
#: Gap of a free road, m.
_FREE_M = 1e4
#: Columns of a line.
LINE_X, LINE_Y, LINE_COS, LINE_SIN, LINE_BEND, LINE_PLACE, LINE_Z = range(7)


@record
class Lines:
    """P lines along the route, each at points 1 m apart along itself, from abreast of ego on."""

    # x, y, cosine and sine of the heading, curvature (1/m), place along the route from ego on (m), and height above
    # where ego is (m)
    points: Float[Array, "P M 7"]
    route: Float[Array, "R 7"]  # Rows of ``bank.routes`` every 2 m ahead; straight on beyond the end
    left_m: Scalar  # How much of the route is left
    limit: Scalar  # Speed limit of ego's lane, m/s; not positive where unknown

    @classmethod
    def along_route(
        cls, bank: ScenarioBank, row: Integer, along_m: Scalar,
        offsets_m: tuple[float, ...], me: Float[Array, " 6"],
    ) -> Lines:  # fmt: skip
        """Build lines at lateral offsets from the route, straight ahead of ego's box where there is no route.

        ``along_m`` is ego's arc length along its route; offsets are positive to the left. Parallel lines share their
        normals, so all of them start abreast of ego.
        """
        left_m = bank.route_points[row] - 1.0 - along_m
        there = bank.route_points[row] > 1
        left_m = jnp.where(there, left_m, -1.0)

        def rows(ways: Float[Array, " M"]) -> Float[Array, "M 7"]:
            inside = jnp.clip(ways, 0.0, jnp.maximum(left_m, 0.0))
            points, _ = route_ahead(bank, row, along_m, inside)
            straight = jnp.zeros(7).at[RouteColumn.XY].set(me[:2])
            points = jnp.where(there, points, straight.at[RouteColumn.HEADING].set(me[COS : SIN + 1]))
            heading = points[:, RouteColumn.HEADING]
            heading = heading / jnp.maximum(norm(heading), 1e-6)[:, None]
            xy = points[:, RouteColumn.XY] + (ways - inside)[:, None] * heading
            return points.at[:, RouteColumn.XY].set(xy).at[:, RouteColumn.HEADING].set(heading)

        ways = jnp.arange(POINTS, dtype=jnp.float32)
        base = rows(ways)
        points = jnp.stack([_line(rows, base, ways, offset) for offset in offsets_m])
        return cls(points, base[::_EVERY], left_m, jnp.where(there, base[0, RouteColumn.LIMIT], 0.0))

    def at(self, way: Float[Array, "P *T"]) -> Float[Array, "P *T 7"]:
        """Interpolate rows at arc lengths of each line."""
        low = jnp.clip(way.astype(jnp.int32), 0, POINTS - 2)
        part = jnp.clip(way - low, 0.0, 1.0)[..., None]
        both = jax.vmap(lambda line, row: line[row])
        return both(self.points, low) * (1.0 - part) + both(self.points, low + 1) * part

    def places(self, xy: Float[Array, "*T 2"]) -> Float[Array, "*T"]:
        """Arc lengths along the route, from ego on, of points next to it."""
        there = jnp.ones(self.route.shape[0], bool)
        offsets = jnp.arange(self.route.shape[0], dtype=jnp.float32) * _EVERY
        flat = xy.reshape(-1, 2)
        return project(self.route, there, offsets, flat, jnp.ones_like(flat))[0].reshape(xy.shape[:-1])

    def pieces(self, width: Scalar) -> Float[Array, "P C 6"]:
        """Corridors of a width along the lines, as boxes."""
        first, last = self.points[:, :-1:_PIECE_M], self.points[:, _PIECE_M::_PIECE_M]
        count = min(first.shape[1], last.shape[1])
        a, b = first[:, :count, : LINE_Y + 1], last[:, :count, : LINE_Y + 1]
        length = jnp.maximum(norm(b - a), 1e-6)
        long = length[..., None]
        return jnp.concatenate([(a + b) / 2, (b - a) / long, long, jnp.full_like(long, width)], axis=-1)


def _line(
    rows: Any, base: Float[Array, "M 7"], ways: Float[Array, " M"], offset: float
) -> Float[Array, "M 7"]:
    """Return one line with evenly spaced points."""

    def shifted(row: Float[Array, "M 7"]) -> Float[Array, "M 2"]:
        normal = jnp.stack([-row[:, RouteColumn.SIN], row[:, RouteColumn.COS]], axis=-1)
        return row[:, RouteColumn.XY] + offset * normal

    place = ways
    if offset:
        steps = norm(jnp.diff(shifted(base), axis=0))
        arc = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
        place = jnp.interp(ways, arc, ways) + jnp.maximum(ways - arc[-1], 0.0)
    row = rows(place) if offset else base
    cos, sin = row[:, RouteColumn.COS], row[:, RouteColumn.SIN]
    c0, s0, c1, s1 = cos[: -2 * _BEND], sin[: -2 * _BEND], cos[2 * _BEND :], sin[2 * _BEND :]
    bend = jnp.arctan2(c0 * s1 - s0 * c1, c0 * c1 + s0 * s1) / (2.0 * _BEND)
    height = row[:, RouteColumn.Z] - base[0, RouteColumn.Z]
    bend = jnp.pad(bend, _BEND, mode="edge")
    return jnp.stack([*shifted(row).T, cos, sin, bend, place, height], axis=1)


@record
class Proposals:
    """Proposals along P lines with F target speeds, at T steps from now on."""

    way: Float[Array, "P F T"]  # Arc length along the line, m
    speed: Float[Array, "P F T"]  # m/s

    def reference(self, lines: Lines) -> Reference:
        """Return the flattened proposals: target speeds of one line after each other."""
        rows = lines.at(self.way)
        flat = rows.reshape(-1, *rows.shape[2:])
        speed = self.speed.reshape(-1, self.speed.shape[-1])
        return Reference(flat[..., : LINE_SIN + 1], speed, flat[..., LINE_BEND])


def unroll_idm(
    lines: Lines, others: Forecast, size: Vector, speed: Scalar,
    desired: Float[Array, " F"], stop_m: Scalar, driver: tuple[IdmParameters, int, int],
) -> Proposals:  # fmt: skip
    """Simulate IDM along every line, from ego's speed to each desired speed (m/s), by Euler steps of 0.1 s.

    The leader is updated every few steps: of the agents whose box reaches into the corridor of ego's width and whose
    centre is ahead, the one nearest to ego's box. Its gap shrinks by ego's motion until the next search. ``stop_m`` is
    the distance from ego's front to the nearest stop line that requires a stop, infinite for none; ``driver`` holds
    parameters, the number of steps, and the steps between searches.
    """
    parameters, steps, every = driver
    count = lines.points.shape[0], desired.shape[0]
    boxes = others.at(jnp.arange(0, steps, every) * DT_S)
    inside = _on_corridor(lines.pieces(size[1]), boxes) & others.valid
    places = lines.places(boxes[..., :2])
    stop_place = stop_m + size[0] / 2
    length, width = (jnp.full(count, part) for part in size)

    def search(now: tuple[Array, Array], then: tuple[Array, ...]) -> Any:
        way, speed = now
        box, place, inside = then
        row = lines.at(way)
        me = jnp.stack([*jnp.moveaxis(row[..., : LINE_SIN + 1], -1, 0), length, width], axis=-1)
        leads = inside[:, None] & (place > row[..., LINE_PLACE, None])
        gaps = jnp.where(leads, gap(me[:, :, None], box), _FREE_M)
        leader, free = first_smallest(gaps), jnp.min(gaps, axis=-1)
        velocity = others.velocity[leader]
        ahead = velocity[..., 0] * row[..., LINE_COS] + velocity[..., 1] * row[..., LINE_SIN]
        stop = jnp.maximum(stop_place - row[..., LINE_PLACE] - size[0] / 2, 0.0)
        stop = jnp.where(stop_place > row[..., LINE_PLACE], jnp.minimum(stop, _FREE_M), _FREE_M)
        ahead, free = jnp.where(stop < free, 0.0, ahead), jnp.minimum(stop, free)
        states = []
        for _ in range(every):
            kept = jnp.maximum(free, parameters.min_gap_m)
            acceleration = idm_acceleration(speed, desired, kept, ahead, parameters)
            way, free = way + DT_S * speed, free - DT_S * speed
            speed = jnp.maximum(speed + DT_S * acceleration, 0.0)
            states.append((way, speed))
        return (way, speed), jax.tree.map(lambda *parts: jnp.stack(parts), *states)

    start = jnp.zeros(count), jnp.full(count, speed)
    searches = (boxes, places, jnp.moveaxis(inside, 1, 0))
    _, states = jax.lax.scan(search, start, searches)

    def in_time(first: Array, rest: Array) -> Array:
        rest = jnp.moveaxis(rest.reshape(-1, *count), 0, -1)
        return jnp.concatenate([first[..., None], rest], axis=-1)

    return Proposals(*(in_time(first, rest) for first, rest in zip(start, states, strict=True)))


def _on_corridor(pieces: Float[Array, "P C 6"], boxes: Float[Array, "U K 6"]) -> Bool[Array, "P U K"]:
    """Mask of boxes that reach into each corridor, at each time."""
    return overlap(pieces[:, None, :, None], boxes[None, :, None]).any(axis=2)
