"""Records and protocols of the simulator (decision 0002), unbatched; ``vmap`` adds the batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol, cast, runtime_checkable

from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.queries import LaneHits, RouteHit
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record

#: Steps of recent motion in a context: comfort is a window of 15 accelerations, each smoothed over 8.
HISTORY = 23
#: x, y (m), heading (rad), speed (m/s, never negative).
Motion = Float[Array, " 4"]
MOTION_X, MOTION_Y, MOTION_HEADING, MOTION_SPEED = range(4)
#: Motions of the last 23 steps, the present one last.
History = Float[Array, "history 4"]
#: Action of a task, with D components.
Action = Float[Array, " D"]


@record
class AgentContext:
    """Everything that an observation depends on, except the bank; stored in replay buffers.

    Attributes:
        index: Row of the bank.
        step: Time step t in the log.
        slot: Slot of the driven agent (0: ego).
        history: x, y, heading, speed of the driven agent over the last 23 steps; the last row is the present step.
        action: Last executed action, within bounds and actuator rates, or that given to ``Simulator.replay``; D
            components (2 by default).
        route_m: Arc length of the agent along its route, m; never decreases.
        z: Height of the box centre, m; follows the nearest lane.
        traffic: State of the traffic model; an empty tuple for log replay.
        route: Row of the agent's route in the bank (:meth:`ScenarioBank.row_of`); None in banks with one ego per
            scenario, where it equals ``index``.
        conditions: Values ``[*batch, C]`` of ``Task.conditions``; an empty tuple for a task without conditions.
    """

    index: Int[Array, "*batch"]
    step: Int[Array, "*batch"]
    slot: Int[Array, "*batch"]
    history: Float[Array, "*batch history 4"]
    action: Float[Array, "*batch D"]
    route_m: Float[Array, "*batch"]
    z: Float[Array, "*batch"]
    traffic: Any
    route: Any = None
    conditions: Any = ()

    @property
    def row(self) -> Int[Array, "*batch"]:
        """Row of the route, goal, logged progress and last step of the agent in the bank."""
        return self.index if self.route is None else self.route


@record
class Frame:
    """All agents and lights at one step: S slots, each with a moving agent, a parked agent or none, and L lights.

    Attributes:
        box: x, y, cos, sin, length, width.
        velocity: m/s.
        z: Height of the box centre, m.
        valid: Whether the slot has an agent.
        kind: ``scenario.schema.AgentKind``.
        lights: ``scenario.schema.LightState``; negative where unobserved.
    """

    box: Float[Array, "*batch S 6"]
    velocity: Float[Array, "*batch S 2"]
    z: Float[Array, "*batch S"]
    valid: Bool[Array, "*batch S"]
    kind: Int[Array, "*batch S"]
    lights: Int[Array, "*batch L"]

    def at(self, slots: Int[Array, " K"]) -> Frame:
        """Return the frame of the given slots, unbatched."""
        agents = {name: getattr(self, name)[slots] for name in ("box", "velocity", "z", "valid", "kind")}
        return Frame(**agents, lights=self.lights)


@record
class Facts:
    """Scalar measurements of an agent at one step, kept in the state. Names carry units; the semantics define them.

    Facts outside ``Task.reads`` are None and not computed, except ``strand`` if ``lane_changed`` or ``merged`` is read.
    ``ttc_defined`` is false at standstill; ``limit_mps`` is -1 if unknown; ``routed``: the agent has a route on lanes,
    without which facts of progress, route and goal are undefined; ``logged``: the log has the agent at this step;
    ``ignored`` counts ignored overlaps.

    Measured only on request (``ON_REQUEST``): ``gap_m`` to the nearest agent, at most 50 m; ``lag_m`` behind the log
    along the agent's heading (negative: ahead of it); ``late_m`` behind the log along the route, and ``early_m`` ahead
    of where the log is a second later (both negative in between); ``completed``: share of the log's path from
    ``CURRENT_STEP`` to its end, in [0, 1], 1 if that path is shorter than 0.5 m; ``time_gap_s`` to the nearest obstacle
    ahead on the route (bumper to bumper, over the agent's speed), at most 10 s; ``strand`` of the agent's lane
    (``scenario.bank.queries.lane_passage``); ``lane_changed`` and ``merged``, at this step.
    """

    collision: Bool[Array, "*batch"]
    at_fault: Bool[Array, "*batch"]
    collision_type: Int[Array, "*batch"]
    offroad: Bool[Array, "*batch"]
    offroad_m: Float[Array, "*batch"]
    left_map: Bool[Array, "*batch"]
    red_light: Bool[Array, "*batch"]
    ttc_s: Float[Array, "*batch"]
    ttc_defined: Bool[Array, "*batch"]
    speed_mps: Float[Array, "*batch"]
    limit_mps: Float[Array, "*batch"]
    routed: Bool[Array, "*batch"]
    logged: Bool[Array, "*batch"]
    ignored: Int[Array, "*batch"]
    wrong_way: Bool[Array, "*batch"]
    straddling: Bool[Array, "*batch"]
    moved_m: Float[Array, "*batch"]
    progress_m: Float[Array, "*batch"]
    route_deviation_m: Float[Array, "*batch"]
    off_route: Bool[Array, "*batch"]
    log_divergence_m: Float[Array, "*batch"]
    goal_distance_m: Float[Array, "*batch"]
    lateral_acceleration_mps2: Float[Array, "*batch"]
    acceleration_mps2: Float[Array, "*batch"]
    jerk_mps3: Float[Array, "*batch"]
    gap_m: Any = None
    lag_m: Any = None
    late_m: Any = None
    early_m: Any = None
    completed: Any = None
    time_gap_s: Any = None
    strand: Any = None
    lane_changed: Any = None
    merged: Any = None


#: Facts measured only if requested by name.
ON_REQUEST = frozenset(
    {"gap_m", "lag_m", "late_m", "early_m", "completed", "time_gap_s", "strand", "lane_changed", "merged"}
)
#: Names of all other facts.
FACTS = frozenset(field.name for field in fields(cast(Any, Facts))) - ON_REQUEST


@record
class Surroundings:
    """Frame, nearby lanes and route position of an agent; never carried between steps."""

    frame: Frame
    lanes: LaneHits
    route: RouteHit


@record
class Situation:
    """A context with its measurements."""

    context: AgentContext
    facts: Facts
    surroundings: Surroundings


@record
class LightMemory:
    """Memory of stop lines."""

    pause: Int[Array, "*batch L"]  # Steps since the agent last stood before the line; saturates
    # Steps since the agent crossed the line while off its route, from 1 on, until the crossing is decided: positive if
    # it was against a red light, negative otherwise, 0 without a crossing
    crossed: Int[Array, "*batch L"]


@record
class EpisodeStart:
    """First context of an episode, its stop-line memory, and the agent's strand 1.5 s before, if measured."""

    context: AgentContext
    lights: LightMemory
    strand: Any = None


@record
class SimState:
    """State of one driven agent in one scenario.

    Attributes:
        context: What observations depend on.
        facts: Latest measurement.
        contacts: Code per slot (``simulator.contact.Contact``).
        lights: Memory of each stop line.
        episode: Accumulators of the task's metrics since ``start``.
        start: First step of the episode.
    """

    context: AgentContext
    facts: Facts
    contacts: Int[Array, "*batch S"]
    lights: LightMemory
    episode: Any
    start: Int[Array, "*batch"]


@record
class Transition:
    """One step; where a collector begins the next episode, ``after`` is the state after the reset.

    Attributes:
        before, after: States before and after the step.
        action: Requested action, in the action space.
        reward: Weighted sum of the reward terms.
        reward_terms: Each weighted term by name.
        terminated: The episode ended for good: bootstrap zero.
        truncated: The log (or the map) ended: bootstrap the value of ``after``.
    """

    before: SimState
    after: SimState
    action: Float[Array, "*batch D"]
    reward: Float[Array, "*batch"]
    reward_terms: dict[str, Float[Array, "*batch"]]
    terminated: Bool[Array, "*batch"]
    truncated: Bool[Array, "*batch"]


@runtime_checkable
class Traffic(Protocol):
    """Motion of the agents that are not driven.

    A model that needs precomputed data also has ``prepare(bank) -> bank``, which evaluation and training call.
    """

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Any:
        """Return the traffic state at a step of the log."""
        ...

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> Any:
        """Return the traffic state one step later; ``frame`` is the present frame."""
        ...

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return the rows of ``bank.agents`` for the moving slots ``back`` steps ago."""
        ...


@runtime_checkable
class Task(Protocol):
    """Action space, observation, reward and episode end; implemented by ``tasks.Task``."""

    @property
    def reads(self) -> frozenset[str]:
        """Names of the facts to measure."""
        ...

    def motion(self, motion: Motion, action: Action, length: Any) -> Motion:
        """Return the next motion of the driven agent, whose box is ``length`` metres long."""
        ...

    def actuate(self, bank: ScenarioBank, context: AgentContext, action: Action) -> Action:
        """Return the executed action for a requested ``action``."""
        ...

    def coast(self, bank: ScenarioBank, context: AgentContext) -> Action:
        """Return the action that keeps speed and heading."""
        ...

    def first_action(self, history: History, length: Any) -> Action:
        """Return the previous action at the start of an episode; its size is that of every action."""
        ...

    def draw_conditions(self, slot: Any, key: Any) -> Any:
        """Return the conditions of an agent's episode: drawn by ``key``, or those of evaluation if it is None."""
        ...

    def observe(
        self, bank: ScenarioBank, context: AgentContext, frames: Any, frame: Frame
    ) -> Mapping[str, Any]:
        """Return the observation of a context; ``frames(k)`` is the frame k steps ago, ``frame`` the present one."""
        ...

    def reward(
        self, before: Facts, now: Facts, around: Surroundings, conditions: Any = ()
    ) -> dict[str, Float[Array, ""]]:
        """Return the weighted reward terms by name; ``conditions`` are those of the context."""
        ...

    def check_end(
        self, bank: ScenarioBank, context: AgentContext, facts: Facts
    ) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Return whether the episode is terminated, and whether it is truncated."""
        ...

    def episode_start(self) -> Any:
        """Return empty metric accumulators."""
        ...

    def episode_add(
        self, episode: Any, situation: Situation, start: Int[Array, ""], final: Bool[Array, ""]
    ) -> Any:
        """Return the accumulators after a step to ``situation``; the episode started at step ``start``.

        ``final`` marks the last step of the episode.
        """
        ...
