"""Measure once: from a scene and everyone's frame to the facts that metrics, rewards and planners share."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.angles import wrap
from drivax.geometry.boxes import corners
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.queries import (
    OFFROAD_TOLERANCE_M,
    around_lanes,
    left_the_map,
    light_crossing,
    offroad_distance,
    project_on_route,
    turns_right,
)
from drivax.scenario.schema import DT_S, LightState
from drivax.simulator.contact import (
    IGNORED,
    STOPPED_MPS,
    TOUCHING,
    judge_contacts,
    next_contacts,
    overlaps,
    time_to_collision,
)
from drivax.simulator.types import MOTION_SPEED, Facts, Frame, Scene, Situation, Surroundings

#: Lights of the route count while the agent is within this distance of it, m.
_ON_ROUTE_M = 2.0
#: A stop before a right turn on red: slower than this, this near, this recently.
_PAUSE_MPS, _PAUSE_M, PAUSE_STEPS = 0.5, 3.0, 30


def measure(
    bank: ScenarioBank, scene: Scene, frame: Frame, previous: Frame, contacts: Int[Array, " S"],
    light_pause: Int[Array, " L"],
) -> tuple[Situation, Int[Array, " S"], Int[Array, " L"]]:  # fmt: skip
    """Measures the driven agent of a scene.

    Args:
        bank: The scenarios.
        scene: The scene; its ``route_m`` is that of the step before.
        frame: Everyone now.
        previous: Everyone one step ago.
        contacts: Contact codes of the step before.
        light_pause: Steps since the agent last stood before each stop line.

    Returns:
        The situation (with ``route_m`` brought up to date), new contact codes, new light memory.
    """
    me, z = frame.box[scene.slot], frame.z[scene.slot]
    box_corners = corners(me)
    lanes = around_lanes(bank, scene.index, me[:2], me[2:4], box_corners, z)
    beyond = offroad_distance(bank, scene.index, me[:2], box_corners, lanes.points_near, z).max()
    left_map = left_the_map(bank, scene.index, me[:2])
    offroad = (beyond > OFFROAD_TOLERANCE_M) & ~left_map
    route = project_on_route(bank, scene.index, me[:2], scene.route_m)
    scene = replace(scene, route_m=jnp.maximum(scene.route_m, route.along_m))

    touching = overlaps(frame, scene.slot)
    codes = next_contacts(contacts, touching, frame.valid)
    fresh = (codes == TOUCHING) & (contacts != TOUCHING)
    speed = jnp.maximum(scene.history[-1, MOTION_SPEED], scene.history[-2, MOTION_SPEED])
    others_speed = jnp.maximum(_speed(frame), jnp.where(previous.valid, _speed(previous), 0.0))
    unlawful = lanes.leaving_lane | offroad
    at_fault, collision_type = judge_contacts(frame, scene.slot, fresh, speed, others_speed, unlawful)
    red, light_pause = _red_light(bank, scene, me, route.distance_m, light_pause)
    now, goal = scene.history[-1], bank.goal[scene.index]
    logged = bank.agents[scene.index, scene.step, scene.slot]
    acceleration, jerk, lateral = _rates(scene.history)
    facts = Facts(
        collision=(codes == TOUCHING).any(),
        at_fault=at_fault,
        collision_type=collision_type,
        offroad=offroad,
        offroad_m=beyond,
        left_map=left_map,
        red_light=red,
        ttc_s=time_to_collision(frame, scene.slot, codes == IGNORED),
        ttc_defined=now[MOTION_SPEED] >= STOPPED_MPS,
        speed_mps=now[MOTION_SPEED],
        limit_mps=lanes.limit,
        on_lane=lanes.near,
        wrong_way=lanes.wrong_way,
        straddling=lanes.straddling,
        moved_m=_norm(now[:2] - scene.history[-2, :2]),
        progress_m=scene.route_m,
        log_progress_m=bank.log_progress[scene.index, scene.step],
        route_deviation_m=route.distance_m,
        off_route=~lanes.on_corridor,
        log_divergence_m=_norm(now[:2] - logged[:2]),
        goal_distance_m=_norm(now[:2] - goal),
        lateral_acceleration_mps2=lateral,
        acceleration_mps2=acceleration,
        jerk_mps3=jerk,
    )
    return Situation(scene, facts, Surroundings(frame, lanes, route)), codes, light_pause


def _norm(vector: Float[Array, "... 2"]) -> Float[Array, ...]:
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def _speed(frame: Frame) -> Float[Array, " S"]:
    return _norm(frame.velocity)


def _rates(
    history: Float[Array, "16 4"],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Causal acceleration, jerk and lateral acceleration over the last 0.5 s."""
    speed, heading = history[:, 3], history[:, 2]
    acceleration = (speed[-1] - speed[-6]) / (5 * DT_S)
    before = (speed[-6] - speed[-11]) / (5 * DT_S)
    yaw_rate = wrap(heading[-1] - heading[-6]) / (5 * DT_S)
    return acceleration, (acceleration - before) / (5 * DT_S), yaw_rate * speed[-1]


def _red_light(
    bank: ScenarioBank,
    scene: Scene,
    me: Float[Array, 6],
    deviation: Float[Array, ""],
    pause: Int[Array, " L"],
) -> tuple[Bool[Array, ""], Int[Array, " L"]]:
    """Whether the front bumper ran a red light at this step (semantics, ``red_light``)."""
    half = me[4] / 2
    old = scene.history[-2]
    front = me[:2] + half * me[2:4]
    front_before = old[:2] + half * jnp.stack([jnp.cos(old[2]), jnp.sin(old[2])])
    crossed, before_m = light_crossing(bank, scene.index, front_before, front)
    last = bank.steps - 1
    now = bank.light_state[scene.index, jnp.clip(scene.step, 0, last)]
    then = bank.light_state[scene.index, jnp.clip(scene.step - 1, 0, last)]
    is_red = _red(now) & _red(then)
    # A stop shortly before the line, then a right turn, is lawful unless the light is a red arrow.
    arrow = (now == LightState.ARROW_STOP) | (then == LightState.ARROW_STOP)
    paused = jnp.minimum(pause, PAUSE_STEPS + 1) <= PAUSE_STEPS
    is_red &= ~(turns_right(bank, scene.index) & paused & ~arrow)
    line = bank.light_line[scene.index]
    fit = jnp.cos(line[:, 6] - jnp.arctan2(me[3], me[2]))
    best = jnp.argmax(jnp.where(crossed, fit, -2.0))
    off_route = (crossed & is_red & (fit >= fit[best] - 1e-6)).any()
    on_route = (crossed & is_red & (line[:, 7] > 0)).any()
    stands = (scene.history[-1, MOTION_SPEED] < _PAUSE_MPS) & (before_m >= 0.0) & (before_m < _PAUSE_M)
    pause = jnp.where(stands, 0, jnp.minimum(pause + 1, PAUSE_STEPS + 1)).astype(jnp.int8)
    return jnp.where(deviation <= _ON_ROUTE_M, on_route, off_route), pause


def _red(state: Int[Array, " L"]) -> Bool[Array, " L"]:
    return (state == LightState.ARROW_STOP) | (state == LightState.STOP)
