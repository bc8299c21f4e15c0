"""Step values: quantities of one step, which an episode accumulates into metrics.

A step value names the facts that it reads, so that only the facts of selected metrics are computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.metrics.comfort import TAIL, ComfortSteps, check_comfort
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Situation


@record
class Value:
    """Value of a metric, and whether it is defined."""

    value: Float[Array, "*batch"]
    defined: Bool[Array, "*batch"]


@dataclass(frozen=True, eq=False)
class Moment:
    """One measured step of an episode.

    Attributes:
        situation: Context, facts and surroundings.
        start: First step of the episode.
        final: Whether the episode ends at this step; its last steps are then evaluated for comfort.
    """

    situation: Situation
    start: Int[Array, ""]
    final: Bool[Array, ""]

    @property
    def facts(self) -> Facts:
        """Facts of the situation."""
        return self.situation.facts

    @cached_property
    def comfort(self) -> tuple[ComfortSteps, Bool[Array, " tail"]]:
        """Comfort of the last twelve steps, and a mask of those that count.

        A step after the start counts if it is the oldest of the twelve, or if the episode ends now.
        """
        step = self.situation.context.step - (TAIL - 1) + jnp.arange(TAIL)
        counts = (step > self.start) & (self.final | (jnp.arange(TAIL) == 0))
        return check_comfort(self.situation.context.history), counts


#: Function of a moment that returns a number, or several along one axis, and whether they are defined.
Read = Callable[[Moment], tuple[Array, Any]]


@dataclass(frozen=True)
class StepValue:
    """A quantity of a step.

    Attributes:
        name: Name of the quantity.
        unit: Unit, ``-`` for booleans and codes.
        read: Function of a moment that returns the value, and whether it is defined.
        reads: Names of the facts that ``read`` needs; by default all but those measured on request.
        delayed: Whether the value is computed several steps later, at the end of an episode for several steps at once.
    """

    name: str
    unit: str
    read: Read
    reads: frozenset[str] = FACTS
    delayed: bool = False

    def __post_init__(self) -> None:
        for name in self.reads:
            if name not in FACTS | ON_REQUEST:
                raise ValueError(f"the step value {self.name!r} reads unknown fact {name!r}")


def _fact(name: str, unit: str, fact: str, defined: str = "") -> StepValue:
    """Return the step value of a fact; ``defined`` names the fact that says whether it is defined."""

    def read(moment: Moment) -> tuple[Array, Any]:
        return getattr(moment.facts, fact), getattr(moment.facts, defined) if defined else True

    return StepValue(name, unit, read, frozenset({fact, defined} if defined else {fact}))


def _speeding(moment: Moment) -> tuple[Array, Array]:
    excess = jnp.maximum(0.0, moment.facts.speed_mps - moment.facts.limit_mps)
    has_limit = moment.facts.limit_mps > 0
    return jnp.where(has_limit, excess, 0.0), has_limit


def _wrong_way(moment: Moment) -> tuple[Array, bool]:
    return jnp.where(moment.facts.wrong_way, moment.facts.moved_m, 0.0), True


def _comfort(name: str, unit: str, field: str) -> StepValue:
    def read(moment: Moment) -> tuple[Array, Array]:
        steps, counts = moment.comfort
        return getattr(steps, field), counts

    return StepValue(name, unit, read, frozenset(), delayed=True)


_ALL = (
    _fact("collision", "-", "collision"),
    _fact("at_fault_collision", "-", "at_fault"),
    _fact("collision_type", "-", "collision_type"),
    _fact("offroad", "-", "offroad"),
    _fact("left_map", "-", "left_map"),
    _fact("red_light", "-", "red_light"),
    _fact("ttc", "s", "ttc_s", "ttc_defined"),
    StepValue("speeding", "m/s", _speeding, frozenset({"speed_mps", "limit_mps"})),
    StepValue("wrong_way", "m", _wrong_way, frozenset({"wrong_way", "moved_m"})),
    StepValue("lane_straddle", "s", lambda m: (m.facts.straddling * DT_S, True), frozenset({"straddling"})),
    _fact("route_deviation", "m", "route_deviation_m"),
    _fact("off_route", "-", "off_route"),
    _fact("log_divergence", "m", "log_divergence_m", "logged"),
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
    """Return step values of a situation, for tables and plots; by default all that are not delayed.

    The situation must contain the facts that the values read (with ``metrics: full`` it contains all facts). Comfort
    needs the eleven following steps and is undefined here; :func:`drivax.metrics.comfort.check_trip_comfort` evaluates
    a whole trip.
    """
    if values is None:
        values = [value for value in STEP_VALUES.values() if not value.delayed]
    moment = Moment(situation, situation.context.step, jnp.zeros((), bool))
    result = {}
    for value in values:
        number, defined = value.read(moment)
        result[value.name] = Value(number.astype(jnp.float32), jnp.asarray(defined, bool))
    return result
