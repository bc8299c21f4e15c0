"""Reward terms and their weights: functions of the facts before and now (docs/guide/rewards.md).

A term is in [0, 1] where it can be; its weight gives sign and size. A term whose facts are undefined (unknown limit, no
lanes, no route) is 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, make_dataclass
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool

from drivax.plugins import check_unique, name_of
from drivax.scenario.bank.scenario_bank import Scalar
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import FARTHEST_GAP_M, TTC_HORIZON_S
from drivax.simulator.situation import LONGEST_GAP_S
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Surroundings

Term = Callable[[Facts, Facts, Surroundings], Scalar]

#: Progress in one step, at 12 m/s, for which ``progress`` is 1.
_PROGRESS_SCALE_M = 12.0 * DT_S
#: Speeding by more than this is penalised, m/s (5 mph).
_SPEEDING_MPS = 2.23
#: Time to collision below which ``ttc_shortfall`` is positive, s (as for the published aggressive driver).
_MIN_TTC_S = 1.0
#: nuPlan's limits of jerk and lateral acceleration; their sum is the unpublished "max" of the published comfort.
_JERK_MPS3, _LATERAL_MPS2 = 8.37, 4.89
#: nuPlan's limits of braking and of acceleration.
_BRAKING_MPS2, _ACCELERATION_MPS2 = 4.05, 2.40
#: Length scales of ``pace`` behind and ahead of the log, m; distance ahead without a penalty, m.
_LATE_M, _EARLY_M, _EARLY_SLACK_M = 2.0, 8.0, 1.0
#: Distance from the route at which ``route_offset`` is 1, m; time to collision at which ``urgency`` is 0, s.
_ROUTE_OFFSET_M, _URGENT_S = 1.0, 2.0
#: Maximum of distances from the log, m.
_MAX_LOG_DISTANCE_M = 10.0
#: The goal is reached within this distance, m.
_GOAL_M = 3.0
#: Options of terms, and the largest value of each.
OPTIONS = {
    "collision_margin_m": FARTHEST_GAP_M, "ttc_s": TTC_HORIZON_S, "close_m": FARTHEST_GAP_M, "desired_speed": 2.0,
    "time_gap_s": LONGEST_GAP_S,
}  # fmt: skip


@dataclass(frozen=True)
class RewardTerm:
    """A built-in term.

    Attributes:
        function: Function of the facts before and now, and the surroundings.
        reads: Facts that the function reads.
        option: Field of :class:`RewardConfig` that it takes as a fourth argument.
        softened: Whether the terms in :data:`SOFT_FACTORS` lower it.
    """

    function: Callable[..., Scalar]
    reads: frozenset[str]
    option: str | None = None
    softened: bool = False

    def __call__(self, before: Facts, now: Facts, around: Surroundings, *option: Any) -> Scalar:
        """Return the value of the term."""
        return self.function(before, now, around, *option)


#: Built-in terms by name, in the order of their definition.
TERMS: dict[str, RewardTerm] = {}


def reward_term(*reads: str, option: str | None = None, softened: bool = False) -> Callable[[Any], Any]:
    """Register a function, which reads these facts, as the built-in term of its name.

    Use it only in this module: :class:`RewardConfig` has fields for the terms registered before it. For your own terms,
    use :class:`OwnTerm`.
    """

    def register(function: Any) -> Any:
        TERMS[function.__name__] = RewardTerm(function, frozenset(reads), option, softened)
        return function

    return register


def _event(condition: Bool[Array, ""]) -> Scalar:
    """Return 1.0 if a condition holds, else 0.0."""
    return condition.astype(jnp.float32)


def _event_term(name: str, fact: str, documentation: str) -> None:
    """Register a term with a docstring that is 1 at the steps at which a boolean fact holds."""

    def term(before: Facts, now: Facts, around: Surroundings) -> Scalar:
        return _event(getattr(now, fact))

    term.__name__, term.__doc__ = name, documentation
    reward_term(fact)(term)


@reward_term("collision", option="collision_margin_m")
def collision(before: Facts, now: Facts, around: Surroundings, collision_margin_m: float = 0.0) -> Scalar:
    """1 while the agent touches another, or is closer than the margin; ignored overlaps do not count."""
    return _event(now.collision | (now.gap_m < collision_margin_m) if collision_margin_m else now.collision)


_event_term("offroad", "offroad", "1 while a corner is off the road.")
_event_term("red_light", "red_light", "1 at a step that runs a red light.")
_event_term("off_route", "off_route", "1 while off the corridor of the route.")


@reward_term("routed", "progress_m")
def progress(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Progress along the route as a share of that at 12 m/s, in [0, 1]; 0 without a route."""
    return now.routed * jnp.clip((now.progress_m - before.progress_m) / _PROGRESS_SCALE_M, 0.0, 1.0)


@reward_term("acceleration_mps2", "lateral_acceleration_mps2", "jerk_mps3")
def discomfort(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Largest of acceleration, lateral acceleration and jerk over nuPlan's limits, squared, in [0, 1].

    All are causal differences over 0.5 s, so that the reward never depends on future steps.
    """
    acceleration = now.acceleration_mps2
    along = jnp.where(acceleration < 0, acceleration / _BRAKING_MPS2, acceleration / _ACCELERATION_MPS2)
    ratios = jnp.stack([along, now.lateral_acceleration_mps2 / _LATERAL_MPS2, now.jerk_mps3 / _JERK_MPS3])
    return jnp.clip(jnp.max(ratios * ratios), 0.0, 1.0)


@reward_term("limit_mps", "speed_mps")
def speeding(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 while faster than a known limit by more than 2.23 m/s."""
    return _event((now.limit_mps > 0) & (now.speed_mps > now.limit_mps + _SPEEDING_MPS))


@reward_term("routed", "progress_m")
def any_progress(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 on any progress along the route (published); 0 without a route."""
    return _event(now.routed & (now.progress_m > before.progress_m))


@reward_term("lateral_acceleration_mps2", "jerk_mps3")
def comfort(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 - min(1, (jerk + lateral acceleration) / max), in [0, 1] (published).

    The magnitudes, in m/s3 and m/s2, are causal over 0.5 s; ``max`` is 8.37 + 4.89, nuPlan's limits of both.
    """
    magnitude = jnp.abs(now.jerk_mps3) + jnp.abs(now.lateral_acceleration_mps2)
    return 1.0 - jnp.minimum(1.0, magnitude / (_JERK_MPS3 + _LATERAL_MPS2))


@reward_term("limit_mps", "speed_mps")
def any_speeding(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 while faster than a known limit (published)."""
    return _event((now.limit_mps > 0) & (now.speed_mps > now.limit_mps))


@reward_term("ttc_s", "ttc_defined", option="ttc_s")
def ttc(before: Facts, now: Facts, around: Surroundings, ttc_s: float = 1.5) -> Scalar:
    """1 while the time to collision is below ``ttc_s``; 0 while standing."""
    return _event(now.ttc_defined & (now.ttc_s < ttc_s))


@reward_term("ttc_s", "ttc_defined")
def ttc_shortfall(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Shortfall of the time to collision from 1 s, in [0, 1]; 0 while standing."""
    return now.ttc_defined * jnp.clip(1.0 - now.ttc_s / _MIN_TTC_S, 0.0, 1.0)


@reward_term("gap_m", option="close_m")
def close(before: Facts, now: Facts, around: Surroundings, close_m: float = 1.0) -> Scalar:
    """1 while the gap to the nearest agent is below ``close_m``."""
    return _event(now.gap_m < close_m)


_event_term("wrong_way", "wrong_way", "1 while in a lane against its direction.")


@reward_term("straddling")
def straddling(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 while a corner is outside every lane in the agent's direction; 0 where no lane is near."""
    return _event(now.straddling & around.lanes.near)


@reward_term("log_divergence_m", "logged")
def log_divergence(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Distance to the agent's logged position at this step, m, at most 10; 0 without one."""
    return now.logged * jnp.minimum(now.log_divergence_m, _MAX_LOG_DISTANCE_M)


@reward_term("lag_m", "logged")
def lag(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Distance by which the agent is behind its logged position along its heading, m, 0 to 10; 0 without one."""
    return now.logged * jnp.clip(now.lag_m, 0.0, _MAX_LOG_DISTANCE_M)


@reward_term("limit_mps", "speed_mps")
def speed_ratio(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Speed as a share of the limit, in [0, 1]; 0 where no limit is known."""
    known = now.limit_mps > 0
    return known * jnp.clip(now.speed_mps / jnp.where(known, now.limit_mps, 1.0), 0.0, 1.0)


@reward_term("routed", "goal_distance_m")
def goal(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """1 at the step that comes within 3 m of the goal; 0 without a route."""
    return _event(now.routed & (now.goal_distance_m <= _GOAL_M) & (before.goal_distance_m > _GOAL_M))


_event_term(
    "lane_change", "lane_changed", "1 at a step that enters a neighbouring lane of the same direction."
)
_event_term(
    "merge", "merged",
    "1 at a step that leaves a lane which, within 100 m, ends or joins the new lane "
    "(``scenario.bank.queries.lane_passage``).",
)  # fmt: skip


@reward_term("late_m", "early_m", softened=True)
def pace(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Adherence to the log's schedule along the route, or along the log's path without one, in [0, 1].

    It is 1 between the log's present position and that a second later, 1 / (1 + late / 2 m) behind, which rewards
    catching up from any distance, and exp(-early / 8 m) ahead, after the first metre.
    """
    late_m, early_m = jnp.maximum(now.late_m, 0.0), jnp.maximum(now.early_m - _EARLY_SLACK_M, 0.0)
    return jnp.exp(-early_m / _EARLY_M) / (1.0 + late_m / _LATE_M)


@reward_term("completed", softened=True)
def completion(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Gain of the completed share of the log's path, in [0, 1] (CaRL, arXiv 2504.17838)."""
    return jnp.maximum(now.completed - before.completed, 0.0)


@reward_term("routed", "route_deviation_m")
def route_offset(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Distance from the route over 1 m, in [0, 1]; 0 without a route."""
    return now.routed * jnp.clip(now.route_deviation_m / _ROUTE_OFFSET_M, 0.0, 1.0)


@reward_term("ttc_s", "ttc_defined")
def urgency(before: Facts, now: Facts, around: Surroundings) -> Scalar:
    """Shortfall of the time to collision from 2 s, in [0, 1]; 0 while standing."""
    return now.ttc_defined * jnp.clip(1.0 - now.ttc_s / _URGENT_S, 0.0, 1.0)


@reward_term("limit_mps", "speed_mps", option="desired_speed")
def excess_speed(before: Facts, now: Facts, around: Surroundings, desired_speed: Any = 1.0) -> Scalar:
    """Speed in excess of ``desired_speed`` x the limit, as a share of the limit, in [0, 1]; 0 without a known limit."""
    known = now.limit_mps > 0
    ratio = now.speed_mps / jnp.where(known, now.limit_mps, 1.0)
    return known * jnp.clip(ratio - desired_speed, 0.0, 1.0)


@reward_term("time_gap_s", "ttc_defined", option="time_gap_s")
def time_gap_shortfall(before: Facts, now: Facts, around: Surroundings, time_gap_s: Any = 1.5) -> Scalar:
    """Shortfall of the time gap to the obstacle ahead on the route from ``time_gap_s``, in [0, 1]; 0 while standing."""
    shortfall = jnp.maximum(time_gap_s - now.time_gap_s, 0.0) / jnp.maximum(time_gap_s, 1e-3)
    return now.ttc_defined * shortfall


_event_term(
    "at_fault_collision", "at_fault", "1 at a step at which a collision begins that is the agent's fault."
)

#: Terms that lower a softened term, and the share by which each lowers it at 1; at least 0.358 of the term remains.
SOFT_FACTORS = {"urgency": 0.3, "discomfort": 0.2, "speeding": 0.2, "route_offset": 0.2}

SAFETY = {"collision": -1.0, "offroad": -1.0, "red_light": -1.0}
NAVIGATION = SAFETY | {"off_route": -0.2, "progress": 0.2}
BEHAVIOUR = NAVIGATION | {"discomfort": -0.2, "speeding": -0.1}
PUBLISHED = SAFETY | {"off_route": -0.2, "any_progress": 0.2, "comfort": 0.2, "any_speeding": -0.1}
AGGRESSIVE = PUBLISHED | {"ttc_shortfall": -0.5, "speed_ratio": 0.3, "lane_change": 0.2, "merge": 0.2}
FAILURES = {"collision": -3.0, "offroad": -3.0, "red_light": -3.0}
PACE, COMPLETION = FAILURES | {"pace": 0.1}, FAILURES | {"completion": 8.0}
Preset = Literal["safety", "navigation", "behaviour", "published", "aggressive", "pace", "completion"]
PRESETS: dict[str, dict[str, float]] = {
    "safety": SAFETY, "navigation": NAVIGATION, "behaviour": BEHAVIOUR, "published": PUBLISHED,
    "aggressive": AGGRESSIVE, "pace": PACE, "completion": COMPLETION,
}  # fmt: skip


@dataclass(frozen=True)
class OwnTerm:
    """A user's reward term.

    Attributes:
        term: A function like those of this module; ``testing.check_reward`` checks it.
        weight: Factor of the term.
        name: Name in logs; that of the function by default.
        reads: Facts of ``simulator.types.ON_REQUEST`` that the function reads; all others are measured anyway.
    """

    term: Term
    weight: float
    name: str = ""
    reads: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", name_of(self.term, self.name))
        if not math.isfinite(self.weight):
            raise ValueError(f"rewards.own: weight of {self.name!r} is {self.weight}; choose a finite number")
        for name in self.reads:
            if name not in FACTS | ON_REQUEST:
                raise ValueError(f"rewards.own: {self.name!r} reads unknown fact {name!r}")


#: ``preset`` and a weight per built-in term.
_FIELDS = [("preset", Preset, "navigation"), *((name, float | None, None) for name in TERMS)]
_Weights: Any = make_dataclass("_Weights", _FIELDS, frozen=True)


@dataclass(frozen=True)
class RewardConfig(_Weights):
    """A preset, and weights by term that override it: None keeps the preset's weight, 0 disables the term.

    Attributes:
        preset: ``safety``, ``navigation`` and ``behaviour`` each include the previous; ``published`` has the form and
            weights of the published description, ``aggressive`` those of its aggressive driver. ``pace`` rewards the
            log's schedule along the route, ``completion`` the completed share of the log's path; both are softened by
            :data:`SOFT_FACTORS` and have larger penalties for failures.
        collision_margin_m: Gap below which ``collision`` counts (published safety margin: 0.5).
        ttc_s: Time to collision below which ``ttc`` counts (published safety margin: 0.95).
        close_m: Gap below which ``close`` counts.
        desired_speed: Factor of the limit above which ``excess_speed`` counts.
        time_gap_s: Time gap below which ``time_gap_shortfall`` counts.
        scale: Factor of all weighted terms.
        own: The user's terms.
    """

    collision_margin_m: float = 0.0
    ttc_s: float = 1.5
    close_m: float = 1.0
    desired_speed: float = 1.0
    time_gap_s: float = 1.5
    scale: float = 1.0
    own: tuple[OwnTerm, ...] = ()

    def __post_init__(self) -> None:
        check_unique("rewards.own", [term.name for term in self.own], (*TERMS, *OPTIONS))
        for name, bound in OPTIONS.items():
            if not 0.0 <= getattr(self, name) <= bound:
                raise ValueError(f"{name} is {getattr(self, name)}; choose 0 to {bound:g}")
        for name in TERMS:
            if not math.isfinite(getattr(self, name) or 0.0):
                raise ValueError(f"weight of {name} is {getattr(self, name)}; choose a finite number")
        if not 0.0 < self.scale < math.inf:
            raise ValueError(f"scale is {self.scale}; choose a number above 0")

    def weights(self) -> dict[str, float]:
        """Return the nonzero weights by term, without ``scale``."""
        overrides = {name: weight for name in TERMS if (weight := getattr(self, name)) is not None}
        weights = PRESETS[self.preset] | overrides | {term.name: term.weight for term in self.own}
        return {name: weight for name, weight in weights.items() if weight}

    @property
    def penalties(self) -> dict[str, float]:
        """Absolute values of the negative weights by term, with ``scale``."""
        return {name: -self.scale * weight for name, weight in self.weights().items() if weight < 0.0}

    @property
    def reads(self) -> frozenset[str]:
        """Facts that the terms read; user-defined terms read all of ``FACTS``, and those that they declare."""
        reads = {name: term.reads for name, term in TERMS.items()}
        reads |= {term.name: FACTS.union(term.reads) for term in self.own}
        if self.collision_margin_m:
            reads["collision"] = reads["collision"] | {"gap_m"}
        factors = frozenset[str]().union(*(TERMS[name].reads for name in SOFT_FACTORS))
        reads |= {name: term.reads | factors for name, term in TERMS.items() if term.softened}
        return frozenset[str]().union(*(reads[name] for name in self.weights()))

    def weigh(
        self, before: Facts, now: Facts, around: Surroundings, conditions: Mapping[str, Scalar] | None = None
    ) -> dict[str, Scalar]:
        """Return the weighted and scaled terms by name, and the loss by each soft factor as ``TERM/FACTOR``.

        The reward is the sum of all values. ``conditions`` hold factors of terms and values of options, by name.
        """
        conditions = conditions or {}
        options = {name: getattr(self, name) for name in OPTIONS} | dict(conditions)
        # A user's term has no option, and is not softened.
        terms = TERMS | {term.name: RewardTerm(term.term, frozenset()) for term in self.own}
        result = {}
        for name, weight in self.weights().items():
            term = terms[name]
            option = () if term.option is None else (options[term.option],)
            value = self.scale * weight * term(before, now, around, *option)
            value = conditions[name] * value if name in conditions else value
            result[name] = value
            for factor, share in (SOFT_FACTORS if term.softened else {}).items():
                loss = value * share * TERMS[factor](before, now, around)
                result[f"{name}/{factor}"] = -loss
                value = value - loss
        return result
