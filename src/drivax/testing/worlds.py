"""Small worlds for checks, and variants of them that must not change results.

Variants: rotation and shift of the map, order of agents, size and content of padding, the future of the log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank, as_words
from drivax.scenario.build.assemble import assemble
from drivax.scenario.record import record
from drivax.scenario.recording import Recording
from drivax.scenario.schema import CAPACITIES
from drivax.simulator.contact import Contact
from drivax.simulator.lights import remember_lights
from drivax.simulator.simulator import Simulator
from drivax.simulator.situation import measure
from drivax.simulator.traffic.log import alone
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Frame, Situation
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task

#: Recordings of the built-in world: a roundabout, a crosswalk with people, a junction with lights.
_RECORDINGS = (0, 6, 8)
#: Steps of the moments.
_STEPS = (30, 45, 60, 75)
#: Offsets of ego from its log: to the left (m), heading (rad), factor of speed.
_OFFSETS = ((0.0, 0.0, 1.0), (1.7, 0.2, 1.5), (-4.0, -0.3, 0.0), (3.6, 3.0, 1.0), (-9.0, 0.1, 2.5))
#: Rotation of worlds, rad.
ANGLE = 1.3
#: Content of padding that must not matter.
GARBAGE = 777.0
_CAPACITY = replace(CAPACITIES["default"], name="testing", agents=40, parked=24)


@record
class Moments:
    """Facts of the step before, the situation now, and the first step of the episode; one moment per row."""

    before: Facts
    situation: Situation
    start: Array


def turned(recording: Recording, angle: float, dx: float, dy: float) -> Recording:
    """Return the world rotated about the origin and shifted."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, sin], [-sin, cos]])

    def place(points: Any) -> Any:
        return np.concatenate([points[..., :2] @ turn + np.array([dx, dy]), points[..., 2:]], axis=-1)

    old = recording.tracks
    tracks = replace(
        old,
        xy=np.where(old.valid[..., None], place(old.xy), 0.0),
        velocity=old.velocity @ turn,
        heading=np.where(old.valid, (old.heading + angle + np.pi) % (2 * np.pi) - np.pi, 0.0),
    )
    features = tuple(replace(f, points=place(f.points)) for f in recording.features)
    lights = tuple(replace(light, stop_point=place(light.stop_point)) for light in recording.lights)
    return replace(recording, tracks=tracks, features=features, lights=lights)


@cache
def worlds(angle: float = 0.0) -> ScenarioBank:
    """Return the worlds, with an angle rotated and shifted by several hundred metres."""
    recordings = [generate_recording(seed=0, index=index) for index in _RECORDINGS]
    if angle:
        recordings = [turned(recording, angle, 300.0, -700.0) for recording in recordings]
    scenarios = [assemble(recording, _CAPACITY) for recording in recordings]
    return ScenarioBank.from_scenarios(scenarios, trim=False)


@cache
def moments(angle: float = 0.0) -> Moments:
    """Return moments of the worlds: ego at its logged pose, and offset, rotated, fast and standing."""
    return jax.jit(_moments)(worlds(angle))


def _moments(bank: ScenarioBank) -> Moments:
    rows, steps, places = np.meshgrid(np.arange(len(bank)), _STEPS, np.arange(len(_OFFSETS)), indexing="ij")
    before = jax.vmap(partial(_measured, bank))
    place = jnp.asarray(_OFFSETS)[places.ravel()]
    index, step = jnp.asarray(rows.ravel()), jnp.asarray(steps.ravel())
    # One program measures both sides of the step.
    both = before(jnp.tile(index, 2), jnp.concatenate([step - 1, step]), jnp.tile(place, (2, 1)))
    earlier, now = (jax.tree.map(lambda leaf, part=part: jnp.split(leaf, 2)[part], both) for part in (0, 1))
    return Moments(earlier.facts, now, step - 20)


def _measured(bank: ScenarioBank, index: Array, step: Array, place: Array) -> Situation:
    """Measure with ego's logged history offset, rotated and scaled in speed."""
    simulator = Simulator(Task())
    context = simulator.context(bank, index, step)
    x, y, heading, speed = jnp.moveaxis(context.history, -1, 0)
    left_m, turn_rad, pace = place
    shifted = jnp.stack([x - left_m * jnp.sin(heading), y + left_m * jnp.cos(heading)], axis=-1)
    moved = jnp.stack([wrap(heading + turn_rad), speed * pace], axis=-1)
    context = replace(context, history=jnp.concatenate([shifted, moved], axis=-1))
    now, previous = (simulator.frame(bank, context, alone(context), back) for back in (0, 1))
    apart = jnp.full(now.valid.shape, int(Contact.APART), jnp.int8)
    return measure(bank, context, now, previous, apart, remember_lights(bank, context), FACTS | ON_REQUEST)[0]


def shuffled_frame(frame: Frame) -> Frame:
    """Permute the slots of agents; the driven agent stays in slot 0."""
    order = order_of(frame.valid.shape[-1])
    return _of_agents(lambda leaf: leaf[:, order], frame)


def padded_frame(frame: Frame) -> Frame:
    """Append empty slots with garbage."""

    def pad(leaf: Array) -> Array:
        fill = False if leaf.dtype == bool else GARBAGE
        more = jnp.full((leaf.shape[0], 8, *leaf.shape[2:]), fill).astype(leaf.dtype)
        return jnp.concatenate([leaf, more], axis=1)

    return _of_agents(pad, frame)


def scattered_frame(frame: Frame) -> Frame:
    """Fill empty slots with garbage."""

    def fill(leaf: Array) -> Array:
        there = frame.valid.reshape(*frame.valid.shape, *(1,) * (leaf.ndim - 2))
        return leaf if leaf.dtype == bool else jnp.where(there, leaf, GARBAGE).astype(leaf.dtype)

    return _of_agents(fill, frame)


def frame_without_others(frame: Frame) -> Frame:
    """Keep only the driven agent."""
    return replace(frame, valid=frame.valid & (jnp.arange(frame.valid.shape[-1]) == 0))


def _of_agents(change: Callable[[Array], Array], frame: Frame) -> Frame:
    """Apply a change to all fields of agents."""
    names = [field.name for field in fields(frame) if field.name != "lights"]
    return replace(frame, **{name: change(getattr(frame, name)) for name in names})


def with_frame(moments: Moments, frame: Frame) -> Moments:
    """Replace the frames of moments."""
    around = replace(moments.situation.surroundings, frame=frame)
    return replace(moments, situation=replace(moments.situation, surroundings=around))


def extremes(moments: Moments) -> Moments:
    """Set all facts to zero: standing, unknown limit, no route."""

    def nothing(facts: Facts) -> Facts:
        still = jax.tree.map(jnp.zeros_like, facts)
        return replace(still, limit_mps=jnp.full_like(facts.limit_mps, -1.0))

    situation = replace(moments.situation, facts=nothing(moments.situation.facts))
    return replace(moments, before=nothing(moments.before), situation=situation)


def without_facts(moments: Moments, reads: frozenset[str]) -> Moments:
    """Remove all facts but these."""

    def only(facts: Facts) -> Facts:
        # replace() would check the types of the fields.
        return jax.tree_util.tree_map_with_path(
            lambda path, fact: fact if path[0].name in reads else None, facts
        )

    situation = replace(moments.situation, facts=only(moments.situation.facts))
    return replace(moments, before=only(moments.before), situation=situation)


def shuffled(bank: ScenarioBank) -> ScenarioBank:
    """Permute the slots of agents; ego stays in slot 0."""
    moving = order_of(bank.agents.shape[2])
    parked = np.random.default_rng(0).permutation(np.arange(len(moving), bank.parked.shape[1]))
    slots = np.concatenate([moving, parked])
    return replace(
        bank,
        agents=bank.agents[:, :, moving],
        extension=bank.extension[:, moving],
        agent_box=bank.agent_box[:, slots],
        parked=bank.parked[:, slots],
        parked_when=bank.parked_when[:, :, slots],
    )


def padded(bank: ScenarioBank, slots: int = 8) -> ScenarioBank:
    """Append empty slots for agents."""
    n, steps = bank.agents.shape[:2]
    return replace(
        bank,
        agents=jnp.concatenate([bank.agents, jnp.zeros((n, steps, slots, 8))], axis=2),
        agent_box=jnp.concatenate([bank.agent_box, jnp.zeros((n, slots, 4))], axis=1),
        extension=jnp.pad(bank.extension, ((0, 0), (0, slots), (0, 0), (0, 0))),
        parked=jnp.concatenate([bank.parked, jnp.zeros((n, slots, 8))], axis=1),
        parked_when=jnp.pad(bank.parked_when, ((0, 0), (0, 0), (0, slots))),
    )


def scattered(bank: ScenarioBank) -> ScenarioBank:
    """Fill the rows of absent agents with garbage."""
    there = bank.agents[..., AgentColumn.VALID] > 0
    agents = jnp.where(there[..., None], bank.agents, GARBAGE).at[..., AgentColumn.VALID].set(there)
    ever = (bank.parked_when > 0).any(axis=1)[..., None]
    return replace(bank, agents=agents, parked=jnp.where(ever, bank.parked, GARBAGE))


def without_others(bank: ScenarioBank) -> ScenarioBank:
    """Remove all agents but ego."""
    others = jnp.arange(bank.agents.shape[2]) > 0
    agents = bank.agents.at[..., AgentColumn.VALID].multiply(~others)
    return replace(bank, agents=agents, parked_when=jnp.zeros_like(bank.parked_when))


def other_future(bank: ScenarioBank, step: int) -> ScenarioBank:
    """Change the log after ``step``: other motions and lights, no log path. Ego knows route and goal, so they stay."""
    later = jnp.arange(bank.steps) > step
    moved = bank.agents.at[..., AgentColumn.XY].add(13.0).at[..., AgentColumn.VELOCITY].multiply(-1.0)
    moved = moved.at[..., AgentColumn.VALID].set(1.0 - bank.agents[..., AgentColumn.VALID])
    return replace(
        bank,
        agents=jnp.where(later[None, :, None, None], moved, bank.agents),
        parked_when=bank.parked_when ^ as_words(np.asarray(later)[None, :, None]),
        light_state=jnp.where(later[None, :, None], (bank.light_state + 1) % 9, bank.light_state),
        log_progress=jnp.where(later[None], bank.log_progress + 99.0, bank.log_progress),
        log_ahead=jnp.full_like(bank.log_ahead, 99.0),
        routes=bank.routes.at[:, 1].add(50.0),
        extension=bank.extension + 13.0,
    )


def order_of(slots: int) -> Any:
    """Return the former slot of each slot of a permuted world."""
    return np.append(0, np.random.default_rng(0).permutation(np.arange(1, slots)))


#: Variants of banks and frames in the order of ``contract.check_variants``.
BANK_VARIANTS = (scattered, padded, shuffled)
FRAME_VARIANTS = (scattered_frame, padded_frame, shuffled_frame)
