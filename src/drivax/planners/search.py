"""A search over braking and steering: rolls a grid of manoeuvres out against others who go on as they went."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, corners, overlap
from drivax.planners.idm import STOP_SHORT_M, desired_speed, project, pursuit, stop_line_m
from drivax.scenario.bank import AGENT_COS, AGENT_SIN, AGENT_VALID, ScenarioBank
from drivax.scenario.queries import LEVEL_M, OFFROAD_TOLERANCE_M, left_of_edges, route_ahead
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.types import Frame, Scene, SimState, Situation
from drivax.tasks.actions import ActionSpace

#: Lateral offsets from the route to go to, m, and accelerations that are not exceeded on the way, m/s2.
_SHIFTS = (0.0, -1.2, 1.2, -3.4, 3.4)
_CAPS = (2.0, 0.0, -1.0, -2.0, -3.5, -6.0)
#: Points along the route and their spacing, m.
_POINTS, _STEP_M = 41, 2.0
#: How far ahead in time manoeuvres are rolled out, s, and in which steps.
_HORIZON, _DT_S = 20, 0.2
#: Others that are looked at: the nearest.
_OTHERS = 24
#: Free space before and beside the car that is as good as none, and that is enough, m.
_TIGHT_M, _FREE_M = (0.1, 0.1), (0.6, 0.5)
#: An agent in the corridor is followed when it heads the same way within 45 degrees or is this slow, m/s.
_SLOW_MPS = 1.0
#: Steps over which trends are measured; how long others are expected to accelerate and to turn, s.
_PAST, _ACCELERATES_S, _TURNS_S = 5, 1.0, 3.0
_SAME_WAY = 0.7
#: Prices: of a hit, more the sooner it comes, of one from behind, of leaving the road, of passing closely, per metre
#: of way lost, per metre aside, per metre of shifting, per squared m/s2 of braking.
_HIT, _SOONER, _REAR, _OFF, _CLOSE = 60.0, 100.0, 0.3, 50.0, 4.0
_WAY, _ASIDE, _SHIFTING, _BRAKING = 0.2, 0.8, 0.2, 0.05


@record
class SearchPlanner:
    """Chooses among 30 manoeuvres along the route; knows the present truth, and nothing of the future.

    A manoeuvre is a lateral offset to go to and an acceleration that is not exceeded; below that, the car follows
    what is ahead of it by IDM. Each is rolled out 4 s. It loses by hitting others, the sooner the more, by leaving
    the road, by passing closely, by losing way and by braking. Others are expected to keep their speed and how fast
    they turn, and their acceleration for another second; both are measured over the past half second.
    """

    actions: ActionSpace = static(default=ActionSpace())
    parameters: IdmParameters = static(
        default=IdmParameters(headway_s=1.2, acceleration_mps2=2.0, comfortable_braking_mps2=2.5)
    )
    name: str = static(default="search")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Trend:
        """What everybody did in the half second before the start."""
        return Trend.logged(bank, state.scene)

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, "2"], Any]:
        """The first step of the cheapest manoeuvre."""
        scene = situation.scene
        me = situation.surroundings.frame.box[scene.slot]
        speed = scene.history[-1, 3]
        offsets = jnp.arange(_POINTS) * _STEP_M
        path, there = route_ahead(bank, scene.index, scene.route_m, offsets)
        wanted = jnp.where(there[1], desired_speed(path, there, offsets), 0.0)
        stop = stop_line_m(bank, situation, path, there, offsets)
        trend = carry.updated(situation.surroundings.frame)
        others = _Others.near(situation.surroundings.frame, scene.slot, me, trend)
        beside = jnp.clip(situation.surroundings.route.lateral_m, -5.0, 5.0)

        def line_costs(shift: Array) -> tuple[Array, Array, Array]:
            line = _line(path, offsets, beside, shift, speed)
            way, first = self._rolled(line, there, offsets, others, (me, speed, wanted, stop))
            cost = jax.vmap(lambda at: _danger(line, offsets, at, me, others))(way)
            off = _off_road(bank, situation, line, there, me) & (shift != 0.0)
            cost += off * _OFF + _ASIDE * jnp.abs(shift) + _SHIFTING * jnp.abs(shift - beside)
            cost += _BRAKING * jnp.minimum(first, 0.0) ** 2 - _WAY * way[:, -1]
            return cost, first, line

        costs, accelerations, lines = jax.vmap(line_costs)(jnp.asarray(_SHIFTS))
        best = jnp.argmin(costs)
        row = best // len(_CAPS)
        ahead_m = jnp.clip(0.7 * speed + 3.0, 4.0, 16.0)
        left_m = jnp.maximum(bank.route_points[scene.index, 0] - 1 - scene.route_m, 0.0)
        target = _at(lines[row], offsets, jnp.minimum(ahead_m, left_m))[:2] - me[:2]
        action = self.actions.action(accelerations.ravel()[best], pursuit(me, target), me[4])
        return jnp.clip(action, -1.0, 1.0), trend

    def _rolled(
        self, line: Array, there: Array, offsets: Array, others: _Others, ego: tuple[Array, ...]
    ) -> tuple[Float[Array, "C H"], Float[Array, " C"]]:
        """Way along a line after each step under each cap, and the first acceleration."""
        me, speed, wanted, stop = ego
        rear, leader_speed = jax.vmap(lambda now: _corridor(line, there, offsets, others, now, me))(
            (others.box, others.speed)
        )

        def cap_rolled(cap: Array) -> tuple[Array, Array]:
            def step(now: tuple[Array, Array], ahead: tuple[Array, Array]) -> Any:
                way, v = now
                rear, leader = ahead
                gaps = jnp.where(rear > way, rear - way, jnp.inf) - me[LENGTH] / 2
                nearest = jnp.argmin(gaps)
                line_gap = stop - way + self.parameters.min_gap_m - STOP_SHORT_M
                gap = jnp.minimum(gaps[nearest], line_gap)
                gap = jnp.where(jnp.isfinite(gap), gap, 1e4)
                leader_v = jnp.where(line_gap < gaps[nearest], 0.0, leader[nearest])
                a = jnp.minimum(idm_acceleration(v, wanted, gap, leader_v, self.parameters), cap)
                slower = jnp.maximum(v + a * _DT_S, 0.0)
                way = way + (v + slower) / 2 * _DT_S
                return (way, slower), (way, a)

            _, (way, a) = jax.lax.scan(step, (jnp.zeros(()), speed), (rear, leader_speed))
            return way, a[0]

        return jax.vmap(cap_rolled)(jnp.asarray(_CAPS))


@record
class Trend:
    """How everybody's motion changes, smoothed over about half a second.

    Attributes:
        direction: Cosine and sine of the heading one step ago.
        speed: Speed then, m/s.
        valid: Whether there was somebody.
        turning: Yaw rate, rad/s.
        acceleration: Along the heading, m/s2.
    """

    direction: Float[Array, "S 2"]
    speed: Float[Array, " S"]
    valid: Bool[Array, " S"]
    turning: Float[Array, " S"]
    acceleration: Float[Array, " S"]

    @classmethod
    def logged(cls, bank: ScenarioBank, scene: Scene) -> Trend:
        """From the log's rows of the present step and of half a second ago; parked agents keep still."""
        now = bank.agents[scene.index, scene.step]
        before = bank.agents[scene.index, jnp.maximum(scene.step - _PAST, 0)]
        known = (now[:, AGENT_VALID] > 0) & (before[:, AGENT_VALID] > 0) & (scene.step >= _PAST)
        turn = _turn(before[:, AGENT_COS : AGENT_SIN + 1], now[:, AGENT_COS : AGENT_SIN + 1])
        faster = _length(now[:, 5:7]) - _length(before[:, 5:7])
        still = jnp.zeros(bank.parked.shape[1])

        def whole(moving: Array) -> Array:
            return jnp.concatenate([moving, still])

        ahead = jnp.concatenate([now[:, AGENT_COS : AGENT_SIN + 1], bank.parked[scene.index, :, 2:4]])
        return cls(
            ahead,
            whole(_length(now[:, 5:7])),
            jnp.concatenate([now[:, AGENT_VALID] > 0, still > 1.0]),
            whole(jnp.where(known, turn, 0.0) / (_PAST * DT_S)),
            whole(jnp.where(known, faster, 0.0) / (_PAST * DT_S)),
        )

    def updated(self, frame: Frame) -> Trend:
        """One step later."""
        direction, speed = frame.box[:, COS : SIN + 1], _length(frame.velocity)
        known = frame.valid & self.valid

        def smoothed(old: Array, change: Array) -> Array:
            return jnp.where(known, old + (change / DT_S - old) / _PAST, 0.0)

        turning = smoothed(self.turning, _turn(self.direction, direction))
        acceleration = smoothed(self.acceleration, speed - self.speed)
        return Trend(direction, speed, frame.valid, turning, acceleration)


def _turn(before: Float[Array, "S 2"], now: Float[Array, "S 2"]) -> Float[Array, " S"]:
    """Angle from one direction to another, rad."""
    cross = before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]
    return jnp.arctan2(cross, jnp.sum(before * now, axis=-1))


@record
class _Others:
    """The nearest agents, rolled out: boxes and speeds at each time, who is there, who comes from behind."""

    box: Float[Array, "H K 6"]
    speed: Float[Array, "H K"]
    valid: Bool[Array, " K"]
    behind: Bool[Array, " K"]

    @classmethod
    def near(cls, frame: Frame, slot: Array, me: Float[Array, " 6"], trend: Trend) -> _Others:
        """Those of ego's level."""
        apart = frame.box[:, :2] - me[:2]
        valid = frame.valid & (jnp.arange(frame.valid.shape[0]) != slot)
        valid &= jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M
        # What comes nearer counts as nearer.
        closing = jnp.sum(apart * frame.velocity, axis=-1) / jnp.maximum(_length(apart), 1.0)
        rank = jnp.where(valid, _length(apart) + 2.0 * jnp.minimum(closing, 0.0), 1e6)
        _, rows = jax.lax.top_k(-rank, min(_OTHERS, rank.shape[0]))
        box = frame.box[rows]
        ahead = apart[rows, 0] * me[COS] + apart[rows, 1] * me[SIN]
        aside = apart[rows, 1] * me[COS] - apart[rows, 0] * me[SIN]
        follows = box[:, COS] * me[COS] + box[:, SIN] * me[SIN] > _SAME_WAY
        people = frame.kind[rows] == AgentKind.PEDESTRIAN
        # People change their mind within a step.
        box = box.at[:, LENGTH : WIDTH + 1].add(jnp.where(people, 0.4, 0.0)[:, None])
        drives = ~people & (_length(frame.velocity[rows]) > 2.0 * _SLOW_MPS)
        turning = jnp.where(drives, jnp.clip(trend.turning[rows], -0.8, 0.8), 0.0)
        faster = jnp.where(people, 0.0, jnp.clip(trend.acceleration[rows], -8.0, 3.0))
        boxes, speed = _rolled_out(box, frame.velocity[rows], turning, faster)
        behind = follows & (ahead < -me[LENGTH] / 2) & (jnp.abs(aside) < me[WIDTH])
        return cls(boxes, speed, valid[rows], behind)


def _rolled_out(
    box: Float[Array, "K 6"], velocity: Float[Array, "K 2"], turning: Float[Array, " K"],
    faster: Float[Array, " K"],
) -> tuple[Float[Array, "H K 6"], Float[Array, "H K"]]:  # fmt: skip
    """Boxes and speeds at each time: constant yaw rate, acceleration for a second, no reversing."""
    times = _times()[:, None]
    start = _length(velocity)
    speed = jnp.maximum(start + faster * jnp.minimum(times, _ACCELERATES_S), 0.0)
    angle = turning * jnp.minimum(times, _TURNS_S)
    cos, sin = jnp.cos(angle), jnp.sin(angle)

    def turned(vector: Array) -> Array:
        x, y = vector[:, 0], vector[:, 1]
        return jnp.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)

    course = turned(velocity / jnp.maximum(start, 1e-3)[:, None])
    # Who stands and starts goes where it looks.
    course = jnp.where((start > 0.1)[:, None], course, turned(box[:, COS : SIN + 1]))
    xy = box[:, :2] + jnp.cumsum(speed[..., None] * course, axis=0) * _DT_S
    size = jnp.broadcast_to(box[:, LENGTH:], (*speed.shape, 2))
    return jnp.concatenate([xy, turned(box[:, COS : SIN + 1]), size], axis=-1), speed


def _length(vector: Float[Array, "... 2"]) -> Float[Array, ...]:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def _times() -> Float[Array, " H"]:
    return (jnp.arange(_HORIZON) + 1.0) * _DT_S


def _line(
    path: Float[Array, "P 7"], offsets: Float[Array, " P"], beside: Array, shift: Array, speed: Array
) -> Float[Array, "P 7"]:
    """The route, shifted: from where the car is beside it to an offset, smoothly within about 2.5 s."""
    length = jnp.clip(2.5 * speed, 8.0, 30.0)
    u = jnp.clip(offsets / length, 0.0, 1.0)
    d = beside + (shift - beside) * u * u * (3.0 - 2.0 * u)
    slope = (shift - beside) * 6.0 * u * (1.0 - u) / length
    cos, sin = path[:, 3], path[:, 4]
    norm = jnp.sqrt(1.0 + slope * slope)
    turned = jnp.stack([(cos - sin * slope) / norm, (sin + cos * slope) / norm], axis=-1)
    xy = path[:, :2] + d[:, None] * jnp.stack([-sin, cos], axis=-1)
    return path.at[:, :2].set(xy).at[:, 3:5].set(turned)


def _at(line: Float[Array, "P 7"], offsets: Float[Array, " P"], way: Array) -> Array:
    """x, y, cos, sin at ways along a line."""
    low = jnp.clip((way / _STEP_M).astype(jnp.int32), 0, _POINTS - 2)
    part = jnp.clip(way / _STEP_M - low, 0.0, 1.0)[..., None]
    row = line[low] * (1.0 - part) + line[low + 1] * part
    return jnp.concatenate([row[..., :2], row[..., 3:5]], axis=-1)


def _corridor(
    line: Array, there: Array, offsets: Array, others: _Others, now: tuple[Array, Array], me: Array
) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """Where on a line the rears of those are who drive along it at a time, infinite for all others; their speeds."""
    box, speed = now
    along, lateral, cos, sin = project(line, there, offsets, box[:, :2], box[:, COS : SIN + 1])
    half_length = (jnp.abs(cos) * box[:, LENGTH] + jnp.abs(sin) * box[:, WIDTH]) / 2
    half_width = (jnp.abs(sin) * box[:, LENGTH] + jnp.abs(cos) * box[:, WIDTH]) / 2
    led = others.valid & ((cos > _SAME_WAY) | (speed < _SLOW_MPS)) & ~others.behind
    led &= jnp.abs(lateral) < half_width + me[WIDTH] / 2 + _TIGHT_M[1] + 0.1
    return jnp.where(led, along - half_length, jnp.inf), speed * cos


def _danger(line: Array, offsets: Array, way: Float[Array, " H"], me: Array, others: _Others) -> Array:
    """Price of what a manoeuvre would hit or pass closely."""
    pose = _at(line, offsets, way)

    def meets(margin: tuple[float, float]) -> Bool[Array, "H K"]:
        size = jnp.broadcast_to(me[LENGTH:] + 2.0 * jnp.asarray(margin), (_HORIZON, 2))
        return overlap(jnp.concatenate([pose, size], -1)[:, None], others.box) & others.valid

    hit = meets(_TIGHT_M)
    when = jnp.where(hit.any(axis=0), jnp.argmax(hit, axis=0), _HORIZON) / _HORIZON
    price = jnp.where(when < 1.0, _HIT + _SOONER * (1.0 - when), 0.0)
    worst = jnp.max(price * jnp.where(others.behind, _REAR, 1.0))
    return worst + _CLOSE * jnp.mean((meets(_FREE_M) & ~others.behind).any(axis=1))


def _off_road(bank: ScenarioBank, situation: Situation, line: Array, there: Array, me: Array) -> Array:
    """Whether the car would be off the road somewhere on the first 30 m of a line."""
    scene = situation.scene
    ground = scene.z - bank.agent_box[scene.index, scene.slot, 2] / 2

    def beyond(row: Array) -> Array:
        box = jnp.concatenate([row[:2], row[3:5], me[LENGTH:]])
        left, known = left_of_edges(bank, scene.index, box[:2], corners(box), ground)
        return (known & (left < -OFFROAD_TOLERANCE_M / 2)).any()

    rows = slice(2, 16, 2)
    return (jax.vmap(beyond)(line[rows]) & there[rows]).any()
