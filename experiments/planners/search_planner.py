"""A planner that searches manoeuvres against predicted traffic; it shows how hard scenarios are for a careful driver.

Run it as ``PYTHONPATH=experiments/planners drivax evaluate --planner search_planner:SearchPlanner ...``.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, corners, overlap
from drivax.planners.simple import pursuit
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
from drivax.simulator.dynamics import GRIP_MPS2
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.types import AgentContext, Frame, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical

#: Times at which others are predicted: how many, and how far apart, s; lanes are followed in longer steps.
HORIZON, STEP_S = 20, 0.25
_LANE_STEPS, _LANE_STEP_S = 10, 0.5
#: Others that are looked at: the nearest.
_OTHERS = 20
#: Who is slower stands, m/s; who heads the same way within 45 degrees goes along.
SLOW_MPS, SAME_WAY = 1.0, 0.7
#: Steps over which trends are measured; how long others are expected to accelerate and to turn, s.
_PAST, _ACCELERATES_S, _TURNS_S = 5, 1.0, 3.0
#: For how long, s, and up to which speed, m/s, who accelerates goes on to do so.
_SPEEDS_UP_S, _USUAL_MPS = 2.0, 13.4
#: Who moves sideways towards ego's way this fast, m/s, and gets there this soon, s, may stay in it.
_ENTERS_MPS, _ENTERS_S = 0.4, 2.5
#: People who walk towards ego's way faster than this may run, at this speed, m/s.
_STARTS_MPS, _RUNS_MPS = 0.3, 2.0
#: For how long who comes the other way may swerve into ego's, s.
_SWERVES_S = 0.3
#: Who crosses faster than this is expected to cross, m/s.
_CROSSES_MPS = 4.5


@record
class Trend:
    """Change of the motion of all agents, smoothed over about half a second.

    Attributes:
        direction: Cosine and sine of the heading one step ago.
        speed: Speed then, m/s.
        valid: Whether the slot had an agent.
        turning: Yaw rate, rad/s.
        acceleration: Along the heading, m/s2.
        stood_s: How long the agent has stood, s.
    """

    direction: Float[Array, "S 2"]
    speed: Float[Array, " S"]
    valid: Bool[Array, " S"]
    turning: Float[Array, " S"]
    acceleration: Float[Array, " S"]
    stood_s: Float[Array, " S"]

    @classmethod
    def logged(cls, bank: ScenarioBank, context: AgentContext) -> Trend:
        """Build from the log's current step and half a second before; parked agents are stationary."""
        now = bank.agents[context.index, context.step]
        before = bank.agents[context.index, jnp.maximum(context.step - _PAST, 0)]
        known = (now[:, AgentColumn.VALID] > 0) & (before[:, AgentColumn.VALID] > 0) & (context.step >= _PAST)
        turn = _turn(before[:, AgentColumn.HEADING], now[:, AgentColumn.HEADING])
        faster = _length(now[:, AgentColumn.VELOCITY]) - _length(before[:, AgentColumn.VELOCITY])
        parked = bank.agent_box.shape[1] - len(now)

        def whole(moving: Array) -> Array:
            return jnp.pad(moving, ((0, parked), *((0, 0),) * (moving.ndim - 1)))

        return cls(
            whole(now[:, AgentColumn.HEADING]),
            whole(_length(now[:, AgentColumn.VELOCITY])),
            whole(now[:, AgentColumn.VALID] > 0),
            whole(jnp.where(known, turn, 0.0) / (_PAST * DT_S)),
            whole(jnp.where(known, faster, 0.0) / (_PAST * DT_S)),
            whole(jnp.zeros(now.shape[0])),
        )

    def updated(self, frame: Frame) -> Trend:
        """Advance by one step."""
        direction, speed = frame.box[:, COS : SIN + 1], _length(frame.velocity)
        known = frame.valid & self.valid

        def smoothed(old: Array, change: Array) -> Array:
            return jnp.where(known, old + (change / DT_S - old) / _PAST, 0.0)

        turning = smoothed(self.turning, _turn(self.direction, direction))
        acceleration = smoothed(self.acceleration, speed - self.speed)
        stood_s = jnp.where(frame.valid & (speed < SLOW_MPS / 2), self.stood_s + DT_S, 0.0)
        return Trend(direction, speed, frame.valid, turning, acceleration, stood_s)


def _turn(before: Float[Array, "S 2"], now: Float[Array, "S 2"]) -> Float[Array, " S"]:
    """Angle from one direction to another, rad."""
    cross = before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]
    return jnp.arctan2(cross, jnp.sum(before * now, axis=-1))


@record
class Others:
    """The nearest agents, predicted in two ways.

    Attributes:
        box: Predicted boxes at each time.
        maybe: Boxes of agents that may enter ego's path and stay there.
        enters: Mask of these agents.
        speed: Predicted speeds, m/s.
        valid: Mask of agents.
        behind: Mask of agents that follow ego.
        stood_s: Time since each agent stopped, s.
        vehicle: Mask of vehicles.
        vulnerable: Mask of pedestrians and cyclists.
    """

    box: Float[Array, "H K 6"]
    maybe: Float[Array, "H K 6"]
    enters: Bool[Array, " K"]
    speed: Float[Array, "H K"]
    valid: Bool[Array, " K"]
    behind: Bool[Array, " K"]
    stood_s: Float[Array, " K"]
    vehicle: Bool[Array, " K"]
    vulnerable: Bool[Array, " K"]

    @classmethod
    def near(
        cls,
        bank: ScenarioBank,
        context: AgentContext,
        frame: Frame,
        trend: Trend,
        route: tuple[Array, Array, Array],
    ) -> Others:
        """Select the agents on ego's level.

        Args:
            bank: The scenarios.
            context: Ego's context.
            frame: All agents.
            trend: Change of their motion.
            route: Ego's route: points ahead, whether they exist, their offsets in m.
        """
        me = frame.box[context.slot]
        apart = frame.box[:, :2] - me[:2]
        valid = frame.valid & (jnp.arange(frame.valid.shape[0]) != context.slot)
        valid &= jnp.abs(frame.z - frame.z[context.slot]) <= LEVEL_M
        # What comes nearer counts as nearer.
        closing = jnp.sum(apart * frame.velocity, axis=-1) / jnp.maximum(_length(apart), 1.0)
        rank = jnp.where(valid, _length(apart) + 2.0 * jnp.minimum(closing, 0.0), 1e6)
        _, rows = jax.lax.top_k(-rank, min(_OTHERS, rank.shape[0]))
        box, velocity, kind = frame.box[rows], frame.velocity[rows], frame.kind[rows]
        ahead = apart[rows, 0] * me[COS] + apart[rows, 1] * me[SIN]
        aside = apart[rows, 1] * me[COS] - apart[rows, 0] * me[SIN]
        follows = box[:, COS] * me[COS] + box[:, SIN] * me[SIN] > SAME_WAY
        people = kind == AgentKind.PEDESTRIAN
        # People change their mind within a step.
        box = box.at[:, LENGTH : WIDTH + 1].add(jnp.where(people, 0.4, 0.0)[:, None])
        drives = ~people & (_length(velocity) > 2.0 * SLOW_MPS)
        turning = jnp.where(drives, jnp.clip(trend.turning[rows], -0.8, 0.8), 0.0)
        faster = jnp.where(people, 0.0, jnp.clip(trend.acceleration[rows], -8.0, 3.0))
        free, speed = rolled_out(box, velocity, turning, faster)
        vehicle = kind == AgentKind.VEHICLE
        lane, on_lane = _along_lanes(bank, context, box, speed, turning)
        on_lane &= vehicle & drives
        entering, may, sure = _entering(box, velocity, speed, route, me, people)
        may &= ~vehicle | (_length(velocity) < _CROSSES_MPS) | follows
        rider = kind == AgentKind.CYCLIST
        comes = box[:, COS] * me[COS] + box[:, SIN] * me[SIN] < -SAME_WAY
        sure &= may & drives & ((vehicle & follows) | (rider & comes))
        expected = _chosen(sure, entering, _chosen(on_lane, lane, free))
        behind = follows & (ahead < -me[LENGTH] / 2) & (jnp.abs(aside) < me[WIDTH])
        vulnerable = people | rider
        return cls(
            expected, entering, may & valid[rows], speed, valid[rows], behind, trend.stood_s[rows], vehicle,
            vulnerable,
        )  # fmt: skip


def _chosen(one: Bool[Array, " K"], then: Array, otherwise: Array) -> Array:
    return jnp.where(one[:, None], then, otherwise)


def rolled_out(
    box: Float[Array, "K 6"], velocity: Float[Array, "K 2"], turning: Float[Array, " K"],
    faster: Float[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Float[Array, "H K"]]:  # fmt: skip
    """Predict boxes and speeds at each time: constant yaw rate, acceleration for a second, no reversing."""
    times = prediction_times()[:, None]
    start = _length(velocity)
    longer = jnp.minimum(times, jnp.where(faster > 0.0, _SPEEDS_UP_S, _ACCELERATES_S))
    speed = start + faster * longer
    speed = jnp.clip(speed, 0.0, jnp.maximum(start, _USUAL_MPS))
    angle = turning * jnp.minimum(times, _TURNS_S)
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def turned(vector: Array) -> Array:
        x, y = vector[:, 0], vector[:, 1]
        return jnp.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)

    course = turned(velocity / jnp.maximum(start, 1e-3)[:, None])
    # Who stands and starts goes where it looks.
    course = jnp.where((start > 0.1)[:, None], course, turned(box[:, COS : SIN + 1]))
    xy = box[:, :2] + jnp.cumsum(speed[..., None] * course, axis=0) * STEP_S
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([xy, turned(box[:, COS : SIN + 1]), size], axis=-1), speed


def _along_lanes(
    bank: ScenarioBank, context: AgentContext, box: Float[Array, "K 6"], speed: Float[Array, "H K"],
    turning: Float[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Bool[Array, " K"]]:  # fmt: skip
    """Predict boxes of agents that follow their lane, and whether they are on one."""
    ways = speed.reshape(_LANE_STEPS, -1, speed.shape[1]).mean(axis=1) * _LANE_STEP_S

    def one(start: Array, way: Array, rate: Array) -> tuple[Array, Array]:
        def step(now: tuple[Array, Array], ahead: tuple[Array, Array]) -> Any:
            xy, heading = now
            way, turn = ahead
            cos, sin = jnp.cos(turn), jnp.sin(turn)
            bent = jnp.stack([heading[0] * cos - heading[1] * sin, heading[0] * sin + heading[1] * cos])
            lane, left, there = lane_course(bank, context.index, xy + bent * way / 2, bent, context.z)
            back = jnp.clip(-left / jnp.maximum(3.0 * way, 4.0), -0.4, 0.4)
            steered = lane + back * jnp.stack([-lane[1], lane[0]])
            heading = jnp.where(there, steered / _length(steered), bent)
            xy = xy + heading * way
            return (xy, heading), (jnp.concatenate([xy, heading]), there)

        turns = jnp.where(jnp.arange(_LANE_STEPS) < 2, rate * _LANE_STEP_S / 2, 0.0)
        _, (poses, there) = jax.lax.scan(step, (start[:2], start[2:4]), (way, turns))
        poses = jnp.concatenate([start[None, :4], poses])
        middle = (poses[:-1] + poses[1:]) / 2
        return jnp.stack([middle, poses[1:]], axis=1).reshape(-1, 4), there[0]

    poses, there = jax.vmap(one, in_axes=(0, 1, 0), out_axes=(1, 0))(box, ways, turning)
    heading = poses[..., 2:] / jnp.maximum(_length(poses[..., 2:]), 1e-3)[..., None]
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([poses[..., :2], heading, size], axis=-1), there


def _entering(
    box: Float[Array, "K 6"], velocity: Float[Array, "K 2"], speed: Float[Array, "H K"],
    route: tuple[Array, Array, Array], me: Float[Array, " 6"], people: Bool[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Bool[Array, " K"], Bool[Array, " K"]]:  # fmt: skip
    """Predict boxes of agents that enter ego's path and stay; masks of possible and certain ones."""
    path, there, offsets = route
    along, lateral, cos, sin = project(path, there, offsets, box[:, :2], velocity)
    toward = -jnp.sign(lateral) * sin
    toward = jnp.where(people & (toward > _STARTS_MPS), jnp.maximum(toward, _RUNS_MPS), toward)
    _, _, straight, across = project(path, there, offsets, box[:, :2], box[:, COS : SIN + 1])
    half = (jnp.abs(across) * box[:, LENGTH] + jnp.abs(straight) * box[:, WIDTH]) / 2
    gap = jnp.abs(lateral) - half - me[WIDTH] / 2
    may = (toward > _ENTERS_MPS) & (gap < _ENTERS_S * toward) & (along > -2.0) & jnp.isfinite(lateral)
    sure = may & (gap < 1.5 * toward) & (toward > 2.0 * _ENTERS_MPS)
    times = prediction_times()[:, None]
    share = speed / jnp.maximum(_length(velocity), 0.1)
    forward = jnp.cumsum(cos * share, axis=0) * STEP_S
    # Who comes the other way swerves for a short time, and then goes on along the way.
    swerves = jnp.where(cos < -SAME_WAY * _length(velocity), jnp.minimum(times, _SWERVES_S), times)
    left = jnp.sign(lateral) * jnp.maximum(jnp.abs(lateral) - toward * swerves, 0.0)
    left = jnp.where(may, left, 0.0)
    row = at(path, offsets, along + forward)
    xy = row[..., :2] + left[..., None] * jnp.stack([-row[..., 3], row[..., 2]], axis=-1)
    goes_along = jnp.abs(cos) > jnp.abs(sin)
    way = jnp.sign(cos)[:, None] * row[..., 2:4]
    facing = jnp.where(goes_along[:, None], way, box[:, COS : SIN + 1])
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([xy, facing, size], axis=-1), may, sure


def at(line: Float[Array, "P 7"], offsets: Float[Array, " P"], way: Array) -> Array:
    """Interpolate x, y, cos, sin at arc lengths along a line of evenly spaced points."""
    place = way / (offsets[1] - offsets[0])
    low = jnp.clip(place.astype(jnp.int32), 0, line.shape[0] - 2)
    part = jnp.clip(place - low, 0.0, 1.0)[..., None]
    row = line[low] * (1.0 - part) + line[low + 1] * part
    return jnp.concatenate([row[..., :2], row[..., 3:5]], axis=-1)


def _length(vector: Float[Array, "... 2"]) -> Float[Array, ...]:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def prediction_times() -> Float[Array, " H"]:
    """Prediction times, s."""
    return (jnp.arange(HORIZON) + 1.0) * STEP_S


#: Lateral offsets from the route to go to, m, and accelerations that are not exceeded on the way, m/s2.
_SHIFTS = (0.0, -1.2, 1.2, -2.4, 2.4, -3.5, 3.5)
_CAPS = (2.0, 0.0, -1.5, -3.0, -6.0, 2.0)
#: By how much each exceeds the desired speed: the last one hurries past conflicts.
_HASTE = (1.0, 1.0, 1.0, 1.0, 1.0, 1.4)
#: Points along the route and their spacing, m.
_POINTS, _STEP_M = 46, 2.0
#: Lateral acceleration with which the car goes aside, m/s2.
_ASIDE_MPS2 = 3.5
#: Free space ahead of and next to the car: too small, enough, and to uncertain agents, m.
_TIGHT_M, _FREE_M, _MAYBE_M = (0.1, 0.1), (0.6, 0.5), (0.6, 0.3)
#: A larger shift leaves the lane, m.
_LANE_M = 2.0
#: What has stood this long is no queue, s, unless something stands this near before it, or a red light, m.
_STUCK_S, _QUEUE_M, _LIGHT_M = 2.5, 14.0, 60.0
#: Who crosses may come sooner or later than expected by this, s, and m per squared s of foresight, at most by m.
_EARLY_S, _EARLY_MPS2, _EARLY_M = 0.25, 0.2, 6.0
#: Extra lateral space for pedestrians and cyclists, m.
_VULNERABLE_SPACE_M = 0.6
#: Prices: of a hit, more the sooner it comes, of one from behind, of one that is only possible, of leaving the road
#: and of being off it all the time, of driving outside the lanes that go one's way, of passing closely.
_HIT, _SOONER, _REAR, _MAYBE, _OFF, _ASTRAY, _CLOSE = 60.0, 100.0, 0.3, 40.0, 50.0, 30.0, 4.0
#: Of crossing the way of who may come early or late, and of doing so all the time; of hurrying.
_CUTS, _CUTS_LONG, _HURRY = 10.0, 30.0, 4.0
#: Per metre of way lost, per metre aside, per metre of shifting, of leaving the lane other than to get past what
#: stands there, per squared m/s2 of braking.
_WAY, _ASIDE, _SHIFTING, _LEAVES, _BRAKING = 0.2, 0.8, 0.2, 6.0, 0.05


@record
class SearchPlanner:
    """Choose among 42 manoeuvres along the route from the true current state.

    A manoeuvre is a lateral offset to go to and an acceleration that is not exceeded; below that, the car follows
    what is ahead of it by IDM; one more drives faster to clear conflicts. Each is driven for
    5 s with the dynamics and the steering law that the car really has. It loses by hitting others, the sooner the
    more, by crossing the way of who may come a little sooner or later than expected, by leaving the road and its
    lanes, by passing closely, by losing way and by braking.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(
        default=IdmParameters(headway_s=1.2, acceleration_mps2=2.0, comfortable_braking_mps2=2.5)
    )
    name: str = static(default="search")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Trend:
        """Return the motion trend of the half second before the start."""
        return Trend.logged(bank, state.context)

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
        me, speed = frame.box[context.slot], context.history[-1, 3]
        offsets = jnp.arange(_POINTS) * _STEP_M
        path, there = route_ahead(bank, context.index, context.route_m, offsets)
        desired = jnp.where(there[1], desired_speed(path, there, offsets), 0.0)
        stop = stop_line_m(bank, context, frame)
        trend = carry.updated(frame)
        others = Others.near(bank, context, frame, trend, (path, there, offsets))
        lateral = jnp.clip(situation.surroundings.route.lateral_m, -5.0, 5.0)
        stuck = _stuck(path, there, offsets, others, me, stop)

        def line_costs(shift: Array) -> tuple[Array, Array, Array]:
            line = _line(path, offsets, (lateral, shift), me, speed)
            pose, way, first = self._driven(line, there, offsets, others, (me, speed, desired, stop))
            cost = jax.vmap(lambda driven: _danger(driven, me, others))(pose)
            off, astray = _bad_ground(bank, situation, pose[0], (line, there), me)
            astray_price = jnp.where(stuck, 0.1, 1.0) * _ASTRAY
            cost += _OFF * ((off > 0.0) + off) + (shift != 0.0) * astray * astray_price
            cost += (jnp.abs(shift) > _LANE_M) * ~stuck * _LEAVES
            cost += _ASIDE * jnp.abs(shift) + _SHIFTING * jnp.abs(shift - lateral)
            cost += _HURRY * (jnp.asarray(_HASTE) > 1.0)
            cost += _BRAKING * jnp.minimum(first[:, 0], 0.0) ** 2 - _WAY * way
            return cost, first, line

        costs, firsts, _ = jax.vmap(line_costs)(jnp.asarray(_SHIFTS))
        best = firsts.reshape(-1, 2)[jnp.argmin(costs)]
        motion = context.history[-1]
        action = self.actions.action(motion, best[0], best[1], me[LENGTH])
        return action, trend

    def _driven(
        self, line: Array, there: Array, offsets: Array, others: Others, ego: tuple[Array, ...]
    ) -> tuple[Float[Array, "C H 4"], Float[Array, " C"], Float[Array, "C 2"]]:
        """Poses along a line for each cap, travelled distances, and first acceleration and curvature."""
        me, start, desired, stop = ego
        sharpest = self.actions.sharpest(me[LENGTH])
        rear, leader_speed = jax.vmap(lambda now: _corridor(line, there, offsets, others, now, me))(
            (others.box, others.speed)
        )
        left_m = jnp.sum(there) * _STEP_M

        def cap_driven(cap: Array, haste: Array) -> tuple[Array, Array, Array]:
            hurried = desired * haste

            def step(now: tuple[Array, ...], ahead: tuple[Array, Array]) -> Any:
                pose, way, v = now
                rear, leader = ahead
                gaps = jnp.where(rear > way, rear - way, jnp.inf) - me[LENGTH] / 2
                nearest = jnp.argmin(gaps)
                line_gap = stop - way + self.parameters.min_gap_m - STOP_SHORT_M
                gap = jnp.minimum(gaps[nearest], line_gap)
                gap = jnp.where(jnp.isfinite(gap), gap, 1e4)
                leader_v = jnp.where(line_gap < gaps[nearest], 0.0, leader[nearest])
                a = jnp.minimum(idm_acceleration(v, hurried, gap, leader_v, self.parameters), cap)
                aim = jnp.minimum(way + jnp.clip(0.5 * v + 2.5, 3.0, 14.0), left_m)
                k = pursuit(pose, at(line, offsets, aim)[:2] - pose[:2])
                grip = jnp.minimum(GRIP_MPS2 / jnp.maximum(v * v, 1e-3), sharpest)
                k = jnp.clip(k, -grip, grip)
                slower = jnp.maximum(v + a * STEP_S, 0.0)
                moved = (v + slower) / 2 * STEP_S
                pose = advanced(pose, k, moved)
                return (pose, way + moved, slower), (pose, a, k)

            _, (pose, a, k) = jax.lax.scan(step, (me[:4], jnp.zeros(()), start), (rear, leader_speed))
            final = jnp.sum(jnp.sqrt(jnp.sum((pose[1:, :2] - pose[:-1, :2]) ** 2, -1)))
            return pose, final, jnp.stack([a[0], k[0]])

        return jax.vmap(cap_driven)(jnp.asarray(_CAPS), jnp.asarray(_HASTE))


def advanced(pose: Float[Array, " 4"], curvature: Array, distance: Array) -> Float[Array, " 4"]:
    """Advance x, y, cos, sin by a distance at a curvature, like the kinematic bicycle."""

    def turned(cos: Array, sin: Array) -> Float[Array, " 2"]:
        c, s = jnp.cos(curvature * distance / 2), jnp.sin(curvature * distance / 2)
        return jnp.stack([cos * c - sin * s, sin * c + cos * s])

    mean = turned(pose[2], pose[3])
    return jnp.concatenate([pose[:2] + distance * mean, turned(mean[0], mean[1])])


def _line(
    path: Float[Array, "P 7"],
    offsets: Float[Array, " P"],
    aside: tuple[Array, Array],
    me: Array,
    speed: Array,
) -> Float[Array, "P 7"]:
    """Shift the route laterally from the car's current offset and heading to a target offset.

    A cubic whose largest lateral acceleration, 6 d / T^2 for a shift by d within T, is 3.5 m/s2.
    """
    lateral, shift = aside
    cos, sin = path[:, RouteColumn.COS], path[:, RouteColumn.SIN]
    forward, left = me[COS] * cos[0] + me[SIN] * sin[0], me[SIN] * cos[0] - me[COS] * sin[0]
    slope = jnp.clip(left / jnp.maximum(forward, 0.3), -0.5, 0.5)
    takes_s = jnp.clip(jnp.sqrt(6.0 * jnp.abs(shift - lateral) / _ASIDE_MPS2), 1.0, 2.5)
    length = jnp.clip(takes_s * speed, 6.0, 40.0)
    u = jnp.clip(offsets / length, 0.0, 1.0)
    d = lateral + (shift - lateral) * u * u * (3.0 - 2.0 * u) + slope * length * u * (1.0 - u) ** 2
    slopes = (shift - lateral) * 6.0 * u * (1.0 - u) / length + slope * (1.0 - u) * (1.0 - 3.0 * u)
    norm = jnp.sqrt(1.0 + slopes * slopes)
    turned = jnp.stack([(cos - sin * slopes) / norm, (sin + cos * slopes) / norm], axis=-1)
    xy = path[:, RouteColumn.XY] + d[:, None] * jnp.stack([-sin, cos], axis=-1)
    return path.at[:, RouteColumn.XY].set(xy).at[:, RouteColumn.HEADING].set(turned)


def _corridor(
    line: Array, there: Array, offsets: Array, others: Others, now: tuple[Array, Array], me: Array
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Rear positions of agents in a line's corridor at a time (else infinite), and their speeds."""
    box, speed = now
    along, lateral, cos, sin = project(line, there, offsets, box[:, :2], box[:, COS : SIN + 1])
    half_length = (jnp.abs(cos) * box[:, LENGTH] + jnp.abs(sin) * box[:, WIDTH]) / 2
    half_width = (jnp.abs(sin) * box[:, LENGTH] + jnp.abs(cos) * box[:, WIDTH]) / 2
    led = others.valid & ((cos > SAME_WAY) | (speed < SLOW_MPS)) & ~others.behind
    led &= jnp.abs(lateral) < half_width + me[WIDTH] / 2 + _TIGHT_M[1] + 0.1
    return jnp.where(led, along - half_length, jnp.inf), speed * cos


def _stuck(
    path: Array, there: Array, offsets: Array, others: Others, me: Array, stop: Array
) -> Bool[Array, ""]:
    """Whether the next agent on the route is stationary, so that ego may pass it."""
    along, lateral, cos, sin = project(
        path, there, offsets, others.box[0, :, :2], others.box[0, :, COS : SIN + 1]
    )
    half_width = (jnp.abs(sin) * others.box[0, :, LENGTH] + jnp.abs(cos) * others.box[0, :, WIDTH]) / 2
    on = others.valid & (jnp.abs(lateral) < half_width + me[WIDTH] / 2 + 0.2) & (along > 0.0)
    ways = jnp.where(on, along, jnp.inf)
    first = jnp.argmin(ways)
    queue = (on & others.vehicle & (ways > ways[first]) & (ways < ways[first] + _QUEUE_M)).any()
    stands = (others.stood_s[first] >= _STUCK_S) | (
        ~others.vehicle[first] & (others.speed[0, first] < SLOW_MPS)
    )
    return stands & ~(queue & others.vehicle[first]) & (stop > _LIGHT_M) & jnp.isfinite(ways[first])


def _danger(pose: Float[Array, "H 4"], me: Array, others: Others) -> Array:
    """Cost of predicted, possible and near collisions of a manoeuvre."""

    def meets(boxes: Array, margin: tuple[float, float]) -> Bool[Array, "H K"]:
        size = jnp.broadcast_to(me[LENGTH:] + 2.0 * jnp.asarray(margin), (HORIZON, 2))
        return overlap(jnp.concatenate([pose, size], -1)[:, None], boxes) & others.valid

    def sooner(hit: Bool[Array, "H K"]) -> Float[Array, " K"]:
        return jnp.where(hit.any(axis=0), 1.0 - jnp.argmax(hit, axis=0) / HORIZON, 0.0)

    early = sooner(meets(others.box, _TIGHT_M))
    price = jnp.where(early > 0.0, _HIT + _SOONER * early, 0.0)
    price = jnp.maximum(price, _MAYBE * sooner(meets(others.maybe, _MAYBE_M) & others.enters))
    worst = jnp.max(price * jnp.where(others.behind, _REAR, 1.0))
    # Who crosses ego's way, or comes into it, may be there a little sooner or later.
    cos = jnp.einsum("hi,hki->hk", pose[:, 2:4], others.box[..., COS : SIN + 1])
    crosses = ((cos < SAME_WAY) | others.enters) & (others.speed > SLOW_MPS) & others.vehicle
    times = prediction_times()[:, None]
    early = jnp.minimum(_EARLY_S * others.speed + _EARLY_MPS2 * times * times, _EARLY_M)
    wide = others.box.at[..., LENGTH].add(jnp.where(crosses, 2.0 * early, 0.0))
    wide = wide.at[..., WIDTH].add(jnp.where(others.vulnerable, 2.0 * _VULNERABLE_SPACE_M, 0.0))
    near = meets(wide, _FREE_M) & ~others.behind
    cut = (near & crosses).any(axis=1)
    worst += jnp.where(cut.any(), _CUTS, 0.0) + _CUTS_LONG * jnp.mean(cut)
    return worst + _CLOSE * jnp.mean((near & ~crosses).any(axis=1))


def _bad_ground(
    bank: ScenarioBank, situation: Situation, pose: Float[Array, "H 4"], line: tuple[Array, Array], me: Array
) -> tuple[Array, Array]:
    """Whether the car leaves the road within 3 s, and whether a line leaves the lanes in its direction."""
    context = situation.context
    ground = context.z - bank.height_m(context.index, context.slot) / 2

    def beyond(at: Array) -> Array:
        box = jnp.concatenate([at, me[LENGTH:]])
        left, known = left_of_edges(bank, context.index, box[:2], corners(box), ground)
        return (known & (left < -OFFROAD_TOLERANCE_M / 2)).any()

    def astray(row: Array) -> Array:
        return around_lanes(bank, context.index, row[:2], row[3:5], row[None, :2], context.z).straddling

    few = slice(4, 17, 4)
    return jnp.mean(jax.vmap(beyond)(pose[1:12:2])), (jax.vmap(astray)(line[0][few]) & line[1][few]).any()
