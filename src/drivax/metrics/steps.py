"""Step values: what is read off a measured step, before an episode adds it up.

A step value reads a :class:`Moment` and gives numbers with weights: 0 where it is undefined. ``reads`` names the facts
that it looks at, so that what no selected metric needs is neither measured nor carried; one that does not say reads
them all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from drivax.metrics.comfort import TAIL, ComfortSteps, check_comfort
from drivax.metrics.scores import Value
from drivax.scenario.schema import DT_S
from drivax.simulator.types import FACTS, Facts, Situation


@dataclass(frozen=True, eq=False)
class Moment:
    """One measured step of an episode.

    Attributes:
        found: The situation.
        start: Step at which the episode began.
        final: Whether the episode ends here, so that the comfort of its last steps is evaluated too.
    """

    situation: Situation
    start: Int[Array, ""]
    final: Bool[Array, ""]

    @property
    def facts(self) -> Facts:
        """What was measured."""
        return self.situation.facts

    @cached_property
    def comfort(self) -> tuple[ComfortSteps, Bool[Array, " tail"]]:
        """The last twelve steps, and which of them are evaluated now: the oldest, and all at the end."""
        step = self.situation.context.step - (TAIL - 1) + jnp.arange(TAIL)
        counts = (step > self.start) & (self.final | (jnp.arange(TAIL) == 0))
        return check_comfort(self.situation.context.history), counts


#: Numbers, of no axis or one, and whether each is defined.
Read = Callable[[Moment], tuple[Array, Any]]


@dataclass(frozen=True)
class StepValue:
    """A number of a step.

    Attributes:
        name: What it is called.
        unit: Its unit, ``-`` for booleans and codes.
        read: The value at a moment and whether it is defined (a boolean, or a plain True).
        reads: Names of the facts that ``read`` looks at.
        delayed: Judged some steps later, several at once; not a number of its own step.
    """

    name: str
    unit: str
    read: Read
    reads: frozenset[str] = FACTS
    delayed: bool = False


def _fact(name: str, unit: str, fact: str) -> StepValue:
    """A fact that is always defined."""
    return StepValue(name, unit, lambda m: (getattr(m.facts, fact), True), frozenset({fact}))


def _speeding(moment: Moment) -> tuple[Array, Array]:
    over = jnp.maximum(0.0, moment.facts.speed_mps - moment.facts.limit_mps)
    known = moment.facts.limit_mps > 0
    return jnp.where(known, over, 0.0), known


def _comfort(name: str, unit: str, part: str) -> StepValue:
    def read(moment: Moment) -> tuple[Array, Array]:
        steps, counts = moment.comfort
        return getattr(steps, part), counts

    return StepValue(name, unit, read, frozenset(), delayed=True)


_ALL = (
    _fact("collision", "-", "collision"),
    _fact("at_fault_collision", "-", "at_fault"),
    _fact("collision_type", "-", "collision_type"),
    _fact("offroad", "-", "offroad"),
    _fact("left_map", "-", "left_map"),
    _fact("red_light", "-", "red_light"),
    StepValue(
        "ttc", "s", lambda m: (m.facts.ttc_s, m.facts.ttc_defined), frozenset({"ttc_s", "ttc_defined"})
    ),
    StepValue("speeding", "m/s", _speeding, frozenset({"speed_mps", "limit_mps"})),
    StepValue(
        "wrong_way",
        "m",
        lambda m: (jnp.where(m.facts.wrong_way, m.facts.moved_m, 0.0), True),
        frozenset({"wrong_way", "moved_m"}),
    ),
    StepValue("lane_straddle", "s", lambda m: (m.facts.straddling * DT_S, True), frozenset({"straddling"})),
    _fact("route_deviation", "m", "route_deviation_m"),
    _fact("off_route", "-", "off_route"),
    StepValue(
        "log_divergence",
        "m",
        lambda m: (m.facts.log_divergence_m, m.facts.logged),
        frozenset({"log_divergence_m", "logged"}),
    ),
    _fact("goal_distance", "m", "goal_distance_m"),
    _fact("progress", "m", "progress_m"),
    _fact("distance", "m", "moved_m"),
    _fact("ignored", "-", "ignored"),
    _comfort("comfort", "-", "comfortable"),
    _comfort("jerk", "m/s3", "jerk_mps3"),
    _comfort("lateral_acceleration", "m/s2", "lateral_mps2"),
)
STEP_VALUES: dict[str, StepValue] = {value.name: value for value in _ALL}


def step_metrics(situation: Situation, values: Sequence[StepValue] | None = None) -> dict[str, Value]:
    """Step values of one situation, for tables and plots.

    Comfort needs the seven steps that follow; :func:`drivax.metrics.comfort.check_trip_comfort` evaluates a whole trip.

    Args:
        situation: Its facts must hold what the values read (a task with ``metrics: full`` holds all).
        values: Which; by default all that belong to one step.
    """
    never = jnp.zeros((), bool)
    moment = Moment(situation, situation.context.step, never)
    result = {}
    for value in values or [v for v in STEP_VALUES.values() if not v.delayed]:
        number, defined = value.read(moment)
        result[value.name] = Value(number.astype(jnp.float32), jnp.asarray(defined, bool))
    return result
