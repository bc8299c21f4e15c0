"""Records of the simulator (decision 0002). Unbatched; ``vmap`` adds the batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol, cast, runtime_checkable

from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.queries import LaneHits, RouteHit
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record

#: Rows of recent motion that a context carries: the 15-sample comfort window needs one more speed than accelerations.
HISTORY = 16
MOTION_X, MOTION_Y, MOTION_HEADING, MOTION_SPEED = range(4)


@record
class AgentContext:
    """All that an observation depends on in addition to the bank; what a replay buffer stores.

    Attributes:
        index: Row of the bank.
        step: Time step t in the log.
        slot: Agent slot that is driven (0: ego).
        history: x, y, heading, speed of the driven agent over the last 16 steps; the last row is now.
        action: The last action as it was carried out, within bounds and actuator rates; D numbers (2 by default).
        route_m: Arc length along the route to the goal, m; never decreases.
        z: Height of the box centre, m; follows the nearest lane.
        traffic: State of the traffic model; an empty tuple where the others replay the log.
    """

    index: Int[Array, "*batch"]
    step: Int[Array, "*batch"]
    slot: Int[Array, "*batch"]
    history: Float[Array, "*batch 16 4"]
    action: Float[Array, "*batch D"]
    route_m: Float[Array, "*batch"]
    z: Float[Array, "*batch"]
    traffic: Any


@record
class Frame:
    """All agents at one step: in each of the S slots a moving or a parked agent, or none; and the L lights.

    Attributes:
        box: x, y, cos, sin, length, width.
        velocity: m/s.
        z: Height of the box centre, m.
        valid: Whether the agent is there.
        kind: ``scenario.schema.AgentKind``.
        lights: ``scenario.schema.LightState``; negative where nothing was seen.
    """

    box: Float[Array, "*batch S 6"]
    velocity: Float[Array, "*batch S 2"]
    z: Float[Array, "*batch S"]
    valid: Bool[Array, "*batch S"]
    kind: Int[Array, "*batch S"]
    lights: Int[Array, "*batch L"]


@record
class Facts:
    """What was measured at one pose, as scalars; kept in the state. Units in names; definitions in the semantics.

    ``ttc_defined`` is false while standing; ``limit_mps`` is -1 where no limit is known; ``routed`` says whether the
    agent has a route of its own (ego, on lanes), without which progress and ``off_route`` mean nothing; ``logged``
    whether the log has the agent at this step; ``ignored`` counts overlaps that do not count. A fact that the task does
    not ask for (``Task.reads``) is neither measured nor carried: it is None.

    The last five are measured for who names them only (``ON_REQUEST``): ``gap_m`` to the nearest other, at most 50 m;
    ``lag_m``, how far ahead the log has the agent, along the agent's heading (negative: behind);
    ``strand`` of lanes that the agent is on (``scenario.bank.passages``), and whether it changed lanes or merged
    just now.
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
    strand: Any = None
    lane_changed: Any = None
    merged: Any = None


#: Facts that few look at, measured only where they are asked for by name.
ON_REQUEST = frozenset({"gap_m", "lag_m", "strand", "lane_changed", "merged"})
#: Names of all other facts.
FACTS = frozenset(field.name for field in fields(cast(Any, Facts))) - ON_REQUEST


@record
class Surroundings:
    """What was found around a pose; arrays, never carried from step to step."""

    frame: Frame
    lanes: LaneHits
    route: RouteHit


@record
class Situation:
    """A context, measured."""

    context: AgentContext
    facts: Facts
    surroundings: Surroundings


@record
class LightMemory:
    """What is remembered about stop lines.

    Attributes:
        pause: Steps since the agent last stood before the line; saturates.
        crossed: Steps since it crossed the line off its route, until evaluation: positive where the light was red,
            negative where not, 0 for none.
    """

    pause: Int[Array, "*batch L"]
    crossed: Int[Array, "*batch L"]


@record
class Beginning:
    """How an episode begins: its context, and the memory of stop lines that led there."""

    context: AgentContext
    lights: LightMemory


@record
class SimState:
    """State of one driven agent in one scenario.

    Attributes:
        context: What observations depend on.
        facts: The last measurement.
        contacts: Code per slot (``simulator.contact.Contact``).
        lights: What is remembered about each stop line.
        episode: Accumulators of the task's metrics since ``start``.
        start: Step at which the episode began.
    """

    context: AgentContext
    facts: Facts
    contacts: Int[Array, "*batch S"]
    lights: LightMemory
    episode: Any
    start: Int[Array, "*batch"]


@record
class Transition:
    """One step. ``after`` is the state that the step led to, never a reset state.

    Attributes:
        before, after: States on both sides.
        action: What was asked for, in the action space.
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
    """How agents that are not driven moves; ``name`` is what tables call it.

    A model that needs something precomputed also has ``prepare(bank) -> bank``, which evaluation calls.
    """

    @property
    def name(self) -> str:
        """As printed in tables."""
        ...

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Any:
        """Traffic state at a step of the log."""
        ...

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> Any:
        """Traffic state one step later, given the present frame."""
        ...

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Rows of ``bank.agents`` for the moving slots ``back`` steps ago."""
        ...


@runtime_checkable
class Task(Protocol):
    """What makes it a learning problem; satisfied by ``tasks.Task``, which the simulator never imports."""

    @property
    def reads(self) -> frozenset[str]:
        """Names of the facts that anything here looks at; no others are measured."""
        ...

    def motion(
        self, motion: Float[Array, " 4"], action: Float[Array, " D"], length: Any
    ) -> Float[Array, " 4"]:
        """Next motion of the driven agent for an action of the task's action space."""
        ...

    def actuated(
        self, motion: Float[Array, " 4"], action: Float[Array, " D"], last: Float[Array, " D"]
    ) -> Float[Array, " D"]:
        """What is carried out when ``action`` is asked for and ``last`` was carried out a step ago."""
        ...

    def first_action(self, history: Float[Array, "16 4"], length: Any) -> Float[Array, " D"]:
        """What counts as the last action when an episode begins; its size is that of every action."""
        ...

    def observe(
        self, bank: ScenarioBank, context: AgentContext, agents: Any, frame: Frame
    ) -> Mapping[str, Any]:
        """Observation of a context."""
        ...

    def reward(self, before: Facts, now: Facts, around: Surroundings) -> dict[str, Float[Array, ""]]:
        """Weighted reward terms by name."""
        ...

    def ended(
        self, bank: ScenarioBank, context: AgentContext, facts: Facts
    ) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether the episode is terminated, and whether it is truncated."""
        ...

    def episode_start(self) -> Any:
        """Empty metric accumulators."""
        ...

    def episode_add(
        self, episode: Any, situation: Situation, start: Int[Array, ""], final: Bool[Array, ""]
    ) -> Any:
        """Accumulators after the step that led to ``situation``, in an episode that began at step ``start``."""
        ...
