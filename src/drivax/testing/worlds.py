"""Small worlds in which a user's own terms are tried, and the same worlds told differently.

What a term may not depend on is changed here: the frame of the map, the order of the agents, how much padding there
is, what padding holds, and what happens later.
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
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Frame, Situation, Surroundings
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task

#: Recordings of the built-in world: a roundabout, a crosswalk with people, a junction with lights.
_RECORDINGS = (0, 6, 8)
#: Steps at which each is looked at.
_LOOKS = (30, 45, 60, 75)
#: Where ego is against its log: to the left (m), turned (rad), and its speed as a share of the log's.
_PLACES = ((0.0, 0.0, 1.0), (1.7, 0.2, 1.5), (-4.0, -0.3, 0.0), (3.6, 3.0, 1.0), (-9.0, 0.1, 2.5))
#: What padding is filled with where it must not matter.
GARBAGE = 777.0
_CAPACITY = replace(CAPACITIES["default"], name="testing", agents=40, parked=24)


@record
class Moments:
    """Measured moments, one per row.

    Attributes:
        before: Facts of the step before.
        found: The situation.
        start: Step at which the episode began.
    """

    before: Facts
    found: Situation
    start: Array


def turned(recording: Recording, angle: float, dx: float, dy: float) -> Recording:
    """The same world, rotated about the origin and shifted."""
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
    """The worlds, all of them turned by an angle and shifted by some hundred metres."""
    recordings = [generate_recording(seed=0, index=index) for index in _RECORDINGS]
    if angle:
        recordings = [turned(recording, angle, 300.0, -700.0) for recording in recordings]
    scenarios = [assemble(recording, _CAPACITY) for recording in recordings]
    return ScenarioBank.from_scenarios(scenarios, trim=False)


@cache
def moments(angle: float = 0.0) -> Moments:
    """Moments of the worlds: ego where the log has it, and beside, askew, fast and standing where it has not."""
    return jax.jit(_moments)(worlds(angle))


def _moments(bank: ScenarioBank) -> Moments:
    rows, steps, places = np.meshgrid(np.arange(len(bank)), _LOOKS, np.arange(len(_PLACES)), indexing="ij")
    before = jax.vmap(partial(_measured, bank))
    place = jnp.asarray(_PLACES)[places.ravel()]
    index, step = jnp.asarray(rows.ravel()), jnp.asarray(steps.ravel())
    # One program measures both sides of the step.
    both = before(jnp.tile(index, 2), jnp.concatenate([step - 1, step]), jnp.tile(place, (2, 1)))
    earlier, now = (jax.tree.map(lambda leaf, part=part: jnp.split(leaf, 2)[part], both) for part in (0, 1))
    return Moments(earlier.facts, now, step - 20)


def _measured(bank: ScenarioBank, index: Array, step: Array, place: Array) -> Situation:
    """What is measured when ego has driven like its log, but aside, askew and at another speed."""
    simulator = Simulator(Task())
    context = simulator.context(bank, index, step)
    x, y, heading, speed = jnp.moveaxis(context.history, -1, 0)
    aside, askew, pace = place
    shifted = jnp.stack([x - aside * jnp.sin(heading), y + aside * jnp.cos(heading)], axis=-1)
    moved = jnp.stack([wrap(heading + askew), speed * pace], axis=-1)
    context = replace(context, history=jnp.concatenate([shifted, moved], axis=-1))
    now, previous = (simulator.frame(bank, context, alone(context), back) for back in (0, 1))
    apart = jnp.full(now.valid.shape, int(Contact.APART), jnp.int8)
    return measure(bank, context, now, previous, apart, remember_lights(bank, context), FACTS | ON_REQUEST)[0]


def shuffled_frame(frame: Frame, seed: int = 0) -> Frame:
    """The same agents in other slots; the driven one (slot 0) stays."""
    order = order_of(frame.valid.shape[-1], seed)
    return _of_agents(lambda leaf: leaf[:, order], frame)


def padded_frame(frame: Frame, slots: int = 8) -> Frame:
    """The same agents with more empty slots, which hold garbage."""

    def pad(leaf: Array) -> Array:
        fill = False if leaf.dtype == bool else GARBAGE
        more = jnp.full((leaf.shape[0], slots, *leaf.shape[2:]), fill).astype(leaf.dtype)
        return jnp.concatenate([leaf, more], axis=1)

    return _of_agents(pad, frame)


def littered_frame(frame: Frame) -> Frame:
    """The same agents; slots that hold nobody hold garbage."""

    def fill(leaf: Array) -> Array:
        there = frame.valid.reshape(*frame.valid.shape, *(1,) * (leaf.ndim - 2))
        return leaf if leaf.dtype == bool else jnp.where(there, leaf, GARBAGE).astype(leaf.dtype)

    return _of_agents(fill, frame)


def deserted_frame(frame: Frame) -> Frame:
    """Nobody but the driven agent."""
    return replace(frame, valid=frame.valid & (jnp.arange(frame.valid.shape[-1]) == 0))


def _of_agents(change: Callable[[Array], Array], frame: Frame) -> Frame:
    """The frame with what it says of agents changed; lights are no agents."""
    names = [field.name for field in fields(frame) if field.name != "lights"]
    return replace(frame, **{name: change(getattr(frame, name)) for name in names})


def with_frame(moments: Moments, frame: Frame) -> Moments:
    """The same moments with everyone's frame replaced."""
    around = moments.found.surroundings
    around = Surroundings(frame, around.lanes, around.route)
    return replace(moments, found=Situation(moments.found.context, moments.found.facts, around))


def extremes(moments: Moments) -> Moments:
    """The same moments with nothing to measure: standing, no limit known, no route, every number zero."""

    def nothing(facts: Facts) -> Facts:
        still = jax.tree.map(jnp.zeros_like, facts)
        return replace(still, limit_mps=jnp.full_like(facts.limit_mps, -1.0))

    found = replace(moments.found, facts=nothing(moments.found.facts))
    return replace(moments, before=nothing(moments.before), found=found)


def without_facts(moments: Moments, reads: frozenset[str]) -> Moments:
    """The same moments of a task that asks for these facts only."""

    def kept(facts: Facts) -> Facts:
        return jax.tree_util.tree_map_with_path(
            lambda path, fact: fact if path[0].name in reads else None, facts
        )

    found = Situation(moments.found.context, kept(moments.found.facts), moments.found.surroundings)
    return Moments(kept(moments.before), found, moments.start)


def shuffled(bank: ScenarioBank, seed: int = 0) -> ScenarioBank:
    """The same scenarios with the agents in other slots; ego stays in slot 0."""
    moving = order_of(bank.agents.shape[2], seed)
    behind = np.random.default_rng(seed).permutation(np.arange(len(moving), bank.parked.shape[1]))
    everyone = np.concatenate([moving, behind])
    return replace(
        bank,
        agents=bank.agents[:, :, moving],
        extension=bank.extension[:, moving],
        agent_box=bank.agent_box[:, everyone],
        parked=bank.parked[:, everyone],
        parked_when=bank.parked_when[:, :, everyone],
    )


def padded(bank: ScenarioBank, slots: int = 8) -> ScenarioBank:
    """The same scenarios with more empty slots for agents."""
    n, steps = bank.agents.shape[:2]
    return replace(
        bank,
        agents=jnp.concatenate([bank.agents, jnp.zeros((n, steps, slots, 8))], axis=2),
        agent_box=jnp.concatenate([bank.agent_box, jnp.zeros((n, slots, 4))], axis=1),
        extension=jnp.pad(bank.extension, ((0, 0), (0, slots), (0, 0), (0, 0))),
        parked=jnp.concatenate([bank.parked, jnp.zeros((n, slots, 8))], axis=1),
        parked_when=jnp.pad(bank.parked_when, ((0, 0), (0, 0), (0, slots))),
    )


def littered(bank: ScenarioBank) -> ScenarioBank:
    """The same scenarios; rows of agents that are not there hold garbage."""
    there = bank.agents[..., AgentColumn.VALID] > 0
    agents = jnp.where(there[..., None], bank.agents, GARBAGE).at[..., AgentColumn.VALID].set(there)
    ever = (bank.parked_when > 0).any(axis=1)[..., None]
    return replace(bank, agents=agents, parked=jnp.where(ever, bank.parked, GARBAGE))


def deserted(bank: ScenarioBank) -> ScenarioBank:
    """The same roads with nobody on them but ego."""
    others = jnp.arange(bank.agents.shape[2]) > 0
    agents = bank.agents.at[..., AgentColumn.VALID].multiply(~others)
    return replace(bank, agents=agents, parked_when=jnp.zeros_like(bank.parked_when))


def forgotten(bank: ScenarioBank, step: int) -> ScenarioBank:
    """The same scenarios up to ``step``; what the log holds of later steps is another story.

    Others go somewhere else, lights turn, and the log's own path is gone. Route and goal remain: they are told to ego.
    """
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


def order_of(slots: int, seed: int = 0) -> Any:
    """Which slot each slot of a shuffled world was before."""
    order = np.random.default_rng(seed).permutation(np.arange(1, slots))
    return np.concatenate([[0], order])
