"""What others are expected to do over the next seconds, from what is seen of them now and of the lanes they are on."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import LEVEL_M, lane_course
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.ahead import project
from drivax.simulator.types import AgentContext, Frame

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
    """How everybody's motion changes, smoothed over about half a second.

    Attributes:
        direction: Cosine and sine of the heading one step ago.
        speed: Speed then, m/s.
        valid: Whether there was somebody.
        turning: Yaw rate, rad/s.
        acceleration: Along the heading, m/s2.
        stood_s: For how long somebody has been seen to stand, s.
    """

    direction: Float[Array, "S 2"]
    speed: Float[Array, " S"]
    valid: Bool[Array, " S"]
    turning: Float[Array, " S"]
    acceleration: Float[Array, " S"]
    stood_s: Float[Array, " S"]

    @classmethod
    def logged(cls, bank: ScenarioBank, context: AgentContext) -> Trend:
        """From the log's rows of the present step and of half a second ago; parked agents keep still."""
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
        """One step later."""
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
    """The nearest agents, rolled out in two ways.

    Attributes:
        box: What each is expected to do: boxes at each time.
        maybe: Where those are who may come into ego's way and stay there.
        enters: Who may do so.
        speed: Expected speeds, m/s.
        valid: Who is there.
        behind: Who follows ego.
        stood_s: For how long each has stood, s.
        vehicle: Who is a vehicle.
        vulnerable: Who walks or rides.
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
        """Those of ego's level.

        Args:
            bank: The scenarios.
            context: Who is ego, and where.
            frame: Everybody.
            trend: How they have moved.
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
    """Boxes and speeds at each time: constant yaw rate, acceleration for a second, no reversing."""
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
    """Boxes of those who follow the lane that they are on, and whether they are on one."""
    ways = speed.reshape(_LANE_STEPS, -1, speed.shape[1]).mean(axis=1) * _LANE_STEP_S

    def one(start: Array, way: Array, rate: Array) -> tuple[Array, Array]:
        def step(now: tuple[Array, Array], ahead: tuple[Array, Array]) -> Any:
            xy, heading = now
            way, turn = ahead
            cos, sin = jnp.cos(turn), jnp.sin(turn)
            bent = jnp.stack([heading[0] * cos - heading[1] * sin, heading[0] * sin + heading[1] * cos])
            lane, left, there = lane_course(bank, context.index, xy + bent * way / 2, bent, context.z)
            back = jnp.clip(-left / jnp.maximum(3.0 * way, 4.0), -0.4, 0.4)
            wanted = lane + back * jnp.stack([-lane[1], lane[0]])
            heading = jnp.where(there, wanted / _length(wanted), bent)
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
    """Boxes of those who move sideways into ego's way and stay in it; who may do so, and who surely does."""
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
    """x, y, cos, sin at ways along a line of evenly spaced points."""
    place = way / (offsets[1] - offsets[0])
    low = jnp.clip(place.astype(jnp.int32), 0, line.shape[0] - 2)
    part = jnp.clip(place - low, 0.0, 1.0)[..., None]
    row = line[low] * (1.0 - part) + line[low + 1] * part
    return jnp.concatenate([row[..., :2], row[..., 3:5]], axis=-1)


def _length(vector: Float[Array, "... 2"]) -> Float[Array, ...]:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def prediction_times() -> Float[Array, " H"]:
    """Times at which others are predicted, s."""
    return (jnp.arange(HORIZON) + 1.0) * STEP_S
