"""Kinematic criticality: surrogate safety measures and driving behaviour in the log.

Components of every step, all in [0, 1]:

- urgency: inverse time to collision (Hayward, 1972), scaled from 0 at the horizon of 5 s to 1 at ``urgent_s``;
- braking: required deceleration to the nearest agent on ego's path at constant speed, ``(v - v_leader)^2 / (2 gap)``
  (Cooper and Ferguson, Traffic Studies at T-Junctions, 1976), over the car's maximum deceleration (brake threat number
  of Braennstroem, Sjoeberg and Coelingh, 2008). Oncoming agents count as standing, because ego's braking cannot reduce
  their share of the closing speed;
- encroachment: post-encroachment time, the time between one of two vehicles leaving the area where their paths cross,
  and the other entering it (Allen, Shin and Cooper, Transportation Research Record 667, 1978), scaled from 0 at
  ``encroachment_s`` to 1 at 0, from 2 s before the first of them enters until the last enters it;
- volatility: the larger of jerk and yaw acceleration, relative to twice nuPlan's limits, from a Savitzky-Golay filter
  (1964) around the action of the step;
- off_road: closeness of the car's corners to the road edge, 1 beyond it;
- lane_deviation: distance to the nearest lane centre;
- density: number of agents.

Time to collision detects crossing traffic, but assumes fixed headings and therefore reports oncoming traffic in bends.
Required braking follows the path through bends, but only considers agents on it. The post-encroachment time is that of
the motion that was driven: it finds turning and crossing traffic that ego just passed, but not agents that ego follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.curation.logged import LoggedScenario
from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.geometry.vectors import norm, wrap
from drivax.metrics.comfort import JERK_MPS3, YAW_ACCELERATION_RPS2, savgol_matrix
from drivax.scenario.bank import queries
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import STOPPED_MPS, TTC_HORIZON_S, time_to_collision
from drivax.simulator.types import Frame

#: Centres of two route windows that cover about 75 m of the path ahead, m.
_WINDOWS_M = (6.0, 45.0)
#: Largest cosine between crossing paths (26 degrees), least speed of ego at a conflict (m/s), and steps before it.
_CROSSING_COS, _REACHES_MPS, _BEFORE_STEPS = 0.9, 3.0, 20
#: Distance of the path's points that are searched for the nearest one, and number of points around it, 1 m apart.
_COARSE, _FINE = 8, 32
#: Filter window of 1.5 s, as nuPlan's for jerk, and nuPlan's orders for jerk and yaw acceleration.
_WINDOW, _JERK_ORDER, _YAW_ORDER = 15, 2, 3


@dataclass(frozen=True)
class KinematicConfig:
    """Scales of the components: the values at which they reach 1, unless noted.

    Attributes:
        urgent_s: Time to collision; the bound of the metric ``ttc_ok``.
        encroachment_s: Post-encroachment time at which encroachment is 0.
        full_braking_mps2: Required deceleration; the limit of the physical action space.
        full_jerk_mps3, full_yaw_rps2: Jerk, and yaw acceleration (rad/s2); twice nuPlan's limits.
        edge_m: Distance of a corner inside the road edge at which off_road is 0.
        lane_m: Distance to the lane centre.
        crowd: Number of agents, ego included.
    """

    urgent_s: float = 0.95
    encroachment_s: float = 1.5
    full_braking_mps2: float = 6.0
    full_jerk_mps3: float = 2 * JERK_MPS3
    full_yaw_rps2: float = 2 * YAW_ACCELERATION_RPS2
    edge_m: float = 0.75
    lane_m: float = 1.25
    crowd: int = 50

    def __post_init__(self) -> None:
        if not 0.0 < self.urgent_s < TTC_HORIZON_S:
            cure = f"use more than 0 and less than {TTC_HORIZON_S}"
            raise UsageError(f"urgent_s is {self.urgent_s}", cure=cure)
        names = (
            "encroachment_s",
            "full_braking_mps2",
            "full_jerk_mps3",
            "full_yaw_rps2",
            "edge_m",
            "lane_m",
            "crowd",
        )
        check_positive({name: getattr(self, name) for name in names})

    def __call__(self, bank: ScenarioBank, log: LoggedScenario) -> dict[str, Float[Array, " T"]]:
        """Return the components of every step of a log."""
        return {
            "urgency": _urgency(self, log),
            "encroachment": jnp.clip(1.0 - post_encroachment_time(bank, log) / self.encroachment_s, 0.0, 1.0),
            "braking": jnp.clip(_required_braking(log) / self.full_braking_mps2, 0.0, 1.0),
            "volatility": _volatility(self, log, bank.last_step[log.row]),
            "off_road": _edge_nearness(self, bank, log),
            "lane_deviation": _lane_deviation(self, bank, log),
            "density": crowding(log, self.crowd),
        }


def check_positive(values: dict[str, float]) -> None:
    """Check that scales are positive and finite."""
    for name, value in values.items():
        if not 0.0 < value < float("inf"):
            raise UsageError(f"{name} is {value}", cure="use a positive number, but not inf")


def scale_urgency(ttc_s: Float[Array, "*steps"], urgent_s: float) -> Float[Array, "*steps"]:
    """Return the scaled inverse of times to collision: 0 from the horizon of 5 s on, 1 up to ``urgent_s``."""
    low, high = 1.0 / TTC_HORIZON_S, 1.0 / urgent_s
    return jnp.clip((1.0 / jnp.maximum(ttc_s, 1e-3) - low) / (high - low), 0.0, 1.0)


def _urgency(config: KinematicConfig, log: LoggedScenario) -> Float[Array, " T"]:
    """Return the scaled inverse time to collision, 0 at standstill."""

    def at_step(frame: Frame, ignored: Array, motion: Array) -> Array:
        ttc_s = time_to_collision(frame, log.slot, ignored)
        return jnp.where(motion[3] >= STOPPED_MPS, scale_urgency(ttc_s, config.urgent_s), 0.0)

    return jax.vmap(at_step)(log.frame, log.ignored, log.motion)


def post_encroachment_time(bank: ScenarioBank, log: LoggedScenario) -> Float[Array, " T"]:
    """Return the shortest post-encroachment time (s) of the conflicts of every step, infinite without one.

    An agent conflicts if its box moves over a strip of ego's width along ego's path, at more than 26 degrees to it, and
    ego reaches this place at 3 m/s or more. The time is the shortest over all steps at which the agent is there, 0 if
    ego is there, too. It applies to the steps from 2 s before the first of the two enters until the second does.
    """
    slots = bank.agents.shape[2]  # parked agents follow
    frame = log.frame
    box, valid, z, velocity = (leaf[:, :slots] for leaf in (frame.box, frame.valid, frame.z, frame.velocity))
    ego, steps = frame.box[:, log.slot], jnp.arange(len(frame.box))
    length, half_width = ego[0, 4], ego[0, 5] / 2
    level = jnp.abs(z - frame.z[:, log.slot, None]) <= queries.LEVEL_M
    included = valid & level & (norm(velocity) >= STOPPED_MPS) & ~log.ignored[:, :slots]
    included &= jnp.arange(slots) != log.slot
    first_m, last_m, cos = jax.vmap(jax.vmap(partial(_covered_interval, log, half_width)))(box, included)
    # Ego's front enters the area at the first of these steps, and its rear has left it at the second.
    enters = jnp.searchsorted(log.along_m + length / 2, first_m)
    leaves = jnp.searchsorted(log.along_m - length / 2, last_m, side="right")
    speed_mps = log.motion[jnp.minimum(enters, len(ego) - 1), 3]
    conflicts = (jnp.abs(cos) < _CROSSING_COS) & (enters < len(ego)) & (speed_mps >= _REACHES_MPS)
    step = steps[:, None]
    gap = jnp.maximum(jnp.maximum(enters - step, step - leaves), 0) * DT_S
    gap = jnp.where(conflicts, gap, jnp.inf)
    nearest, slot = jnp.argmin(gap, axis=0), jnp.arange(slots)
    begin = jnp.minimum(nearest, enters[nearest, slot]) - _BEFORE_STEPS
    end = jnp.maximum(nearest, enters[nearest, slot])
    return jnp.where((step >= begin) & (step <= end), gap[nearest, slot], jnp.inf).min(axis=1)


def _covered_interval(
    log: LoggedScenario, half_width: Float[Array, ""], box: Float[Array, "6"], included: Bool[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return first and last arc length (m) of ego's path under a box, and the cosine of the angle between path and box.

    Only the points within 16 m of the nearest one are considered. Without an overlap, or if the box is not
    ``included``, the first is infinite, and the cosine 1.
    """
    points, cos, sin = len(log.path), box[2], box[3]
    coarse = log.path[::_COARSE, RouteColumn.XY]
    is_path = jnp.arange(len(coarse)) * _COARSE < log.path_points
    distance = jnp.sum((coarse - box[:2]) ** 2, axis=-1)
    nearest = first_smallest(jnp.where(is_path, distance, jnp.inf)) * _COARSE
    size = min(_FINE, points)
    start = jnp.clip(nearest - size // 2, 0, points - size)
    path = jax.lax.dynamic_slice(log.path, (start, 0), (size, RouteColumn.LIMIT))
    offset, heading = path[:, RouteColumn.XY] - box[:2], path[:, RouteColumn.HEADING]
    ahead, left = offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin
    # The box grows by half of ego's width times the components of the path's normal along and across it.
    across = heading[:, 0] * cos + heading[:, 1] * sin
    along = heading[:, 1] * cos - heading[:, 0] * sin
    covers = jnp.abs(ahead) <= box[4] / 2 + half_width * jnp.abs(along)
    covers &= jnp.abs(left) <= box[5] / 2 + half_width * jnp.abs(across)
    point = start + jnp.arange(size)
    covers &= included & (point < log.path_points)
    first = jnp.min(jnp.where(covers, point, points))
    last = jnp.max(jnp.where(covers, point, -1))
    middle = jnp.max(jnp.where(covers & (point <= (first + last) // 2), point, -1)) - start
    angle = jnp.where(last >= 0, across[jnp.clip(middle, 0, size - 1)], 1.0)
    return jnp.where(last >= 0, first.astype(jnp.float32), jnp.inf), last.astype(jnp.float32), angle


def _required_braking(log: LoggedScenario) -> Float[Array, " T"]:
    def at_step(frame: Frame, ignored: Array, along_m: Array, speed: Array) -> Array:
        included = frame.valid & ~ignored & (jnp.arange(len(frame.valid)) != log.slot)
        return _braking_at_step(log, frame, included, along_m, speed)

    return jax.vmap(at_step)(log.frame, log.ignored, log.along_m, log.motion[:, 3])


def _braking_at_step(
    log: LoggedScenario, frame: Frame, included: Bool[Array, " S"], along_m: Float[Array, ""],
    speed_mps: Float[Array, ""],
) -> Float[Array, ""]:  # fmt: skip
    """Return the deceleration (m/s2) that avoids reaching the nearest agent on ego's path.

    Oncoming agents count as standing, so that ego need not brake while it stands. The result is 0 if no agent is on the
    path, or if ego does not approach it. A gap below 0.1 m, or an overlap, counts as 0.1 m.

    ``included`` masks the agents to consider; ``along_m`` is ego's arc length along the path.
    """
    gap, agent_mps = gaps_on_path(log, frame, included, along_m)
    nearest = jnp.argmin(gap)
    closing_mps = jnp.maximum(speed_mps - jnp.maximum(agent_mps[nearest], 0.0), 0.0)
    return closing_mps * closing_mps / (2.0 * jnp.maximum(gap[nearest], 0.1))


def gaps_on_path(
    log: LoggedScenario, frame: Frame, included: Bool[Array, " S"], along_m: Float[Array, ""]
) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
    """Return the gap (m) to each agent ahead on ego's path, infinite for others, and each agent's speed along it (m/s).

    An agent is on the path if its box overlaps a strip of ego's width along it, on ego's level, up to about 75 m ahead.
    """
    ego_box, xy = frame.box[log.slot], frame.box[:, :2]

    def project_at(offset_m: float) -> Any:
        centre_m = along_m + offset_m
        paths, points, first = log.path[None], log.path_points[None], jnp.int32(0)
        return jax.vmap(lambda point: queries.project_on_path(paths, points, first, point, centre_m))(xy)

    # Outside its window a projection is an end point, so use the nearer projection.
    near, far = map(project_at, _WINDOWS_M)
    use_near = near.distance_m <= far.distance_m
    projections = jax.tree.map(
        lambda a, b: jnp.where(use_near.reshape(-1, *(1,) * (a.ndim - 1)), a, b), near, far
    )
    cos = jnp.sum(frame.box[:, 2:4] * projections.heading, axis=-1)
    sin = jnp.sqrt(jnp.maximum(1.0 - cos * cos, 0.0))
    half_length, half_width = frame.box[:, 4] / 2, frame.box[:, 5] / 2
    included = included & (jnp.abs(frame.z - frame.z[log.slot]) <= queries.LEVEL_M)
    on_path = projections.distance_m < jnp.abs(sin) * half_length + jnp.abs(cos) * half_width + ego_box[5] / 2
    gap = projections.along_m - along_m - (jnp.abs(cos) * half_length + sin * half_width) - ego_box[4] / 2
    gap = jnp.where(included & on_path & (projections.along_m > along_m), gap, jnp.inf)
    return gap, jnp.sum(frame.velocity * projections.heading, axis=-1)


def crowding(log: LoggedScenario, crowd: int) -> Float[Array, " T"]:
    """Return the number of valid agents, ego included, relative to ``crowd``, at most 1."""
    return jnp.minimum(log.frame.valid.sum(axis=1) / crowd, 1.0)


def _volatility(config: KinematicConfig, log: LoggedScenario, last: Int[Array, ""]) -> Float[Array, " T"]:
    """Return the volatility of the action from each step to the next; the ``last`` step repeats the previous value.

    Jerk (from accelerations) and yaw acceleration (from headings) are derivatives of a polynomial fitted to 1.5 s.
    Noise of 1 cm/s in the speed changes the jerk by some hundredths of a m/s3.
    """
    speed, heading = log.motion[:, 3], log.motion[:, 2]
    valid = log.valid[1:] & log.valid[:-1]
    acceleration = (speed[1:] - speed[:-1]) / DT_S
    heading_change = jnp.concatenate([jnp.zeros(1), jnp.cumsum(wrap(heading[1:] - heading[:-1]))])
    jerk = _derivative(acceleration, valid, _JERK_ORDER, 1)
    # Average headings to the middle between two steps, where the jerk is, too.
    yaw_rps2 = _derivative((heading_change[1:] + heading_change[:-1]) / 2, valid, _YAW_ORDER, 2)
    share = jnp.maximum(jnp.abs(jerk) / config.full_jerk_mps3, jnp.abs(yaw_rps2) / config.full_yaw_rps2)
    share = jnp.minimum(share, 1.0)
    return jnp.concatenate([share, share[-1:]]).at[last].set(share[last - 1])


def _derivative(
    signal: Float[Array, " K"], valid: Bool[Array, " K"], order: int, derivative: int
) -> Float[Array, " K"]:
    """Differentiate a polynomial fitted to the valid window around each sample; 0 without a valid window."""
    sample = jnp.arange(len(signal))
    # First and last of the consecutive valid samples around each sample.
    first = jax.lax.cummax(jnp.where(valid, -1, sample)) + 1
    last = jax.lax.cummin(jnp.where(valid, len(signal), sample), reverse=True) - 1
    start = jnp.clip(sample - _WINDOW // 2, first, last - (_WINDOW - 1))
    window = signal[jnp.clip(start[:, None] + jnp.arange(_WINDOW), 0, len(signal) - 1)]
    # One filter per position in the window.
    filters = jnp.asarray(savgol_matrix(_WINDOW, _WINDOW, order, derivative), jnp.float32)
    value = jnp.sum(filters[sample - start] * window, axis=-1) / DT_S**derivative
    return jnp.where(valid & (last - first >= _WINDOW - 1), value, 0.0)


def _edge_nearness(config: KinematicConfig, bank: ScenarioBank, log: LoggedScenario) -> Float[Array, " T"]:
    def at_step(box: Array, ground: Array) -> Array:
        # A logged car whose side of the edges is unknown, as on a driveway or outside the map, is on the road.
        on_road = jnp.ones(4, bool)
        outside_m = queries.offroad_distance(bank, log.index, box[:2], corners(box), on_road, ground)
        return jnp.max(jnp.clip(1.0 + outside_m / config.edge_m, 0.0, 1.0))

    return jax.vmap(at_step)(log.frame.box[:, log.slot], log.ground_m)


def _lane_deviation(config: KinematicConfig, bank: ScenarioBank, log: LoggedScenario) -> Float[Array, " T"]:
    def at_step(xy: Array, ground: Array) -> Array:
        distance = queries.lane_distance(bank, log.index, xy, ground)
        # Infinite without a lane nearby: in a car park, on a driveway, outside the map.
        return jnp.where(jnp.isfinite(distance), jnp.minimum(distance / config.lane_m, 1.0), 0.0)

    return jax.vmap(at_step)(log.motion[:, :2], log.ground_m)


@dataclass(frozen=True)
class PublishedConfig:
    """The published kinematic heuristic, for comparison; its scales are defined as in :class:`KinematicConfig`.

    It uses backward differences at 10 Hz, the product of distance and closing speed, and distances to map points (of
    lanes, only those for cars). Noise of 1 cm/s scores like violent driving, and distant traffic like a conflict
    (``tests/curation/test_published.py``), which :class:`KinematicConfig` avoids.

    Attributes:
        jerk_mps3, yaw_rps2: Jerk, and yaw acceleration (rad/s2).
        interaction_m2ps: Product of distance and closing speed.
        edge_m: Distance of ego's centre to the nearest point of a road edge at which off_road is 0.
        lane_m: Distance to the nearest point of a lane centre.
        crowd: Number of agents, ego included.
        spacing_m: Spacing of the map points, sampled from our segments; 0.5 m as in Waymo's maps.
    """

    jerk_mps3: float = 2.5
    yaw_rps2: float = 1.5
    interaction_m2ps: float = 1000.0
    edge_m: float = 0.75
    lane_m: float = 1.25
    crowd: int = 50
    spacing_m: float = 0.5

    def __post_init__(self) -> None:
        check_positive(dict(vars(self)))

    def __call__(self, bank: ScenarioBank, log: LoggedScenario) -> dict[str, Float[Array, " T"]]:
        """Return the components of every step of a log."""
        distances = jax.vmap(lambda xy: queries.vertex_distances(bank, log.index, xy, self.spacing_m))
        edge_m, lane_m = distances(log.motion[:, :2])
        return {
            "volatility": _published_volatility(self, log),
            "interaction": _interaction(self, log),
            "off_road": jnp.maximum(1.0 - edge_m / self.edge_m, 0.0),
            "lane_deviation": jnp.minimum(lane_m / self.lane_m, 1.0),
            "density": crowding(log, self.crowd),
        }


def _published_volatility(config: PublishedConfig, log: LoggedScenario) -> Float[Array, " T"]:
    """Return the larger of scaled jerk and yaw acceleration, from backward differences that are 0 at the start."""
    heading = log.motion[:, 2]
    acceleration = _backward_difference(norm(log.velocity)) / DT_S
    yaw_rate = wrap(_backward_difference(heading)) / DT_S
    jerk, yaw_rps2 = _backward_difference(acceleration) / DT_S, _backward_difference(yaw_rate) / DT_S
    share = jnp.maximum(jnp.abs(jerk) / config.jerk_mps3, jnp.abs(yaw_rps2) / config.yaw_rps2)
    return jnp.minimum(share, 1.0)


def _backward_difference(values: Float[Array, " T"]) -> Float[Array, " T"]:
    return jnp.concatenate([jnp.zeros(1), values[1:] - values[:-1]])


def _interaction(config: PublishedConfig, log: LoggedScenario) -> Float[Array, " T"]:
    """Return the largest product of distance and closing speed, ``-dp . dv``, over its scale, within 0 and 1."""

    def at_step(frame: Frame, velocity: Array) -> Array:
        offset, relative_velocity = frame.box[:, :2] - frame.box[log.slot, :2], frame.velocity - velocity
        product = -jnp.sum(offset * relative_velocity, axis=-1)
        included = frame.valid & (jnp.arange(len(product)) != log.slot)
        return jnp.max(jnp.where(included, jnp.clip(product / config.interaction_m2ps, 0.0, 1.0), 0.0))

    return jax.vmap(at_step)(log.frame, log.velocity)
