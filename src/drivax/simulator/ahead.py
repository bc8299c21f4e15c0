"""What a driver on its route has ahead: the nearest thing in the way, lights that ask to stop, the speed it wants."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.scenario.bank.columns import LightRow, RouteColumn
from drivax.scenario.bank.queries import LEVEL_M, route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record
from drivax.scenario.schema import LightState
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.traffic.corridor import FREE_M, LEAST_GAP_M, closest, reaching
from drivax.simulator.types import AgentContext, Frame

#: Look-ahead along the route and its spacing, m.
_STEP_M, _POINTS = 2.0, 46
_FALLBACK_LIMIT_MPS = 13.4
#: Free space kept next to the car, m; lateral acceleration in curves, m/s2; braking towards them, m/s2.
_SIDE_M, _CURVE_MPS2, _CURVE_BRAKING_MPS2 = 0.3, 2.5, 2.0
#: Things further along the route than this, and ego's half width, are not looked at, m.
_NEAR_M = 0.4
#: A yellow light is a red one for a car that can stop with this deceleration, m/s2.
_YELLOW_BRAKING_MPS2 = 3.0
#: Where to stand before a stop line, m.
STOP_SHORT_M = 1.0


@record
class Ahead:
    """What a car-following driver looks at.

    Attributes:
        gap: To the nearest thing in the way, bumper to bumper, or a little less than to a light that asks to stop, m;
            10 km where there is neither.
        leader: Speed of that thing along the route, m/s; 0 for a light.
        desired: The limit here, or what the curves ahead allow; 13.4 where none is known, 0 at the route's end, m/s.
    """

    gap: Float[Array, ""]
    leader: Float[Array, ""]
    desired: Float[Array, ""]

    def acceleration(self, speed: Float[Array, ""], parameters: IdmParameters) -> Float[Array, ""]:
        """What the IDM does with it at a speed, m/s2."""
        return idm_acceleration(speed, self.desired, self.gap, self.leader, parameters)


def ahead(bank: ScenarioBank, context: AgentContext, frame: Frame, min_gap_m: float) -> Ahead:
    """Looks 90 m along the route from where the driven agent is.

    Args:
        bank: The scenarios.
        context: The context.
        frame: All agents now.
        min_gap_m: What the driver keeps from a thing, so that it stands 1 m before a stop line.
    """
    me = frame.box[context.slot]
    offsets = jnp.arange(_POINTS) * _STEP_M
    path, there = route_ahead(bank, context.index, context.route_m, offsets)
    others = frame.valid & (jnp.arange(frame.valid.shape[0]) != context.slot)
    others &= jnp.abs(frame.z - frame.z[context.slot]) <= LEVEL_M
    # Only the closest of those that come near the route are measured against all of its points.
    nodes = jnp.where(there[:, None], path[:, RouteColumn.XY], path[0, RouteColumn.XY])[None]
    boxes = frame.box.T
    near = reaching(boxes, nodes, (me[5:6] / 2 + _NEAR_M)[None], 2.0 * _STEP_M, 2.0 * _STEP_M, 9)
    slots, real = closest(near & others, me[None], boxes)
    box, velocity = frame.box[slots[0]], frame.velocity[slots[0]]
    along, lateral, cos, sin = project(path, there, offsets, box[:, :2], box[:, 2:4])
    half_length = jnp.abs(cos) * box[:, 4] / 2 + jnp.abs(sin) * box[:, 5] / 2
    half_width = jnp.abs(sin) * box[:, 4] / 2 + jnp.abs(cos) * box[:, 5] / 2
    blocks = real[0] & (jnp.abs(lateral) < half_width + me[5] / 2 + _SIDE_M) & (along > 0.0)
    gaps = jnp.where(blocks, along - half_length - me[4] / 2, jnp.inf)
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1)) * cos
    nearest = first_smallest(gaps, least=LEAST_GAP_M)
    stop = stop_line_m(bank, context, frame) + min_gap_m - STOP_SHORT_M
    gap = jnp.minimum(gaps[nearest], stop)
    return Ahead(
        gap=jnp.where(jnp.isfinite(gap), gap, FREE_M),
        leader=jnp.where(stop < gaps[nearest], 0.0, speed[nearest]),
        desired=jnp.where(there[1], desired_speed(path, there, offsets), 0.0),
    )


def stop_line_m(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Float[Array, ""]:
    """Distance from the front bumper to the nearest stop line of the route whose light asks to stop; inf: none does."""
    line, state = bank.light_line[context.index], frame.lights
    front = line[LightRow.ARC] - context.route_m - frame.box[context.slot, 4] / 2
    speed = context.history[-1, 3]
    can_stop = speed * speed / (2.0 * jnp.maximum(front, 0.1)) < _YELLOW_BRAKING_MPS2
    red = (state == LightState.STOP) | (state == LightState.ARROW_STOP)
    yellow = (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
    asks = (red | (yellow & can_stop)) & (front > 0.0) & (front < _POINTS * _STEP_M)
    return jnp.min(jnp.where(asks, front, jnp.inf))


def desired_speed(path: Array, there: Array, offsets: Array) -> Float[Array, ""]:
    """The limit here, and what the curves ahead allow with gentle braking."""
    limit = jnp.where(path[0, RouteColumn.LIMIT] > 0, path[0, RouteColumn.LIMIT], _FALLBACK_LIMIT_MPS)
    cos, sin = path[:, RouteColumn.COS], path[:, RouteColumn.SIN]
    dot, cross = cos[1:] * cos[:-1] + sin[1:] * sin[:-1], cos[:-1] * sin[1:] - cos[1:] * sin[:-1]
    curvature = jnp.arctan2(jnp.abs(cross), dot) / _STEP_M
    curvature = jnp.where(there[1:], curvature, 0.0)
    allowed = _CURVE_MPS2 / jnp.maximum(curvature, 1e-4) + 2.0 * _CURVE_BRAKING_MPS2 * offsets[:-1]
    return jnp.minimum(limit, jnp.sqrt(jnp.min(allowed)))


def project(
    path: Float[Array, "K 7"], there: Array, offsets: Float[Array, " K"], xy: Float[Array, "S 2"],
    heading: Float[Array, "S 2"],
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Arc length ahead and lateral offset of points on a path, and cosine and sine of headings relative to it."""
    dx, dy = xy[:, None, 0] - path[:, 0], xy[:, None, 1] - path[:, 1]
    nearest = first_smallest(jnp.where(there, dx * dx + dy * dy, jnp.inf))
    row = path[nearest]
    x, y = xy[:, 0] - row[:, 0], xy[:, 1] - row[:, 1]
    cos, sin = row[:, RouteColumn.COS], row[:, RouteColumn.SIN]
    # Beyond either end of the path the tangent goes on; nothing there is on it.
    forward, left = x * cos + y * sin, y * cos - x * sin
    on = jnp.abs(forward) <= 2.0 * _STEP_M
    relative_cos = heading[:, 0] * cos + heading[:, 1] * sin
    relative_sin = heading[:, 1] * cos - heading[:, 0] * sin
    return offsets[nearest] + forward, jnp.where(on, left, jnp.inf), relative_cos, relative_sin
