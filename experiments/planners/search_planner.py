"""A planner that searches manoeuvres against predicted traffic, to measure how hard scenarios are to solve.

Run it as ``PYTHONPATH=experiments/planners drivax evaluate --planner search_planner:SearchPlanner ...``.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, corners, overlap
from drivax.scenario.bank.columns import AgentColumn, RouteColumn
from drivax.scenario.bank.queries import (
    LEVEL_M,
    OFFROAD_TOLERANCE_M,
    around_lanes,
    lane_course,
    left_of_edges,
    route_ahead,
)
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.ahead import STOP_SHORT_M, desired_speed, project, stop_line_m
from drivax.simulator.dynamics import GRIP_MPS2, pursuit
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.types import AgentContext, Frame, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical, action_of

#: Number and spacing (s) of prediction times; predictions along lanes use longer steps.
HORIZON, STEP_S = 20, 0.25
_LANE_STEPS, _LANE_STEP_S = 10, 0.5
#: Maximum number of agents to predict: the nearest.
_MAX_AGENTS = 20
#: Agents below this speed (m/s) are stationary; those above this cosine, within 45 degrees, go the same direction.
SLOW_MPS, SAME_DIRECTION = 1.0, 0.7
#: Steps to measure trends over; durations for which agents keep braking and turning, s.
_TREND_STEPS, _ACCELERATE_S, _TURN_S = 5, 1.0, 3.0
#: Duration (s) and maximum speed (m/s) of predicted acceleration.
_SPEED_UP_S, _USUAL_MPS = 2.0, 13.4
#: Agents that approach ego's path sideways at this speed (m/s), and reach it within this time (s), may stay in it.
_ENTER_MPS, _ENTER_S = 0.4, 2.5
#: Pedestrians that approach ego's path faster than this may start to run, at this speed, m/s.
_RUN_START_MPS, _RUN_MPS = 0.3, 2.0
#: Duration for which oncoming agents may swerve into ego's path, s.
_SWERVE_S = 0.3
#: Vehicles that cross faster than this leave ego's path again, m/s.
_CROSS_MPS = 4.5


@record
class Trend:
    """Change of the motion of all agents, smoothed over about half a second.

    Attributes:
        direction: Cosine and sine of the heading one step ago.
        speed: Speed then, m/s.
        valid: Whether the slot had an agent.
        turning: Yaw rate, rad/s.
        acceleration: Along the heading, m/s2.
        stood_s: Time at standstill, s.
    """

    direction: Float[Array, "S 2"]
    speed: Float[Array, " S"]
    valid: Bool[Array, " S"]
    turning: Float[Array, " S"]
    acceleration: Float[Array, " S"]
    stood_s: Float[Array, " S"]

    @classmethod
    def from_log(cls, bank: ScenarioBank, context: AgentContext) -> Trend:
        """Return the trend of the log over the last half second; parked agents are stationary."""
        now = bank.agents[context.index, context.step]
        past = bank.agents[context.index, jnp.maximum(context.step - _TREND_STEPS, 0)]
        defined = (
            (now[:, AgentColumn.VALID] > 0)
            & (past[:, AgentColumn.VALID] > 0)
            & (context.step >= _TREND_STEPS)
        )
        angle = _turn(past[:, AgentColumn.HEADING], now[:, AgentColumn.HEADING])
        speed_change = _length(now[:, AgentColumn.VELOCITY]) - _length(past[:, AgentColumn.VELOCITY])
        parked = bank.agent_box.shape[1] - len(now)

        def pad_parked(values: Array) -> Array:
            return jnp.pad(values, ((0, parked), *((0, 0),) * (values.ndim - 1)))

        return cls(
            pad_parked(now[:, AgentColumn.HEADING]),
            pad_parked(_length(now[:, AgentColumn.VELOCITY])),
            pad_parked(now[:, AgentColumn.VALID] > 0),
            pad_parked(jnp.where(defined, angle, 0.0) / (_TREND_STEPS * DT_S)),
            pad_parked(jnp.where(defined, speed_change, 0.0) / (_TREND_STEPS * DT_S)),
            pad_parked(jnp.zeros(now.shape[0])),
        )

    def update(self, frame: Frame) -> Trend:
        """Advance by one step."""
        direction, speed = frame.box[:, COS : SIN + 1], _length(frame.velocity)
        defined = frame.valid & self.valid

        def smooth(average: Array, change: Array) -> Array:
            return jnp.where(defined, average + (change / DT_S - average) / _TREND_STEPS, 0.0)

        turning = smooth(self.turning, _turn(self.direction, direction))
        acceleration = smooth(self.acceleration, speed - self.speed)
        stood_s = jnp.where(frame.valid & (speed < SLOW_MPS / 2), self.stood_s + DT_S, 0.0)
        return Trend(direction, speed, frame.valid, turning, acceleration, stood_s)


def _turn(last: Float[Array, "S 2"], direction: Float[Array, "S 2"]) -> Float[Array, " S"]:
    """Return the angle from one direction to another, rad."""
    cross = last[:, 0] * direction[:, 1] - last[:, 1] * direction[:, 0]
    return jnp.arctan2(cross, jnp.sum(last * direction, axis=-1))


@record
class Others:
    """The nearest agents with an expected and a possible prediction.

    Attributes:
        box: Predicted boxes at each time.
        entering_box: Predicted boxes if agents enter ego's path and stay there.
        may_enter: Mask of agents that may do so.
        speed: Predicted speeds, m/s.
        valid: Mask of agents.
        behind: Mask of agents that follow ego.
        stood_s: Time since each agent stopped, s.
        vehicle: Mask of vehicles.
        vulnerable: Mask of pedestrians and cyclists.
    """

    box: Float[Array, "H K 6"]
    entering_box: Float[Array, "H K 6"]
    may_enter: Bool[Array, " K"]
    speed: Float[Array, "H K"]
    valid: Bool[Array, " K"]
    behind: Bool[Array, " K"]
    stood_s: Float[Array, " K"]
    vehicle: Bool[Array, " K"]
    vulnerable: Bool[Array, " K"]

    @classmethod
    def nearest(
        cls,
        bank: ScenarioBank,
        context: AgentContext,
        frame: Frame,
        trend: Trend,
        route: tuple[Array, Array, Array],
    ) -> Others:
        """Select the nearest agents on ego's level, and predict them.

        Args:
            bank: The scenarios.
            context: Ego's context.
            frame: All agents.
            trend: Change of their motion.
            route: Points of ego's route ahead, a mask of those that exist, and their offsets in m.
        """
        ego_box = frame.box[context.slot]
        offset = frame.box[:, :2] - ego_box[:2]
        valid = frame.valid & (jnp.arange(frame.valid.shape[0]) != context.slot)
        valid &= jnp.abs(frame.z - frame.z[context.slot]) <= LEVEL_M
        # Approaching agents rank as nearer.
        closing = jnp.sum(offset * frame.velocity, axis=-1) / jnp.maximum(_length(offset), 1.0)
        priority = jnp.where(valid, _length(offset) + 2.0 * jnp.minimum(closing, 0.0), 1e6)
        _, rows = jax.lax.top_k(-priority, min(_MAX_AGENTS, priority.shape[0]))
        box, velocity, kind = frame.box[rows], frame.velocity[rows], frame.kind[rows]
        ahead = offset[rows, 0] * ego_box[COS] + offset[rows, 1] * ego_box[SIN]
        lateral = offset[rows, 1] * ego_box[COS] - offset[rows, 0] * ego_box[SIN]
        same_direction = box[:, COS] * ego_box[COS] + box[:, SIN] * ego_box[SIN] > SAME_DIRECTION
        pedestrian = kind == AgentKind.PEDESTRIAN
        # Pedestrians change direction within a step.
        box = box.at[:, LENGTH : WIDTH + 1].add(jnp.where(pedestrian, 0.4, 0.0)[:, None])
        is_driving = ~pedestrian & (_length(velocity) > 2.0 * SLOW_MPS)
        turning = jnp.where(is_driving, jnp.clip(trend.turning[rows], -0.8, 0.8), 0.0)
        acceleration = jnp.where(pedestrian, 0.0, jnp.clip(trend.acceleration[rows], -8.0, 3.0))
        free_boxes, speed = extrapolate(box, velocity, turning, acceleration)
        vehicle = kind == AgentKind.VEHICLE
        lane_boxes, on_lane = _predict_along_lanes(bank, context, box, speed, turning)
        on_lane &= vehicle & is_driving
        entering_boxes, may_enter, surely_enters = _predict_entering(
            box, velocity, speed, route, ego_box, pedestrian
        )
        may_enter &= ~vehicle | (_length(velocity) < _CROSS_MPS) | same_direction
        cyclist = kind == AgentKind.CYCLIST
        oncoming = box[:, COS] * ego_box[COS] + box[:, SIN] * ego_box[SIN] < -SAME_DIRECTION
        surely_enters &= may_enter & is_driving & ((vehicle & same_direction) | (cyclist & oncoming))
        boxes = _select(surely_enters, entering_boxes, _select(on_lane, lane_boxes, free_boxes))
        behind = same_direction & (ahead < -ego_box[LENGTH] / 2) & (jnp.abs(lateral) < ego_box[WIDTH])
        vulnerable = pedestrian | cyclist
        return cls(
            boxes, entering_boxes, may_enter & valid[rows], speed, valid[rows], behind, trend.stood_s[rows], vehicle,
            vulnerable,
        )  # fmt: skip


def _select(mask: Bool[Array, " K"], values: Array, otherwise: Array) -> Array:
    return jnp.where(mask[:, None], values, otherwise)


def extrapolate(
    box: Float[Array, "K 6"], velocity: Float[Array, "K 2"], turning: Float[Array, " K"],
    acceleration: Float[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Float[Array, "H K"]]:  # fmt: skip
    """Predict boxes and speeds with a constant yaw rate and acceleration for a limited time, without reversing."""
    times = prediction_times()[:, None]
    start_speed = _length(velocity)
    duration = jnp.minimum(times, jnp.where(acceleration > 0.0, _SPEED_UP_S, _ACCELERATE_S))
    speed = start_speed + acceleration * duration
    speed = jnp.clip(speed, 0.0, jnp.maximum(start_speed, _USUAL_MPS))
    angle = turning * jnp.minimum(times, _TURN_S)
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def rotate(vector: Array) -> Array:
        x, y = vector[:, 0], vector[:, 1]
        return jnp.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)

    course = rotate(velocity / jnp.maximum(start_speed, 1e-3)[:, None])
    # Stationary agents start in the direction of their heading.
    course = jnp.where((start_speed > 0.1)[:, None], course, rotate(box[:, COS : SIN + 1]))
    xy = box[:, :2] + jnp.cumsum(speed[..., None] * course, axis=0) * STEP_S
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([xy, rotate(box[:, COS : SIN + 1]), size], axis=-1), speed


def _predict_along_lanes(
    bank: ScenarioBank, context: AgentContext, box: Float[Array, "K 6"], speed: Float[Array, "H K"],
    turning: Float[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Bool[Array, " K"]]:  # fmt: skip
    """Predict boxes of agents that follow their lane, with a mask of agents on a lane."""
    distances = speed.reshape(_LANE_STEPS, -1, speed.shape[1]).mean(axis=1) * _LANE_STEP_S

    def follow_lane(start: Array, distance: Array, yaw_rate: Array) -> tuple[Array, Array]:
        def step(carry: tuple[Array, Array], inputs: tuple[Array, Array]) -> Any:
            xy, heading = carry
            distance, turn = inputs
            cos, sin = jnp.cos(turn), jnp.sin(turn)
            direction = jnp.stack([heading[0] * cos - heading[1] * sin, heading[0] * sin + heading[1] * cos])
            lane, left, on_lane = lane_course(
                bank, context.index, xy + direction * distance / 2, direction, context.z
            )
            correction = jnp.clip(-left / jnp.maximum(3.0 * distance, 4.0), -0.4, 0.4)
            course = lane + correction * jnp.stack([-lane[1], lane[0]])
            heading = jnp.where(on_lane, course / _length(course), direction)
            xy = xy + heading * distance
            return (xy, heading), (jnp.concatenate([xy, heading]), on_lane)

        turns = jnp.where(jnp.arange(_LANE_STEPS) < 2, yaw_rate * _LANE_STEP_S / 2, 0.0)
        _, (poses, on_lane) = jax.lax.scan(step, (start[:2], start[2:4]), (distance, turns))
        poses = jnp.concatenate([start[None, :4], poses])
        middle = (poses[:-1] + poses[1:]) / 2
        return jnp.stack([middle, poses[1:]], axis=1).reshape(-1, 4), on_lane[0]

    poses, on_lane = jax.vmap(follow_lane, in_axes=(0, 1, 0), out_axes=(1, 0))(box, distances, turning)
    heading = poses[..., 2:] / jnp.maximum(_length(poses[..., 2:]), 1e-3)[..., None]
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([poses[..., :2], heading, size], axis=-1), on_lane


def _predict_entering(
    box: Float[Array, "K 6"], velocity: Float[Array, "K 2"], speed: Float[Array, "H K"],
    route: tuple[Array, Array, Array], ego_box: Float[Array, " 6"], pedestrian: Bool[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Bool[Array, " K"], Bool[Array, " K"]]:  # fmt: skip
    """Predict boxes of agents that enter ego's path and stay, with masks of agents that may and surely will."""
    path, exists, offsets = route
    along, lateral, cos, sin = project(path, exists, offsets, box[:, :2], velocity)
    toward = -jnp.sign(lateral) * sin
    toward = jnp.where(pedestrian & (toward > _RUN_START_MPS), jnp.maximum(toward, _RUN_MPS), toward)
    _, _, straight, across = project(path, exists, offsets, box[:, :2], box[:, COS : SIN + 1])
    half = (jnp.abs(across) * box[:, LENGTH] + jnp.abs(straight) * box[:, WIDTH]) / 2
    gap = jnp.abs(lateral) - half - ego_box[WIDTH] / 2
    may_enter = (toward > _ENTER_MPS) & (gap < _ENTER_S * toward) & (along > -2.0) & jnp.isfinite(lateral)
    surely_enters = may_enter & (gap < 1.5 * toward) & (toward > 2.0 * _ENTER_MPS)
    times = prediction_times()[:, None]
    share = speed / jnp.maximum(_length(velocity), 0.1)
    forward = jnp.cumsum(cos * share, axis=0) * STEP_S
    # Oncoming agents swerve for a short time, and then continue along the path.
    swerve_s = jnp.where(cos < -SAME_DIRECTION * _length(velocity), jnp.minimum(times, _SWERVE_S), times)
    left = jnp.sign(lateral) * jnp.maximum(jnp.abs(lateral) - toward * swerve_s, 0.0)
    left = jnp.where(may_enter, left, 0.0)
    row = at(path, offsets, along + forward)
    xy = row[..., :2] + left[..., None] * jnp.stack([-row[..., 3], row[..., 2]], axis=-1)
    is_parallel = jnp.abs(cos) > jnp.abs(sin)
    direction = jnp.sign(cos)[:, None] * row[..., 2:4]
    facing = jnp.where(is_parallel[:, None], direction, box[:, COS : SIN + 1])
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([xy, facing, size], axis=-1), may_enter, surely_enters


def at(line: Float[Array, "P 7"], offsets: Float[Array, " P"], distance: Array) -> Array:
    """Interpolate x, y, cos, sin at arc lengths along a line of evenly spaced points."""
    index = distance / (offsets[1] - offsets[0])
    lower = jnp.clip(index.astype(jnp.int32), 0, line.shape[0] - 2)
    fraction = jnp.clip(index - lower, 0.0, 1.0)[..., None]
    point = line[lower] * (1.0 - fraction) + line[lower + 1] * fraction
    return jnp.concatenate([point[..., :2], point[..., 3:5]], axis=-1)


def _length(vector: Float[Array, "... 2"]) -> Float[Array, ...]:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def prediction_times() -> Float[Array, " H"]:
    """Return the prediction times, s."""
    return (jnp.arange(HORIZON) + 1.0) * STEP_S


#: Lateral target offsets from the route, m, and maximum accelerations, m/s2.
_SHIFTS = (0.0, -1.2, 1.2, -2.4, 2.4, -3.5, 3.5)
_CAPS = (2.0, 0.0, -1.5, -3.0, -6.0, 2.0)
#: Factors on the desired speed, one per maximum acceleration: the last one hurries past conflicts.
_SPEED_FACTORS = (1.0, 1.0, 1.0, 1.0, 1.0, 1.4)
#: Points along the route and their spacing, m.
_POINTS, _STEP_M = 46, 2.0
#: Lateral acceleration of a shift, m/s2.
_LATERAL_MPS2 = 3.5
#: Space ahead of and next to the car: too small, enough, and enough for uncertain agents, m.
_TIGHT_M, _FREE_M, _POSSIBLE_M = (0.1, 0.1), (0.6, 0.5), (0.6, 0.3)
#: Maximum shift within the lane, m.
_LANE_M = 2.0
#: An agent blocks the road after this time at standstill (s), unless a queue or a red light is this close ahead (m).
_BLOCKED_S, _QUEUE_M, _LIGHT_M = 2.5, 14.0, 60.0
#: Uncertainty of crossing agents: in time, s; in distance per squared prediction time, m/s2; maximum, m.
_EARLY_S, _EARLY_MPS2, _EARLY_M = 0.25, 0.2, 6.0
#: Extra lateral space for pedestrians and cyclists, m.
_VULNERABLE_SPACE_M = 0.6
#: Costs of a collision: basic, extra for an immediate one, factor for one from behind, and of a possible collision;
#: costs of leaving the road, of leaving the lanes in ego's direction, and of passing closely.
_COLLISION, _EARLY_COLLISION, _REAR_FACTOR, _POSSIBLE, _OFFROAD, _WRONG_LANE, _CLOSE = (
    60.0,
    100.0,
    0.3,
    40.0,
    50.0,
    30.0,
    4.0,
)
#: Costs of cutting off a crossing agent: basic, and extra if it lasts; cost of hurrying.
_CUT, _CUT_SHARE, _HURRY = 10.0, 30.0, 4.0
#: Reward per metre of progress; costs per metre of offset and of shift, of leaving the lane except to pass a blocking
#: agent, and per squared m/s2 of braking.
_PROGRESS, _OFFSET, _SHIFT, _LEAVE_LANE, _BRAKING = 0.2, 0.8, 0.2, 6.0, 0.05


@record
class SearchPlanner:
    """Choose among 42 manoeuvres along the route from the true current state.

    A manoeuvre has a target offset and a maximum acceleration, below which the car follows its leader by IDM; the last
    acceleration comes with a higher speed, to clear conflicts. Each manoeuvre is simulated for 5 s with the car's own
    dynamics and steering law. Its cost counts collisions (the sooner, the more), cutting off agents that may arrive
    earlier or later, leaving the road or its lanes, passing closely, lost progress and braking.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(
        default=IdmParameters(headway_s=1.2, acceleration_mps2=2.0, comfortable_braking_mps2=2.5)
    )
    name: str = static(default="search")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Trend:
        """Return the motion trend of the half second before the start."""
        return Trend.from_log(bank, state.context)

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:
        """Return the first step of the cheapest manoeuvre."""
        context, frame = situation.context, situation.surroundings.frame
        ego_box, speed = frame.box[context.slot], context.history[-1, 3]
        offsets = jnp.arange(_POINTS) * _STEP_M
        path, exists = route_ahead(bank, context.row, context.route_m, offsets)
        desired_mps = jnp.where(exists[1], desired_speed(path, exists, offsets), 0.0)
        stop_m = stop_line_m(bank, context, frame)
        trend = carry.update(frame)
        others = Others.nearest(bank, context, frame, trend, (path, exists, offsets))
        lateral = jnp.clip(situation.surroundings.route.lateral_m, -5.0, 5.0)
        is_blocked = _is_blocked(path, exists, offsets, others, ego_box, stop_m)

        def line_costs(shift: Array) -> tuple[Array, Array]:
            line = _shifted_line(path, offsets, lateral, shift, ego_box, speed)
            poses, distance, first_controls = self._drive_line(
                line, exists, offsets, others, (ego_box, speed, desired_mps, stop_m)
            )
            cost = jax.vmap(lambda poses: _collision_cost(poses, ego_box, others))(poses)
            offroad, wrong_lane = _road_violations(bank, situation, poses[0], (line, exists), ego_box)
            wrong_lane_price = jnp.where(is_blocked, 0.1, 1.0) * _WRONG_LANE
            cost += _OFFROAD * ((offroad > 0.0) + offroad) + (shift != 0.0) * wrong_lane * wrong_lane_price
            cost += (jnp.abs(shift) > _LANE_M) * ~is_blocked * _LEAVE_LANE
            cost += _OFFSET * jnp.abs(shift) + _SHIFT * jnp.abs(shift - lateral)
            cost += _HURRY * (jnp.asarray(_SPEED_FACTORS) > 1.0)
            cost += _BRAKING * jnp.minimum(first_controls[:, 0], 0.0) ** 2 - _PROGRESS * distance
            return cost, first_controls

        costs, controls = jax.vmap(line_costs)(jnp.asarray(_SHIFTS))
        best = controls.reshape(-1, 2)[jnp.argmin(costs)]
        return action_of(self.actions, bank, context, best[0], best[1]), trend

    def _drive_line(
        self, line: Array, exists: Array, offsets: Array, others: Others, ego: tuple[Array, ...]
    ) -> tuple[Float[Array, "C H 4"], Float[Array, " C"], Float[Array, "C 2"]]:
        """Simulate each cap along a line; return poses, travelled distances, and first acceleration and curvature."""
        ego_box, start_mps, desired_mps, stop_m = ego
        max_curvature = self.actions.max_curvature(ego_box[LENGTH])
        rear, leader_speed = jax.vmap(
            lambda agents: _agents_in_corridor(line, exists, offsets, others, agents, ego_box)
        )((others.box, others.speed))
        route_end_m = jnp.sum(exists) * _STEP_M

        def drive_with_cap(cap: Array, speed_factor: Array) -> tuple[Array, Array, Array]:
            target_mps = desired_mps * speed_factor

            def step(carry: tuple[Array, ...], agents: tuple[Array, Array]) -> Any:
                pose, travelled_m, v = carry
                rear, leader = agents
                gaps = jnp.where(rear > travelled_m, rear - travelled_m, jnp.inf) - ego_box[LENGTH] / 2
                nearest = jnp.argmin(gaps)
                line_gap = stop_m - travelled_m + self.parameters.min_gap_m - STOP_SHORT_M
                gap = jnp.minimum(gaps[nearest], line_gap)
                gap = jnp.where(jnp.isfinite(gap), gap, 1e4)
                leader_v = jnp.where(line_gap < gaps[nearest], 0.0, leader[nearest])
                a = jnp.minimum(idm_acceleration(v, target_mps, gap, leader_v, self.parameters), cap)
                target_m = jnp.minimum(travelled_m + jnp.clip(0.5 * v + 2.5, 3.0, 14.0), route_end_m)
                k = pursuit(pose, at(line, offsets, target_m)[:2] - pose[:2])
                grip = jnp.minimum(GRIP_MPS2 / jnp.maximum(v * v, 1e-3), max_curvature)
                k = jnp.clip(k, -grip, grip)
                next_v = jnp.maximum(v + a * STEP_S, 0.0)
                step_m = (v + next_v) / 2 * STEP_S
                pose = advance(pose, k, step_m)
                return (pose, travelled_m + step_m, next_v), (pose, a, k)

            _, (pose, a, k) = jax.lax.scan(
                step, (ego_box[:4], jnp.zeros(()), start_mps), (rear, leader_speed)
            )
            distance_m = jnp.sum(jnp.sqrt(jnp.sum((pose[1:, :2] - pose[:-1, :2]) ** 2, -1)))
            return pose, distance_m, jnp.stack([a[0], k[0]])

        return jax.vmap(drive_with_cap)(jnp.asarray(_CAPS), jnp.asarray(_SPEED_FACTORS))


def advance(pose: Float[Array, " 4"], curvature: Array, distance: Array) -> Float[Array, " 4"]:
    """Advance x, y, cos, sin by a distance at a curvature, like the kinematic bicycle."""

    def rotate(cos: Array, sin: Array) -> Float[Array, " 2"]:
        c, s = jnp.cos(curvature * distance / 2), jnp.sin(curvature * distance / 2)
        return jnp.stack([cos * c - sin * s, sin * c + cos * s])

    mean_direction = rotate(pose[2], pose[3])
    return jnp.concatenate(
        [pose[:2] + distance * mean_direction, rotate(mean_direction[0], mean_direction[1])]
    )


def _shifted_line(
    path: Float[Array, "P 7"],
    offsets: Float[Array, " P"],
    lateral: Array,
    shift: Array,
    ego_box: Array,
    speed: Array,
) -> Float[Array, "P 7"]:
    """Shift the route from the car's current ``lateral`` offset (m) and heading to the target offset ``shift`` (m).

    The shift by d is a cubic over a time T of 1 to 2.5 s, if possible with at most 3.5 m/s2 of lateral acceleration,
    which is 6 d / T^2.
    """
    cos, sin = path[:, RouteColumn.COS], path[:, RouteColumn.SIN]
    forward, left = (
        ego_box[COS] * cos[0] + ego_box[SIN] * sin[0],
        ego_box[SIN] * cos[0] - ego_box[COS] * sin[0],
    )
    slope = jnp.clip(left / jnp.maximum(forward, 0.3), -0.5, 0.5)
    duration_s = jnp.clip(jnp.sqrt(6.0 * jnp.abs(shift - lateral) / _LATERAL_MPS2), 1.0, 2.5)
    length = jnp.clip(duration_s * speed, 6.0, 40.0)
    u = jnp.clip(offsets / length, 0.0, 1.0)
    d = lateral + (shift - lateral) * u * u * (3.0 - 2.0 * u) + slope * length * u * (1.0 - u) ** 2
    slopes = (shift - lateral) * 6.0 * u * (1.0 - u) / length + slope * (1.0 - u) * (1.0 - 3.0 * u)
    norm = jnp.sqrt(1.0 + slopes * slopes)
    headings = jnp.stack([(cos - sin * slopes) / norm, (sin + cos * slopes) / norm], axis=-1)
    xy = path[:, RouteColumn.XY] + d[:, None] * jnp.stack([-sin, cos], axis=-1)
    return path.at[:, RouteColumn.XY].set(xy).at[:, RouteColumn.HEADING].set(headings)


def _agents_in_corridor(
    line: Array, exists: Array, offsets: Array, others: Others, agents: tuple[Array, Array], ego_box: Array
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Return the rear positions of agents in a line's corridor (else infinite), and their speeds."""
    box, speed = agents
    along, lateral, cos, sin = project(line, exists, offsets, box[:, :2], box[:, COS : SIN + 1])
    half_length = (jnp.abs(cos) * box[:, LENGTH] + jnp.abs(sin) * box[:, WIDTH]) / 2
    half_width = (jnp.abs(sin) * box[:, LENGTH] + jnp.abs(cos) * box[:, WIDTH]) / 2
    in_corridor = others.valid & ((cos > SAME_DIRECTION) | (speed < SLOW_MPS)) & ~others.behind
    in_corridor &= jnp.abs(lateral) < half_width + ego_box[WIDTH] / 2 + _TIGHT_M[1] + 0.1
    return jnp.where(in_corridor, along - half_length, jnp.inf), speed * cos


def _is_blocked(
    path: Array, exists: Array, offsets: Array, others: Others, ego_box: Array, stop_m: Array
) -> Bool[Array, ""]:
    """Return whether the next agent on the route is stationary and may be passed."""
    along, lateral, cos, sin = project(
        path, exists, offsets, others.box[0, :, :2], others.box[0, :, COS : SIN + 1]
    )
    half_width = (jnp.abs(sin) * others.box[0, :, LENGTH] + jnp.abs(cos) * others.box[0, :, WIDTH]) / 2
    on_route = others.valid & (jnp.abs(lateral) < half_width + ego_box[WIDTH] / 2 + 0.2) & (along > 0.0)
    distances = jnp.where(on_route, along, jnp.inf)
    first = jnp.argmin(distances)
    queue = (
        on_route & others.vehicle & (distances > distances[first]) & (distances < distances[first] + _QUEUE_M)
    ).any()
    stationary = (others.stood_s[first] >= _BLOCKED_S) | (
        ~others.vehicle[first] & (others.speed[0, first] < SLOW_MPS)
    )
    return (
        stationary & ~(queue & others.vehicle[first]) & (stop_m > _LIGHT_M) & jnp.isfinite(distances[first])
    )


def _collision_cost(pose: Float[Array, "H 4"], ego_box: Array, others: Others) -> Array:
    """Return the cost of predicted, possible and near collisions of a manoeuvre."""

    def overlaps(boxes: Array, margin: tuple[float, float]) -> Bool[Array, "H K"]:
        size = jnp.broadcast_to(ego_box[LENGTH:] + 2.0 * jnp.asarray(margin), (HORIZON, 2))
        return overlap(jnp.concatenate([pose, size], -1)[:, None], boxes) & others.valid

    def earliness(hits: Bool[Array, "H K"]) -> Float[Array, " K"]:
        return jnp.where(hits.any(axis=0), 1.0 - jnp.argmax(hits, axis=0) / HORIZON, 0.0)

    hit_earliness = earliness(overlaps(others.box, _TIGHT_M))
    price = jnp.where(hit_earliness > 0.0, _COLLISION + _EARLY_COLLISION * hit_earliness, 0.0)
    possible_hits = overlaps(others.entering_box, _POSSIBLE_M) & others.may_enter
    price = jnp.maximum(price, _POSSIBLE * earliness(possible_hits))
    worst = jnp.max(price * jnp.where(others.behind, _REAR_FACTOR, 1.0))
    # Agents that cross or enter ego's path may arrive earlier or later.
    cos = jnp.einsum("hi,hki->hk", pose[:, 2:4], others.box[..., COS : SIN + 1])
    crosses = ((cos < SAME_DIRECTION) | others.may_enter) & (others.speed > SLOW_MPS) & others.vehicle
    times = prediction_times()[:, None]
    early_m = jnp.minimum(_EARLY_S * others.speed + _EARLY_MPS2 * times * times, _EARLY_M)
    inflated = others.box.at[..., LENGTH].add(jnp.where(crosses, 2.0 * early_m, 0.0))
    inflated = inflated.at[..., WIDTH].add(jnp.where(others.vulnerable, 2.0 * _VULNERABLE_SPACE_M, 0.0))
    near = overlaps(inflated, _FREE_M) & ~others.behind
    cut = (near & crosses).any(axis=1)
    worst += jnp.where(cut.any(), _CUT, 0.0) + _CUT_SHARE * jnp.mean(cut)
    return worst + _CLOSE * jnp.mean((near & ~crosses).any(axis=1))


def _road_violations(
    bank: ScenarioBank,
    situation: Situation,
    pose: Float[Array, "H 4"],
    line: tuple[Array, Array],
    ego_box: Array,
) -> tuple[Array, Array]:
    """Return the off-road share of the next 3 s, and whether a line leaves the lanes in its direction."""
    context = situation.context
    ground = context.z - bank.height_m(context.index, context.slot) / 2

    def is_offroad(car_pose: Array) -> Array:
        box = jnp.concatenate([car_pose, ego_box[LENGTH:]])
        left, known = left_of_edges(bank, context.index, box[:2], corners(box), ground)
        return (known & (left < -OFFROAD_TOLERANCE_M / 2)).any()

    def leaves_lanes(point: Array) -> Array:
        pose = (point[:2], point[3:5], point[None, :2])
        return around_lanes(bank, context.index, *pose, context.z, row=context.row).straddling

    sample = slice(4, 17, 4)
    return jnp.mean(jax.vmap(is_offroad)(pose[1:12:2])), (
        jax.vmap(leaves_lanes)(line[0][sample]) & line[1][sample]
    ).any()
