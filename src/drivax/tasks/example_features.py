"""Ready-made features for custom observation groups.

Select them in YAML by ``observation: {own: [{feature: drivax.tasks.example_features:lane_curvature}]}``, in Python by
``ObservationConfig(own=(OwnGroup(lane_curvature),))``. Each is a function of bank, context and frames; ``frames(k)`` is
the frame of all agents k steps ago as ego perceived it.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, WIDTH
from drivax.geometry.vectors import norm
from drivax.scenario.bank.columns import NEVER_M, LightRow, RoadColumn, RoadLayer
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import FALLBACK_LIMIT_MPS, ahead, has_route
from drivax.simulator.idm import IdmParameters
from drivax.simulator.lights import is_red
from drivax.simulator.situation import completed_share
from drivax.simulator.types import MOTION_SPEED, AgentContext
from drivax.tasks import features
from drivax.tasks.features import POSITION_M, SPEED_MPS, Frames, View

#: Number of agents in ``relative_velocity``; spacing (m) and number of route points in ``recommended_speed``.
_OTHERS, _STEP_M, _POINTS = 8, 5.0, 10
#: Lane pieces: maximum distance, m; minimum cosine of the angle to ego; weight of the sine of the angle, m.
_LANE_M, _LANE_COS, _M_PER_SINE = 2.5, 0.5, 4.0
#: Half the width of the strip ahead that contains a leader, m; maximum of time gaps, s.
_HALF_STRIP_M, _LONGEST_S = 1.5, 10.0
#: Look-ahead of a car-following driver, m.
_FARTHEST_M = 90.0
#: Lower bound of the speed in time gaps, m/s.
_SLOWEST_MPS = 1.0


def relative_velocity(
    bank: ScenarioBank, context: AgentContext, frames: Frames
) -> tuple[Float[Array, "K 2"], Bool[Array, " K"]]:
    """Return the velocity of the eight nearest agents relative to ego, ego frame, in units of 15 m/s.

    Rows are in the order of the group ``agents``.
    """
    now, view, ego = frames(0), View.of(context), context.history[-1]
    present = now.valid & (jnp.arange(len(now.valid)) != context.slot)
    distance = jnp.where(present, norm(now.box[:, :2] - view.xy), jnp.inf)
    rank = jnp.arange(_OTHERS)
    order = jnp.argsort(distance)[jnp.minimum(rank, len(distance) - 1)]
    ego_velocity = jnp.stack([ego[MOTION_SPEED], jnp.zeros(())])
    velocity = (view.vector(now.velocity[order]) - ego_velocity) / SPEED_MPS
    return velocity, present[order] & (rank < len(distance))


def lane_curvature(bank: ScenarioBank, context: AgentContext, frames: Frames) -> Float[Array, " 2"]:
    """Return the curvature of ego's lane in units of 0.1 1/m (left positive), and whether ego is on a lane.

    The lane is the piece within 2.5 m and 60 degrees that fits position and heading best, where 1 m weighs as much as
    15 degrees. The feature needs no route, and does not distinguish levels of the road.
    """
    view = View.of(context)
    rows, layer = bank.road[context.index], bank.road_at[context.index, 2]
    middle, direction = view.point(rows[:, RoadColumn.XY]), view.vector(rows[:, RoadColumn.DIRECTION])
    half_length = rows[:, RoadColumn.LENGTH] / 2
    offset = jnp.clip(-jnp.sum(middle * direction, axis=-1), -half_length, half_length)
    distance = norm(middle + offset[:, None] * direction)
    is_candidate = (layer == RoadLayer.LANE) & (distance < _LANE_M) & (direction[:, 0] > _LANE_COS)
    best = first_smallest(
        jnp.where(is_candidate, distance**2 + (_M_PER_SINE * direction[:, 1]) ** 2, jnp.inf)
    )
    curvature = features.scale_curvature(bank.road_curvature[context.index, best])
    return jnp.stack([jnp.where(is_candidate[best], curvature, 0.0), is_candidate[best].astype(jnp.float32)])


def recommended_speed(
    bank: ScenarioBank, context: AgentContext, frames: Frames
) -> tuple[Float[Array, "K 1"], Bool[Array, " K"]]:
    """Return ``clip(30 - 25 |k|, 5, 30)`` m/s for curvatures k at ten route points 5 m apart, in units of 15 m/s."""
    offsets = _STEP_M * jnp.arange(1, _POINTS + 1)
    _, valid = route_ahead(bank, context.row, context.route_m, offsets)
    curvature = features.route_curvature(bank, context.row, context.route_m + offsets)
    valid &= has_route(bank, context)
    return features.recommended_speed(curvature)[:, None] / SPEED_MPS, valid


def time_gap(bank: ScenarioBank, context: AgentContext, frames: Frames) -> Float[Array, " 2"]:
    """Return the time gap to the leader in units of 10 s, at most 1, and whether there is a leader.

    The time gap is the distance from bumper to bumper divided by ego's speed, or by 1 m/s if ego is slower. The leader
    is the nearest agent with its centre in a strip of 3 m width straight ahead of ego. Without a leader the first
    number is 1.
    """
    now, view = frames(0), View.of(context)
    position = view.point(now.box[:, :2])
    others = now.valid & (jnp.arange(len(now.valid)) != context.slot)
    is_ahead = others & (position[:, 0] > 0) & (jnp.abs(position[:, 1]) < _HALF_STRIP_M)
    half_length = bank.length_m(context.index, context.slot) / 2
    direction = jnp.abs(view.vector(now.box[:, COS:LENGTH]))
    # Half extent of boxes along ego's heading.
    extent = (direction[:, 0] * now.box[:, LENGTH] + direction[:, 1] * now.box[:, WIDTH]) / 2
    gap = jnp.where(is_ahead, jnp.maximum(position[:, 0] - half_length - extent, 0.0), jnp.inf)
    time = jnp.min(gap) / jnp.maximum(context.history[-1, MOTION_SPEED], _SLOWEST_MPS)
    return jnp.stack([jnp.minimum(time / _LONGEST_S, 1.0), is_ahead.any().astype(jnp.float32)])


def destination(bank: ScenarioBank, context: AgentContext, frames: Frames) -> Float[Array, " 3"]:
    """Return the remaining distance along the route to the end of the log, its completed share, and the remaining time.

    The reward term ``completion`` depends on them. The distance is in units of 50 m, in [-1, 5], the time in units of
    10 s. Without a route on lanes, the distance is 0 and the share 1.
    """
    last, on_route = bank.last_step[context.row], has_route(bank, context)
    distance = (bank.log_progress[context.row][last] - context.route_m) / POSITION_M
    distance = jnp.where(on_route, jnp.clip(distance, -1.0, features.MAX_GOAL), 0.0)
    share = jnp.where(on_route, completed_share(bank, context), 1.0)
    return jnp.stack([distance, share, (last - context.step) * DT_S / _LONGEST_S])


def car_following(bank: ScenarioBank, context: AgentContext, frames: Frames) -> Float[Array, " 5"]:
    """Return the inputs of a car-following driver along the route.

    They are the gap to the leader, or to a light that requires a stop, at most 90 m, in units of 50 m; closing speed
    and speed of the leader (0 without one); whether there is one; and the speed that the limit and the curves ahead
    allow. Speeds are in units of 15 m/s. Without a route on lanes there is no leader, and the last number stands for
    13.4 m/s, as without a limit.
    """
    speed = context.history[-1, MOTION_SPEED]
    inputs = ahead(bank, context, frames(0), IdmParameters().min_gap_m)
    route_exists = has_route(bank, context)
    has_leader = route_exists & (inputs.gap < _FARTHEST_M)
    gap = jnp.where(has_leader, inputs.gap, _FARTHEST_M) / POSITION_M
    speeds = jnp.stack([speed - inputs.leader, inputs.leader]) * has_leader / SPEED_MPS
    desired_speed = jnp.where(route_exists, inputs.desired, FALLBACK_LIMIT_MPS) / SPEED_MPS
    return jnp.stack([gap, *speeds, has_leader.astype(jnp.float32), desired_speed])


def stop_line(bank: ScenarioBank, context: AgentContext, frames: Frames) -> Float[Array, " 3"]:
    """Return the distance to the next stop line on the route, whether its light is red, and whether there is one.

    The distance is from the front bumper, in units of 50 m; 1 without a line. Lines beyond 50 m, behind the bumper or
    without an observed light do not count.
    """
    arc = bank.light_line[context.index, LightRow.ARC + bank.ego_number(context.row)]
    line_m = arc - context.route_m
    gap = line_m - bank.length_m(context.index, context.slot) / 2
    state = frames(0).lights
    on_route = arc < NEVER_M
    counts = on_route & (state >= 0) & (gap > 0.0) & (gap < POSITION_M) & has_route(bank, context)
    nearest = jnp.argmin(jnp.where(counts, gap, jnp.inf))
    distance = jnp.where(counts.any(), gap[nearest] / POSITION_M, 1.0)
    flags = jnp.stack([counts & is_red(state), counts])[:, nearest].astype(jnp.float32)
    return jnp.stack([distance, *flags])
