"""Small worlds for checks, and variants that must not change results.

The variants differ in rotation and shift, order of agents, size and content of padding, or the future of the log.
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

#: Recordings of the built-in world: a roundabout, a crosswalk with pedestrians, a junction with lights.
_RECORDINGS = (0, 6, 8)
#: Steps of the moments.
_STEPS = (30, 45, 60, 75)
#: Changes of ego's log: offset to the left (m), rotation (rad), speed factor.
_OFFSETS = ((0.0, 0.0, 1.0), (1.7, 0.2, 1.5), (-4.0, -0.3, 0.0), (3.6, 3.0, 1.0), (-9.0, 0.1, 2.5))
#: Rotation of worlds, rad.
ANGLE = 1.3
#: Content of padding, which must not affect results.
GARBAGE = 777.0
_CAPACITY = replace(CAPACITIES["default"], name="testing", agents=40, parked=24)


@record
class Moments:
    """Facts of the previous step, situation, and first step of the episode; one moment per row."""

    before: Facts
    situation: Situation
    start: Array


def rotate_recording(recording: Recording, angle: float, dx: float, dy: float) -> Recording:
    """Return a recording rotated about the origin and shifted."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.array([[cos, sin], [-sin, cos]])

    def transform(points: Any) -> Any:
        return np.concatenate([points[..., :2] @ rotation + np.array([dx, dy]), points[..., 2:]], axis=-1)

    tracks = recording.tracks
    rotated_tracks = replace(
        tracks,
        xy=np.where(tracks.valid[..., None], transform(tracks.xy), 0.0),
        velocity=tracks.velocity @ rotation,
        heading=np.where(tracks.valid, (tracks.heading + angle + np.pi) % (2 * np.pi) - np.pi, 0.0),
    )
    features = tuple(replace(feature, points=transform(feature.points)) for feature in recording.features)
    lights = tuple(replace(light, stop_point=transform(light.stop_point)) for light in recording.lights)
    return replace(recording, tracks=rotated_tracks, features=features, lights=lights)


@cache
def worlds(angle: float = 0.0) -> ScenarioBank:
    """Return a bank of the worlds; with an angle they are rotated and shifted by several hundred metres."""
    recordings = [generate_recording(seed=0, index=index) for index in _RECORDINGS]
    if angle:
        recordings = [rotate_recording(recording, angle, 300.0, -700.0) for recording in recordings]
    scenarios = [assemble(recording, _CAPACITY) for recording in recordings]
    return ScenarioBank.from_scenarios(scenarios, trim=False)


@cache
def moments(angle: float = 0.0) -> Moments:
    """Return moments of the worlds, with ego at its logged pose, offset, rotated, fast and standing."""
    return jax.jit(_moments)(worlds(angle))


def _moments(bank: ScenarioBank) -> Moments:
    scenarios, steps, changes = np.meshgrid(
        np.arange(len(bank)), _STEPS, np.arange(len(_OFFSETS)), indexing="ij"
    )
    index, step = jnp.asarray(scenarios.ravel()), jnp.asarray(steps.ravel())
    offset = jnp.asarray(_OFFSETS)[changes.ravel()]
    # Measure the previous and the current step in one program.
    measure_all = jax.vmap(partial(_measure_offset, bank))
    pairs = measure_all(jnp.tile(index, 2), jnp.concatenate([step - 1, step]), jnp.tile(offset, (2, 1)))
    before, now = (jax.tree.map(lambda leaf, half=half: jnp.split(leaf, 2)[half], pairs) for half in (0, 1))
    return Moments(before.facts, now, step - 20)


def _measure_offset(bank: ScenarioBank, index: Array, step: Array, offset: Array) -> Situation:
    """Measure a step with ego's logged history offset, rotated and scaled in speed (:data:`_OFFSETS`)."""
    simulator = Simulator(Task())
    context = simulator.context(bank, index, step)
    x, y, heading, speed = jnp.moveaxis(context.history, -1, 0)
    left_m, rotation_rad, speed_factor = offset
    position = jnp.stack([x - left_m * jnp.sin(heading), y + left_m * jnp.cos(heading)], axis=-1)
    motion = jnp.stack([wrap(heading + rotation_rad), speed * speed_factor], axis=-1)
    context = replace(context, history=jnp.concatenate([position, motion], axis=-1))
    frame, previous_frame = (simulator.frame(bank, context, alone(context), back) for back in (0, 1))
    contacts = jnp.full(frame.valid.shape, int(Contact.APART), jnp.int8)
    lights = remember_lights(bank, context)
    return measure(bank, context, frame, previous_frame, contacts, lights, FACTS | ON_REQUEST)[0]


def permute_frame(frame: Frame) -> Frame:
    """Permute the slots of agents, except slot 0 of the driven agent."""
    order = order_of(frame.valid.shape[-1])
    return _map_agents(lambda leaf: leaf[:, order], frame)


def pad_frame(frame: Frame) -> Frame:
    """Append empty slots with garbage."""

    def pad(leaf: Array) -> Array:
        fill = False if leaf.dtype == bool else GARBAGE
        padding = jnp.full((leaf.shape[0], 8, *leaf.shape[2:]), fill).astype(leaf.dtype)
        return jnp.concatenate([leaf, padding], axis=1)

    return _map_agents(pad, frame)


def scatter_frame(frame: Frame) -> Frame:
    """Fill empty slots with garbage, except for booleans."""

    def fill(leaf: Array) -> Array:
        valid = frame.valid.reshape(*frame.valid.shape, *(1,) * (leaf.ndim - 2))
        return leaf if leaf.dtype == bool else jnp.where(valid, leaf, GARBAGE).astype(leaf.dtype)

    return _map_agents(fill, frame)


def frame_without_others(frame: Frame) -> Frame:
    """Keep only the driven agent."""
    return replace(frame, valid=frame.valid & (jnp.arange(frame.valid.shape[-1]) == 0))


def _map_agents(function: Callable[[Array], Array], frame: Frame) -> Frame:
    """Apply a function to all agent fields of a frame."""
    names = [field.name for field in fields(frame) if field.name != "lights"]
    return replace(frame, **{name: function(getattr(frame, name)) for name in names})


def with_frame(moments: Moments, frame: Frame) -> Moments:
    """Replace the frames of moments."""
    surroundings = replace(moments.situation.surroundings, frame=frame)
    return replace(moments, situation=replace(moments.situation, surroundings=surroundings))


def extremes(moments: Moments) -> Moments:
    """Set all facts to zero, and the speed limit to unknown."""

    def zero(facts: Facts) -> Facts:
        zeros = jax.tree.map(jnp.zeros_like, facts)
        return replace(zeros, limit_mps=jnp.full_like(facts.limit_mps, -1.0))

    situation = replace(moments.situation, facts=zero(moments.situation.facts))
    return replace(moments, before=zero(moments.before), situation=situation)


def without_facts(moments: Moments, reads: frozenset[str]) -> Moments:
    """Remove all facts except those in ``reads``."""

    def select(facts: Facts) -> Facts:
        # replace() would reject None, because it checks the types of fields.
        return jax.tree_util.tree_map_with_path(
            lambda path, fact: fact if path[0].name in reads else None, facts
        )

    situation = replace(moments.situation, facts=select(moments.situation.facts))
    return replace(moments, before=select(moments.before), situation=situation)


def permute_agents(bank: ScenarioBank) -> ScenarioBank:
    """Permute the slots of agents, except slot 0 of ego."""
    moving_slots = order_of(bank.agents.shape[2])
    parked_slots = np.random.default_rng(0).permutation(np.arange(len(moving_slots), bank.parked.shape[1]))
    slots = np.concatenate([moving_slots, parked_slots])
    return replace(
        bank,
        agents=bank.agents[:, :, moving_slots],
        extension=bank.extension[:, moving_slots],
        agent_box=bank.agent_box[:, slots],
        parked=bank.parked[:, slots],
        parked_when=bank.parked_when[:, :, slots],
    )


def pad_agents(bank: ScenarioBank, slots: int = 8) -> ScenarioBank:
    """Append empty slots for moving and for parked agents."""
    n, steps = bank.agents.shape[:2]
    return replace(
        bank,
        agents=jnp.concatenate([bank.agents, jnp.zeros((n, steps, slots, 8))], axis=2),
        agent_box=jnp.concatenate([bank.agent_box, jnp.zeros((n, slots, 4))], axis=1),
        extension=jnp.pad(bank.extension, ((0, 0), (0, slots), (0, 0), (0, 0))),
        parked=jnp.concatenate([bank.parked, jnp.zeros((n, slots, 8))], axis=1),
        parked_when=jnp.pad(bank.parked_when, ((0, 0), (0, 0), (0, slots))),
    )


def scatter_garbage(bank: ScenarioBank) -> ScenarioBank:
    """Fill the rows of absent agents with garbage."""
    valid = bank.agents[..., AgentColumn.VALID] > 0
    agents = jnp.where(valid[..., None], bank.agents, GARBAGE).at[..., AgentColumn.VALID].set(valid)
    ever_present = (bank.parked_when > 0).any(axis=1)[..., None]
    return replace(bank, agents=agents, parked=jnp.where(ever_present, bank.parked, GARBAGE))


def without_others(bank: ScenarioBank) -> ScenarioBank:
    """Remove all agents but ego."""
    others = jnp.arange(bank.agents.shape[2]) > 0
    agents = bank.agents.at[..., AgentColumn.VALID].multiply(~others)
    return replace(bank, agents=agents, parked_when=jnp.zeros_like(bank.parked_when))


def change_future(bank: ScenarioBank, step: int) -> ScenarioBank:
    """Change the log after ``step``: motions, lights and the log path. Route and goal stay, because ego knows them."""
    is_future = jnp.arange(bank.steps) > step
    agents = bank.agents.at[..., AgentColumn.XY].add(13.0).at[..., AgentColumn.VELOCITY].multiply(-1.0)
    agents = agents.at[..., AgentColumn.VALID].set(1.0 - bank.agents[..., AgentColumn.VALID])
    # States of observed lights are 0 to 8.
    light_state = (bank.light_state + 1) % 9
    return replace(
        bank,
        agents=jnp.where(is_future[None, :, None, None], agents, bank.agents),
        parked_when=bank.parked_when ^ as_words(np.asarray(is_future)[None, :, None]),
        light_state=jnp.where(is_future[None, :, None], light_state, bank.light_state),
        log_progress=jnp.where(is_future[None], bank.log_progress + 99.0, bank.log_progress),
        log_ahead=jnp.full_like(bank.log_ahead, 99.0),
        log_routes=bank.log_routes + 50.0,
        extension=bank.extension + 13.0,
    )


def order_of(slots: int) -> Any:
    """Return the original slot of each slot of a permuted world."""
    return np.append(0, np.random.default_rng(0).permutation(np.arange(1, slots)))


#: Variants of banks and frames in the order of ``contract.check_variants``.
BANK_VARIANTS = (scatter_garbage, pad_agents, permute_agents)
FRAME_VARIANTS = (scatter_frame, pad_frame, permute_frame)
