"""Look ahead along the route: nearest obstacle, lights that require a stop, desired speed, and pure pursuit."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax import kernels
from drivax.geometry.boxes import COS, LENGTH, WIDTH, X
from drivax.geometry.vectors import norm, rotate
from drivax.kernels.bindings import Agents, look_ahead
from drivax.scenario.bank.columns import LightRow, RouteColumn
from drivax.scenario.bank.queries import LEVEL_M, route_ahead
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank, Vector
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record
from drivax.scenario.schema import LightState
from drivax.simulator.contact import others_on_level
from drivax.simulator.dynamics import pursuit
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.lights import is_red, is_yellow
from drivax.simulator.traffic.corridor import (
    CLOSEST,
    FREE_M,
    LEAST_GAP_M,
    SLOT_BITS,
    closest,
    overlaps_rectangles,
)
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED, AgentContext, Frame

#: Points ahead on the route: spacing (m), number, and number of rectangles around them.
_STEP_M, _POINTS, _RECTANGLES = 2.0, 46, 9
#: Largest distance along the route to the nearest of its points at which a pose is alongside it, m.
ALONGSIDE_M = 2.0 * _STEP_M
#: Speed limit of lanes without one, m/s.
FALLBACK_LIMIT_MPS = 13.4
#: Free space next to the car, m; lateral acceleration in curves, m/s2; braking towards curves, m/s2.
_SIDE_M, _CURVE_MPS2, _CURVE_BRAKING_MPS2 = 0.3, 2.5, 2.0
#: Margin of the corridor on either side of ego, m; agents outside it are ignored.
_NEAR_M = 0.4
#: A yellow light counts as red for a car that can stop with this deceleration, m/s2.
_YELLOW_BRAKING_MPS2 = 3.0
#: Look-ahead of pure pursuit: at a standstill, m; per m/s, s; its bounds, m.
_LOOKAHEAD_M, _LOOKAHEAD_S, _LOOKAHEAD_BOUNDS_M = 3.0, 0.8, (4.0, 20.0)
#: Distance before a stop line at which cars stop, m.
STOP_SHORT_M = 1.0
#: Constants of the native kernel.
_RULES: dict[str, Any] = {
    "points": _POINTS, "rectangles": _RECTANGLES, "closest": CLOSEST, "slot_bits": SLOT_BITS,
    "red": LightState.STOP, "red_arrow": LightState.ARROW_STOP,
    "yellow": LightState.CAUTION, "yellow_arrow": LightState.ARROW_CAUTION,
    "step_m": _STEP_M, "near_m": _NEAR_M, "ends_m": 2.0 * _STEP_M, "level_m": LEVEL_M, "side_m": _SIDE_M,
    "least_gap_m": LEAST_GAP_M, "free_m": FREE_M, "limit_mps": FALLBACK_LIMIT_MPS, "curve_mps2": _CURVE_MPS2,
    "curve_braking_mps2": _CURVE_BRAKING_MPS2, "yellow_braking_mps2": _YELLOW_BRAKING_MPS2,
    "stop_short_m": STOP_SHORT_M,
}  # fmt: skip


@record
class Ahead:
    """Inputs of a car-following driver."""

    # Gap to the nearest obstacle, bumper to bumper, m; 10 km if free. A stop line counts as a standing car at the
    # distance that makes the driver stop 1 m before the line
    gap: Scalar
    leader: Scalar  # Speed of the obstacle along the route, m/s; 0 for a light, arbitrary if free
    desired: Scalar  # Speed limit (13.4 if unknown), less before curves; 0 at the route's end, m/s

    def acceleration(self, speed: Scalar, parameters: IdmParameters) -> Scalar:
        """Return the IDM acceleration at a speed, m/s2."""
        return idm_acceleration(speed, self.desired, self.gap, self.leader, parameters)


def ahead(bank: ScenarioBank, context: AgentContext, frame: Frame, min_gap_m: float | Scalar) -> Ahead:
    """Look 90 m ahead of the driven agent along its route, and for stop lines 92 m ahead of its front bumper.

    ``min_gap_m`` is the gap that the driver keeps behind a standing leader.
    """
    if kernels.in_use():
        native = kernels.with_reference(_ahead_natively, ahead)
        return native(bank, context, frame, jnp.asarray(min_gap_m, jnp.float32))
    route = _route_points(bank, context)
    leader_m, leader_mps = _leader(frame, context.slot, *route)
    # The driver stops min_gap_m behind a leader, but STOP_SHORT_M before a line.
    stop = stop_line_m(bank, context, frame) + min_gap_m - STOP_SHORT_M
    gap = jnp.minimum(leader_m, stop)
    leader = jnp.where(stop < leader_m, 0.0, leader_mps)
    # Without a second point the route ends within 2 m.
    desired = jnp.where(route[1][1], desired_speed(*route), 0.0)
    return Ahead(jnp.where(jnp.isfinite(gap), gap, FREE_M), leader, desired)


def _ahead_natively(bank: ScenarioBank, context: AgentContext, frame: Frame, min_gap_m: Scalar) -> Ahead:
    """Return the result of :func:`ahead`, computed by the native kernel."""
    maps = (bank.routes, bank.route_points, bank.light_line)
    agents = Agents(frame.box, frame.velocity, frame.z, frame.valid, frame.kind)
    arc = jnp.asarray(LightRow.ARC + bank.ego_number(context.row), jnp.int32)
    speed = context.history[-1, MOTION_SPEED]
    numbers = (context.slot, context.index, context.row, arc)
    return Ahead(*look_ahead(maps, agents, frame.lights, numbers, context.route_m, speed, min_gap_m, _RULES))


def leader_gap(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Scalar:
    """Return the gap to the nearest obstacle within 90 m on the route, m; infinite without one or without a route."""
    gap, _ = _leader(frame, context.slot, *_route_points(bank, context))
    return jnp.where(has_route(bank, context), gap, jnp.inf)


def _route_points(
    bank: ScenarioBank, context: AgentContext
) -> tuple[Float[Array, "K 7"], Bool[Array, " K"], Float[Array, " K"]]:
    """Return points ahead on the route, whether the route reaches each, and their distances along it, m."""
    offsets = jnp.arange(_POINTS) * _STEP_M
    return *route_ahead(bank, context.row, context.route_m, offsets), offsets


def _leader(
    frame: Frame, slot: Array, path: Float[Array, "K 7"], on_route: Bool[Array, " K"], offsets: Float[Array, " K"]
) -> tuple[Scalar, Scalar]:  # fmt: skip
    """Return the gap to the nearest obstacle on a path (m; infinite without one), and its speed along the path."""
    ego = frame.box[slot]
    # Projecting agents on all points is slow, so select the closest agents near the route first.
    nodes = jnp.where(on_route[:, None], path[:, RouteColumn.XY], path[0, RouteColumn.XY])[None]
    boxes = frame.box.T
    half_m = (ego[WIDTH : WIDTH + 1] / 2 + _NEAR_M)[None]
    is_near = overlaps_rectangles(boxes, nodes, half_m, 2.0 * _STEP_M, 2.0 * _STEP_M, _RECTANGLES)
    slots, valid = closest(is_near & others_on_level(frame, slot), ego[None], boxes)
    box, velocity = frame.box[slots[0]], frame.velocity[slots[0]]
    along, lateral, cos, sin = project(path, on_route, offsets, box[:, X:COS], box[:, COS:LENGTH])
    half_length = jnp.abs(cos) * box[:, LENGTH] / 2 + jnp.abs(sin) * box[:, WIDTH] / 2
    half_width = jnp.abs(sin) * box[:, LENGTH] / 2 + jnp.abs(cos) * box[:, WIDTH] / 2
    is_obstacle = valid[0] & (jnp.abs(lateral) < half_width + ego[WIDTH] / 2 + _SIDE_M) & (along > 0.0)
    gaps = jnp.where(is_obstacle, along - half_length - ego[LENGTH] / 2, jnp.inf)
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1)) * cos
    nearest = first_smallest(gaps, least=LEAST_GAP_M)
    return gaps[nearest], speed[nearest]


def stop_line_m(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Scalar:
    """Return the distance from the front bumper to the nearest stop line that requires a stop, m.

    Infinite if there is none within 92 m.
    """
    line, state = bank.light_line[context.index], frame.lights
    arc = line[LightRow.ARC + bank.ego_number(context.row)]
    distance = arc - context.route_m - frame.box[context.slot, LENGTH] / 2
    speed = context.history[-1, MOTION_SPEED]
    can_stop = speed * speed / (2.0 * jnp.maximum(distance, 0.1)) < _YELLOW_BRAKING_MPS2
    requires_stop = is_red(state) | (is_yellow(state) & can_stop)
    is_relevant = requires_stop & (distance > 0.0) & (distance < _POINTS * _STEP_M)
    return jnp.min(jnp.where(is_relevant, distance, jnp.inf))


def desired_speed(path: Array, on_route: Array, offsets: Array) -> Scalar:
    """Return the present speed limit, or the lower speed that the curves ahead require, m/s."""
    limit = jnp.where(path[0, RouteColumn.LIMIT] > 0, path[0, RouteColumn.LIMIT], FALLBACK_LIMIT_MPS)
    cos, sin = path[:, RouteColumn.COS], path[:, RouteColumn.SIN]
    dot, cross = cos[1:] * cos[:-1] + sin[1:] * sin[:-1], cos[:-1] * sin[1:] - cos[1:] * sin[:-1]
    curvature = jnp.arctan2(jnp.abs(cross), dot) / _STEP_M
    curvature = jnp.where(on_route[1:], curvature, 0.0)
    # The square of the speed from which the car brakes to the curve's speed over the distance to it.
    squared_speed = _CURVE_MPS2 / jnp.maximum(curvature, 1e-4) + 2.0 * _CURVE_BRAKING_MPS2 * offsets[:-1]
    return jnp.minimum(limit, jnp.sqrt(jnp.min(squared_speed)))


def project(
    path: Float[Array, "K 7"], on_route: Array, offsets: Float[Array, " K"], xy: Float[Array, "S 2"],
    heading: Float[Array, "S 2"],
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Project poses on a path: return arc length, lateral offset, cosine and sine of the heading relative to the path.

    Beyond either end the path continues along its tangent; the lateral offset is infinite more than 4 m beyond it.
    """
    dx, dy = xy[:, None, 0] - path[:, 0], xy[:, None, 1] - path[:, 1]
    nearest = first_smallest(jnp.where(on_route, dx * dx + dy * dy, jnp.inf))
    point = path[nearest]
    x, y = xy[:, 0] - point[:, 0], xy[:, 1] - point[:, 1]
    cos, sin = point[:, RouteColumn.COS], point[:, RouteColumn.SIN]
    forward, left = x * cos + y * sin, y * cos - x * sin
    is_alongside = jnp.abs(forward) <= ALONGSIDE_M
    relative_cos = heading[:, 0] * cos + heading[:, 1] * sin
    relative_sin = heading[:, 1] * cos - heading[:, 0] * sin
    return offsets[nearest] + forward, jnp.where(is_alongside, left, jnp.inf), relative_cos, relative_sin


def has_route(bank: ScenarioBank, context: AgentContext) -> Bool[Array, ""]:
    """Return whether the driven agent has a route on lanes.

    Otherwise its row of the bank has ego's logged path, which is privileged, or the route of another agent.
    """
    return bank.on_lanes[context.row] & (context.slot == bank.ego_slot(context.row))


def lookahead_m(speed: Scalar) -> Scalar:
    """Return the look-ahead of pure pursuit at a speed, m."""
    return jnp.clip(_LOOKAHEAD_S * speed + _LOOKAHEAD_M, *_LOOKAHEAD_BOUNDS_M)


def follow_route(bank: ScenarioBank, context: AgentContext, offset_m: Scalar) -> Scalar:
    """Return the curvature of pure pursuit to the route shifted left by ``offset_m``, 1/m."""
    point, left = _pursuit_point(bank, context)
    return pursuit(jnp.array([0.0, 0.0, 1.0, 0.0]), point + offset_m * left)


def offset_to_steer(bank: ScenarioBank, context: AgentContext, curvature: Scalar) -> Scalar:
    """Return the offset for which :func:`follow_route` returns a curvature, m.

    The arc of curvature k from the origin meets the line p + d n where ``k |p + d n|^2 = 2 (p + d n)_y``. If they do
    not meet, or the car heads across the route, the result is finite but not such an offset.
    """
    point, left = _pursuit_point(bank, context)
    linear = 2.0 * (curvature * jnp.sum(point * left) - left[1])
    constant = curvature * jnp.sum(point * point) - 2.0 * point[1]
    root = jnp.sqrt(jnp.maximum(linear * linear - 4.0 * curvature * constant, 0.0))
    # The root that stays finite for k = 0.
    return 2.0 * constant / jnp.maximum(root - linear, 1e-3)


def _pursuit_point(bank: ScenarioBank, context: AgentContext) -> tuple[Vector, Vector]:
    """Return the route's point at the look-ahead distance, and its normal to the left, in the agent's frame.

    The route continues straight beyond its end. Without a route on lanes the point is straight ahead.
    """
    motion, zero = context.history[-1], jnp.zeros(())
    distance_m = lookahead_m(motion[MOTION_SPEED])
    remaining_m = bank.route_points[context.row] - 1 - context.route_m
    on_route_m = jnp.clip(remaining_m, 0.0, distance_m)
    points, _ = route_ahead(bank, context.row, context.route_m, on_route_m[None])
    direction = points[0, RouteColumn.HEADING] / jnp.maximum(norm(points[0, RouteColumn.HEADING]), 1e-6)
    xy = points[0, RouteColumn.XY] + (distance_m - on_route_m) * direction - motion[:2]
    cos, sin = jnp.cos(motion[MOTION_HEADING]), jnp.sin(motion[MOTION_HEADING])
    point, direction = rotate(xy, cos, -sin), rotate(direction, cos, -sin)
    on_lanes = has_route(bank, context)
    point = jnp.where(on_lanes, point, jnp.stack([distance_m, zero]))
    return point, jnp.where(on_lanes, jnp.stack([-direction[1], direction[0]]), jnp.array([0.0, 1.0]))
