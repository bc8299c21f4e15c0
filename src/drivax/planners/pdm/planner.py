"""PDM-Closed: simulate 15 proposals along the route, score them as nuPlan does, and drive the best one.

Source: Dauner, Hallgarten, Geiger and Chitta, "Parting with Misconceptions about Learning-based Vehicle Motion
Planning" (CoRL 2023), and its published implementation; ``docs/guide/planners.md`` lists the differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, gap, overlap
from drivax.geometry.vectors import norm
from drivax.planners.pdm import scoring
from drivax.planners.pdm.brake import BrakeConfig, braking_acceleration, is_emergency, stop
from drivax.planners.pdm.forecast import Contacts, Forecast
from drivax.planners.pdm.scoring import ProposalMetrics, ScoringConfig, ground_along
from drivax.planners.pdm.tracking import Car, Reference, track
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import project, stop_line_m
from drivax.simulator.contact import overlaps
from drivax.simulator.controller import ACCELERATION, STEERING, TrackingConfig, recent_actuators, steering_of
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.types import MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical, Trajectory, action_of

#: IDM of the proposals.
PUBLISHED_DRIVER = IdmParameters(1.0, 1.5, 1.5, 3.0, exponent=10.0, max_braking_mps2=3.0)
#: Stride of the points of the first line that are compared with forecasts.
_PATH_STRIDE = 5
#: Points of a line, 1 m apart: what a car on a motorway passes in 4 s, and more ahead of it.
_POINTS = 160
#: Length of the boxes that form a corridor, and stride of the route points onto which agents are projected, m.
_PIECE_M, _STRIDE = 4, 2
#: Curvature at a point is measured between the points this many metres before and after it.
_REACH = 2
#: Gap of a free road, m.
_FREE_M = 1e4
#: Columns of a line.
LINE_X, LINE_Y, LINE_COS, LINE_SIN, LINE_CURVATURE, LINE_ALONG, LINE_Z = range(7)


@dataclass(frozen=True)
class PdmConfig:
    """Settings of PDM-Closed; defaults as published, except ``agents`` and ``scoring.ground_every``.

    Attributes:
        fractions: Target speeds of the proposals, relative to the speed limit.
        offsets_m: Lateral offsets from the route, positive to the left.
        fallback_mps: Speed limit where unknown.
        driver: IDM parameters of the proposals.
        steps: Horizon of the proposals, steps of 0.1 s. Their lines end about 160 m ahead.
        leader_every: Steps between updates of a proposal's leader.
        radius_m: Largest distance of agents to consider.
        agents: Number of agents to consider, those that come nearest to the line of the first offset. The publication
            uses the nearest 50 vehicles, 25 pedestrians, 10 cyclists and 50 other objects.
        tracking: Tracker and vehicle model.
        scoring: Weights and limits of the score.
        brake: The emergency brake.
    """

    fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)
    offsets_m: tuple[float, ...] = (0.0, -1.0, 1.0)
    fallback_mps: float = 15.0
    driver: IdmParameters = field(default_factory=lambda: PUBLISHED_DRIVER)
    steps: int = 40
    leader_every: int = 2
    radius_m: float = 50.0
    agents: int = 24
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    brake: BrakeConfig = field(default_factory=BrakeConfig)

    def __post_init__(self) -> None:
        if not self.fractions or not self.offsets_m:
            raise UsageError("PDM has no proposals", cure="give it at least one fraction and one offset")
        for name, every in (("leader_every", self.leader_every), ("ground_every", self.scoring.ground_every)):
            if every < 1 or self.steps % every:
                raise UsageError(f"{name} is {every}, steps {self.steps}", cure="use a divisor of steps")
        if self.agents < 1:
            raise UsageError(f"PDM considers {self.agents} agents", cure="use agents: 1 or more")
        if self.steps < 15:
            raise UsageError(f"{self.steps} steps are too few to judge comfort", cure="use 15 or more")


@record
class Lines:
    """P lines along the route, each with points 1 m apart; the first point of every line is abreast of ego."""

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

        def route_at(distance_m: Float[Array, " M"]) -> Float[Array, "M 7"]:
            """Return rows of the route at distances from ego."""
            on_route_m = jnp.clip(distance_m, 0.0, jnp.maximum(remaining_m, 0.0))
            points, _ = route_ahead(bank, row, along_m, on_route_m)
            straight = jnp.zeros(7).at[RouteColumn.XY].set(box[:2])
            points = jnp.where(has_route, points, straight.at[RouteColumn.HEADING].set(box[COS : SIN + 1]))
            heading = points[:, RouteColumn.HEADING]
            heading = heading / jnp.maximum(norm(heading), 1e-6)[:, None]
            xy = points[:, RouteColumn.XY] + (distance_m - on_route_m)[:, None] * heading
            return points.at[:, RouteColumn.XY].set(xy).at[:, RouteColumn.HEADING].set(heading)

        distance_m = jnp.arange(_POINTS, dtype=jnp.float32)
        centre = route_at(distance_m)
        points = jnp.stack([_line(route_at, centre, distance_m, offset) for offset in offsets_m])
        limit = jnp.where(has_route, centre[0, RouteColumn.LIMIT], 0.0)
        return cls(points, centre[::_STRIDE], remaining_m, limit)

    def at(self, arc_m: Float[Array, "P *T"]) -> Float[Array, "P *T 7"]:
        """Interpolate rows at arc lengths of each line."""
        index = jnp.clip(arc_m.astype(jnp.int32), 0, _POINTS - 2)
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
    route_at: Callable[[Array], Array], centre: Float[Array, "M 7"], distance_m: Float[Array, " M"], offset: float
) -> Float[Array, "M 7"]:  # fmt: skip
    """Return one line with evenly spaced points; ``centre`` has the rows of the route at ``distance_m``."""

    def offset_xy(rows: Float[Array, "M 7"]) -> Float[Array, "M 2"]:
        normal = jnp.stack([-rows[:, RouteColumn.SIN], rows[:, RouteColumn.COS]], axis=-1)
        return rows[:, RouteColumn.XY] + offset * normal

    along_m, rows = distance_m, centre
    if offset:
        steps = norm(jnp.diff(offset_xy(centre), axis=0))
        arc_m = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
        along_m = jnp.interp(distance_m, arc_m, distance_m) + jnp.maximum(distance_m - arc_m[-1], 0.0)
        rows = route_at(along_m)
    cos, sin = rows[:, RouteColumn.COS], rows[:, RouteColumn.SIN]
    c0, s0, c1, s1 = cos[: -2 * _REACH], sin[: -2 * _REACH], cos[2 * _REACH :], sin[2 * _REACH :]
    curvature = jnp.arctan2(c0 * s1 - s0 * c1, c0 * c1 + s0 * s1) / (2.0 * _REACH)
    height = rows[:, RouteColumn.Z] - centre[0, RouteColumn.Z]
    curvature = jnp.pad(curvature, _REACH, mode="edge")
    return jnp.stack([*offset_xy(rows).T, cos, sin, curvature, along_m, height], axis=1)


@record
class Proposals:
    """Proposals along P lines with F target speeds, at T steps from now on."""

    arc_m: Float[Array, "P F T"]  # Arc length along the line
    speed: Float[Array, "P F T"]  # m/s

    def reference(self, lines: Lines) -> Reference:
        """Return the flattened proposals, ordered by line, then by target speed."""
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
    leader is the agent nearest to ego's box among those whose box reaches into the corridor of ego's width and whose
    centre is ahead. The gap shrinks by ego's motion until the next update. ``stop_m`` is the distance from ego's front
    to the nearest stop line that requires a stop, infinite for none.
    """
    shape = lines.points.shape[0], desired.shape[0]
    boxes = others.at(jnp.arange(0, updates.stop, updates.step) * DT_S)
    is_inside = _on_corridor(lines.corridors(size[1]), boxes) & others.valid
    distances = lines.route_distances(boxes[..., :2])
    stop_along_m = stop_m + size[0] / 2
    length, width = (jnp.full(shape, extent) for extent in size)

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

    start = jnp.zeros(shape), jnp.full(shape, speed)
    forecasts = (boxes, distances, jnp.moveaxis(is_inside, 1, 0))
    _, states = jax.lax.scan(follow_leader, start, forecasts)

    def join_steps(first: Array, rest: Array) -> Array:
        """Return the values at all steps along the last axis."""
        rest = jnp.moveaxis(rest.reshape(-1, *shape), 0, -1)
        return jnp.concatenate([first[..., None], rest], axis=-1)

    return Proposals(*(join_steps(first, rest) for first, rest in zip(start, states, strict=True)))


def _on_corridor(corridors: Float[Array, "P C 6"], boxes: Float[Array, "U K 6"]) -> Bool[Array, "P U K"]:
    """Return the mask of boxes that reach into each corridor, at each time."""
    return overlap(corridors[:, None, :, None], boxes[None, :, None]).any(axis=2)


@record
class Memory:
    """Carry of PDM."""

    touched: Bool[Array, " S"]  # Agents that have overlapped ego since the episode started; ignored
    acceleration: Float[Array, ""]  # Last requested acceleration, m/s2
    steering: Float[Array, ""]  # Steering angle, rad


@record
class ScoredProposals:
    """Simulated and scored proposals of a step, ordered by line, then by target speed."""

    plans: Float[Array, "N T 3"]  # Poses along the lines, which cars track
    cars: Car  # Simulated motion, step by step
    metrics: ProposalMetrics  # Metrics of each proposal
    score: Float[Array, " N"]  # In [0, 1]


@record
class PdmPlanner:
    """Drive the best proposal (of 15 by default), or brake.

    Reads the true situation, not observations. Other agents are predicted at constant velocity; the planner reads the
    log's future only in scenarios without a route on lanes, where it follows the path of the log.
    """

    actions: ActionSpace = static(default=Physical())
    config: PdmConfig = static(default=PdmConfig())
    name: str = static(default="pdm")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Memory:
        """Return a carry without touched agents, with the acceleration and steering of the last half second."""
        context = state.context
        length_m = jnp.maximum(bank.length_m(context.index, context.slot), 1.0)
        actuators = recent_actuators(context.history, length_m, self.config.tracking)
        touched = jnp.zeros(bank.agent_box.shape[1], bool)
        return Memory(touched, actuators[ACCELERATION], actuators[STEERING])

    def act(
        self, carry: Memory, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Memory]:  # fmt: skip
        """Return the first action of the best proposal (in the space ``trajectory`` all of its poses), or brake."""
        context = situation.context
        motion, length = context.history[-1], situation.surroundings.frame.box[context.slot, LENGTH]
        touched = carry.touched | overlaps(situation.surroundings.frame, context.slot)
        carry, space = replace(carry, touched=touched), self._plan_space
        if space:
            steering = steering_of(context.action[:3], space.controller)
            carry = replace(carry, acceleration=context.action[ACCELERATION], steering=steering)
        proposals = self.score_proposals(carry, bank, situation)
        best = jnp.argmax(proposals.score)
        speed, brake = motion[MOTION_SPEED], self.config.brake
        is_braking = is_emergency(proposals.metrics.fault_s[best], speed, brake)
        brake_acceleration = braking_acceleration(speed, carry.acceleration, brake)
        acceleration = jnp.where(is_braking, brake_acceleration, proposals.cars.acceleration[best, 1])
        steering = jnp.where(is_braking, 0.0, proposals.cars.steering[best, 1])
        curvature = jnp.tan(steering) / self._wheelbase(length)
        action = action_of(self.actions, bank, context, acceleration, curvature)
        if space:
            stop_plan = stop(space, motion, brake_acceleration, length, brake)
            action = jnp.where(is_braking, stop_plan, space.plan(proposals.plans[best]))
        return action, Memory(touched, acceleration, steering)

    def score_proposals(self, carry: Memory, bank: ScenarioBank, situation: Situation) -> ScoredProposals:
        """Simulate and score all proposals."""
        config, context, surroundings = self.config, situation.context, situation.surroundings
        frame, motion = surroundings.frame, context.history[-1]
        box, speed = frame.box[context.slot], motion[MOTION_SPEED]
        size = box[LENGTH : WIDTH + 1]
        lines = Lines.along_route(bank, context.row, surroundings.route.along_m, config.offsets_m, box)
        path = lines.points[0, ::_PATH_STRIDE, :2]
        others = Forecast.of(frame, context.slot, carry.touched, path, config.agents, config.radius_m)
        # Without barriers, XLA would compute a stage again in every operation that uses it.
        lines, others = jax.lax.optimization_barrier((lines, others))
        limit = jnp.where(lines.limit > 0.0, lines.limit, config.fallback_mps)
        desired = jnp.where(lines.remaining_m > 0.0, limit, 0.0) * jnp.asarray(config.fractions)
        stop_m = stop_line_m(bank, context, frame)
        updates = range(0, config.steps, config.leader_every)
        proposals = unroll_idm(lines, others, size, speed, desired, stop_m, config.driver, updates)
        wheelbase, car = self._wheelbase(size[0]), Car(motion, carry.acceleration, carry.steering)
        plans, cars = self._simulate(lines, proposals, car, wheelbase)
        rows = lines.at(proposals.arc_m).reshape(*plans.shape[:2], -1)
        ground_z = frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2
        z, on_route = ground_z + rows[..., LINE_Z], rows[..., LINE_ALONG] <= lines.remaining_m
        # The controller of ``trajectory`` swings out in bends, and would touch curbs between look-ups.
        every = 1 if self._plan_space else config.scoring.ground_every
        contacts = jax.vmap(Contacts.along, in_axes=(0, None, None))(cars.motion, size, others)
        needs_lanes = jax.vmap(partial(Contacts.needs_lanes, steps=config.steps + 1))(contacts)
        ground = ground_along(bank, context.row, cars.motion, size, z, on_route, needs_lanes, every)
        progress_m = lines.route_distances(cars.motion[:, -1, :2]) - lines.route_distances(motion[:2])
        yaw_rate = speed * jnp.tan(carry.steering) / wheelbase

        metrics = jax.vmap(scoring.evaluate_proposal, in_axes=(0, None, None, None, 0, 0, 0, None))(
            cars, yaw_rate, size, others, contacts, ground, progress_m, config.scoring
        )
        return ScoredProposals(plans, cars, metrics, scoring.scores(metrics, config.scoring))

    def _simulate(
        self, lines: Lines, proposals: Proposals, car: Car, wheelbase: Scalar
    ) -> tuple[Float[Array, "N T 3"], Car]:
        """Return the plans of all proposals, and the cars that track them."""
        reference = jax.lax.optimization_barrier(proposals.reference(lines))
        heading = jnp.arctan2(reference.pose[..., 3:], reference.pose[..., 2:3])
        plans = jnp.concatenate([reference.pose[..., :2], heading], axis=-1)
        # One copy per proposal: XLA vectorises over arrays of one shape.
        copies = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(plans), *leaf.shape)), (car, wheelbase)
        )
        cars, wheelbases = jax.lax.optimization_barrier(copies)
        return plans, jax.lax.optimization_barrier(jax.vmap(self._track)(cars, wheelbases, reference, plans))

    def _track(self, car: Car, wheelbase: Scalar, reference: Reference, plan: Float[Array, "T 3"]) -> Car:
        """Track one proposal as it would be executed."""
        space = self._plan_space
        if space is None:
            return track(car, reference, wheelbase, self.config.tracking)
        poses = replace(space, steps=max(space.steps, self.config.steps)).plan(plan).reshape(-1, 3)
        axle_reference = Reference.fit(poses, self.config.steps, wheelbase, space.controller)
        return track(car, axle_reference, wheelbase, space.controller, about_axle=True)

    @property
    def _plan_space(self) -> Trajectory | None:
        """The action space ``trajectory``, whose controller executes plans; None for other action spaces."""
        return self.actions if isinstance(self.actions, Trajectory) else None

    def _wheelbase(self, length_m: Scalar) -> Scalar:
        """Return the wheelbase for a length, m; empty slots have length 0 and count as 1 m long."""
        tracking = self._plan_space.controller if self._plan_space else self.config.tracking
        return tracking.wheelbase * jnp.maximum(length_m, 1.0)
