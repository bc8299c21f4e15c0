"""Rewards: functions of the facts before and now, weighted and summed. Definitions: semantics, Reward.

A term is what happens, in [0, 1] where it can be; its sign and size are the weight's. One whose facts are undefined (no
limit known, no lanes, no route) is 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.scenario.schema import DT_S
from drivax.simulator.contact import FARTHEST_GAP_M, TTC_HORIZON_S
from drivax.simulator.types import FACTS, ON_REQUEST, Facts, Surroundings
from drivax.tasks.own import own_name, refuse_taken

Term = Callable[[Facts, Facts, Surroundings], Float[Array, ""]]

#: Progress of one step that earns the whole progress reward: 12 m/s.
_FULL_PROGRESS_M = 12.0 * DT_S
#: Speeding by more than this is penalised, m/s (5 mph).
_SPEEDING_MPS = 2.23
#: Times to collision below this fall short, s (the published aggressive driver).
_SHORT_S = 1.0
#: nuPlan's limits of jerk and of lateral acceleration; their sum is the published comfort's "max", of which no number
#: was published.
_JERK_MPS3, _LATERAL_MPS2 = 8.37, 4.89
#: Distances from the log count up to here, m.
_FAR_FROM_LOG_M = 10.0
#: The goal is reached within this distance, m (semantics, ``reached_goal``).
_GOAL_M = 3.0


def _event(happens: Bool[Array, ""]) -> Float[Array, ""]:
    return happens.astype(jnp.float32)


def collision(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while the agent touches another."""
    return _event(now.collision)


def offroad(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while a corner is off the road."""
    return _event(now.offroad)


def red_light(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 at the step that runs a red light."""
    return _event(now.red_light)


def off_route(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while off the corridor of the route; 0 for agents without a route."""
    return _event(now.off_route)


def progress(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """Progress gained along the route as a share of what 12 m/s gain, in [0, 1]; 0 for agents without a route."""
    return now.routed * jnp.clip((now.progress_m - before.progress_m) / _FULL_PROGRESS_M, 0.0, 1.0)


def discomfort(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """How far acceleration, lateral acceleration and jerk go towards nuPlan's limits, squared, in [0, 1].

    Causal differences over 0.5 s, so that the reward never needs the future.
    """
    along = jnp.where(now.acceleration_mps2 < 0, now.acceleration_mps2 / 4.05, now.acceleration_mps2 / 2.40)
    parts = jnp.stack([along, now.lateral_acceleration_mps2 / _LATERAL_MPS2, now.jerk_mps3 / _JERK_MPS3])
    return jnp.clip(jnp.max(parts * parts), 0.0, 1.0)


def speeding(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while faster than a known limit by more than 2.23 m/s."""
    return _event((now.limit_mps > 0) & (now.speed_mps > now.limit_mps + _SPEEDING_MPS))


def any_progress(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 where any progress was gained along the route (published); 0 for agents without a route."""
    return _event(now.routed & (now.progress_m > before.progress_m))


def comfort(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 - min(1, (jerk + lateral acceleration) / max), in [0, 1] (published).

    Magnitudes in m/s3 and m/s2, causal over 0.5 s; ``max`` is 8.37 + 4.89, nuPlan's limits of the two.
    """
    felt = jnp.abs(now.jerk_mps3) + jnp.abs(now.lateral_acceleration_mps2)
    return 1.0 - jnp.minimum(1.0, felt / (_JERK_MPS3 + _LATERAL_MPS2))


def any_speeding(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while faster than a known limit by anything (published)."""
    return _event((now.limit_mps > 0) & (now.speed_mps > now.limit_mps))


def ttc_shortfall(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """How much the time to collision falls short of 1 s, as a share in [0, 1]; 0 for who stands."""
    return now.ttc_defined * jnp.clip(1.0 - now.ttc_s / _SHORT_S, 0.0, 1.0)


def wrong_way(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while in a lane against its direction."""
    return _event(now.wrong_way)


def straddling(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while a corner is outside every lane that runs the agent's way; 0 where no lane is near."""
    return _event(now.straddling & around.lanes.near)


def log_divergence(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """Distance to where the log has the agent at this step, m, at most 10; 0 where it has not."""
    return now.logged * jnp.minimum(now.log_divergence_m, _FAR_FROM_LOG_M)


def lag(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """How far ahead the log has the agent at this step, along its heading, m, 0 to 10; 0 where it has not."""
    return now.logged * jnp.clip(now.lag_m, 0.0, _FAR_FROM_LOG_M)


def speed_ratio(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """Speed as a share of the limit, in [0, 1]; 0 where no limit is known."""
    known = now.limit_mps > 0
    return known * jnp.clip(now.speed_mps / jnp.where(known, now.limit_mps, 1.0), 0.0, 1.0)


def goal(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 at the step that comes within 3 m of the goal; 0 for agents without a route."""
    return _event(now.routed & (now.goal_distance_m <= _GOAL_M) & (before.goal_distance_m > _GOAL_M))


def lane_change(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 at the step that passes to a lane beside, the same way (``scenario.bank.passages``)."""
    return _event(now.lane_changed)


def merge(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 at the step that leaves a lane which ends, or joins the next one, within 100 m (``scenario.bank.passages``)."""
    return _event(now.merged)


@dataclass(frozen=True)
class Touching:
    """1 while the agent touches another, or is nearer to one than a margin in metres."""

    margin_m: float

    def __call__(self, before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
        """The term."""
        return _event(now.collision | (now.gap_m < self.margin_m))


@dataclass(frozen=True)
class ShortTtc:
    """1 while the time to collision is below a threshold in seconds; 0 for who stands."""

    below_s: float = 1.5

    def __call__(self, before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
        """The term."""
        return _event(now.ttc_defined & (now.ttc_s < self.below_s))


@dataclass(frozen=True)
class Close:
    """1 while the gap to the nearest other is below a threshold in metres."""

    below_m: float = 1.0

    def __call__(self, before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
        """The term."""
        return _event(now.gap_m < self.below_m)


TERMS: dict[str, Term] = {
    "collision": collision,
    "offroad": offroad,
    "red_light": red_light,
    "off_route": off_route,
    "progress": progress,
    "discomfort": discomfort,
    "speeding": speeding,
    "any_progress": any_progress,
    "comfort": comfort,
    "any_speeding": any_speeding,
    "ttc": ShortTtc(),
    "ttc_shortfall": ttc_shortfall,
    "close": Close(),
    "wrong_way": wrong_way,
    "straddling": straddling,
    "log_divergence": log_divergence,
    "lag": lag,
    "speed_ratio": speed_ratio,
    "goal": goal,
    "lane_change": lane_change,
    "merge": merge,
}
#: Facts that each term looks at; no others are measured for it.
READS: dict[str, frozenset[str]] = {
    "collision": frozenset({"collision"}),
    "offroad": frozenset({"offroad"}),
    "red_light": frozenset({"red_light"}),
    "off_route": frozenset({"off_route"}),
    "progress": frozenset({"routed", "progress_m"}),
    "discomfort": frozenset({"acceleration_mps2", "lateral_acceleration_mps2", "jerk_mps3"}),
    "speeding": frozenset({"limit_mps", "speed_mps"}),
    "any_progress": frozenset({"routed", "progress_m"}),
    "comfort": frozenset({"lateral_acceleration_mps2", "jerk_mps3"}),
    "any_speeding": frozenset({"limit_mps", "speed_mps"}),
    "ttc": frozenset({"ttc_s", "ttc_defined"}),
    "ttc_shortfall": frozenset({"ttc_s", "ttc_defined"}),
    "close": frozenset({"gap_m"}),
    "wrong_way": frozenset({"wrong_way"}),
    "straddling": frozenset({"straddling"}),
    "log_divergence": frozenset({"log_divergence_m", "logged"}),
    "lag": frozenset({"lag_m", "logged"}),
    "speed_ratio": frozenset({"limit_mps", "speed_mps"}),
    "goal": frozenset({"routed", "goal_distance_m"}),
    "lane_change": frozenset({"lane_changed"}),
    "merge": frozenset({"merged"}),
}

SAFETY = {"collision": -1.0, "offroad": -1.0, "red_light": -1.0}
NAVIGATION = SAFETY | {"off_route": -0.2, "progress": 0.2}
BEHAVIOUR = NAVIGATION | {"discomfort": -0.2, "speeding": -0.1}
PUBLISHED = SAFETY | {"off_route": -0.2, "any_progress": 0.2, "comfort": 0.2, "any_speeding": -0.1}
AGGRESSIVE = PUBLISHED | {"ttc_shortfall": -0.5, "speed_ratio": 0.3, "lane_change": 0.2, "merge": 0.2}
PRESETS = {
    "safety": SAFETY,
    "navigation": NAVIGATION,
    "behaviour": BEHAVIOUR,
    "published": PUBLISHED,
    "aggressive": AGGRESSIVE,
}


@dataclass(frozen=True)
class OwnTerm:
    """A reward term of the user's own.

    Attributes:
        term: From the facts before, the facts now and the surroundings to a number, as the terms of this module;
            ``testing.check_reward`` tells whether it keeps to the rules.
        weight: What it is multiplied by.
        name: As logged; by default the function's own.
        reads: Facts of ``simulator.types.ON_REQUEST`` that it looks at; it is given all others anyway.
    """

    term: Term
    weight: float
    name: str = ""
    reads: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", own_name(self.term, self.name))
        for name in self.reads:
            if name not in FACTS | ON_REQUEST:
                raise ValueError(f"rewards.own: {self.name!r} reads {name!r}, which is no fact")


@dataclass(frozen=True)
class RewardConfig:
    """A preset and what differs from it: a weight that is not None replaces the preset's, 0 switches the term off.

    Attributes:
        preset: ``safety``, ``navigation`` and ``behaviour`` each include those before; ``published`` has the form and
            the weights of the published description, ``aggressive`` those of its aggressive driver.
        collision_margin_m: ``collision`` counts from this gap on (published as a margin of safety: 0.5).
        ttc_s: ``ttc`` counts below this (published as a margin of safety: 0.95).
        close_m: ``close`` counts below this gap.
        scale: What every weighted term is multiplied by, to bring returns into another range.
        own: Terms beside those of this module.
    """

    preset: Literal["safety", "navigation", "behaviour", "published", "aggressive"] = "navigation"
    collision: float | None = None
    offroad: float | None = None
    red_light: float | None = None
    off_route: float | None = None
    progress: float | None = None
    discomfort: float | None = None
    speeding: float | None = None
    any_progress: float | None = None
    comfort: float | None = None
    any_speeding: float | None = None
    ttc: float | None = None
    ttc_shortfall: float | None = None
    close: float | None = None
    wrong_way: float | None = None
    straddling: float | None = None
    log_divergence: float | None = None
    lag: float | None = None
    speed_ratio: float | None = None
    goal: float | None = None
    lane_change: float | None = None
    merge: float | None = None
    collision_margin_m: float = 0.0
    ttc_s: float = 1.5
    close_m: float = 1.0
    scale: float = 1.0
    own: tuple[OwnTerm, ...] = ()

    def __post_init__(self) -> None:
        refuse_taken("rewards.own", [term.name for term in self.own], tuple(TERMS))
        for name, most in (
            ("collision_margin_m", FARTHEST_GAP_M),
            ("ttc_s", TTC_HORIZON_S),
            ("close_m", FARTHEST_GAP_M),
        ):
            if not 0.0 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}; choose 0 to {most:g}")
        if not 0.0 < self.scale < math.inf:
            raise ValueError(f"scale is {self.scale}; choose a number above 0")

    def weights(self) -> dict[str, float]:
        """The weight of every term that counts, before ``scale``."""
        changed = {name: getattr(self, name) for name in TERMS}
        given = {name: weight for name, weight in changed.items() if weight is not None}
        every = PRESETS[self.preset] | given | {term.name: term.weight for term in self.own}
        return {name: weight for name, weight in every.items() if weight}

    @property
    def reads(self) -> frozenset[str]:
        """Facts that the terms look at: where some term is the user's own all but those on request."""
        weights = self.weights()
        reads = READS | {term.name: FACTS.union(term.reads) for term in self.own}
        if self.collision_margin_m:
            reads["collision"] = reads["collision"] | {"gap_m"}
        return frozenset[str]().union(*(reads[name] for name in weights))

    def weigh(self, before: Facts, now: Facts, around: Surroundings) -> dict[str, Float[Array, ""]]:
        """Weighted and scaled terms by name."""
        terms = TERMS | {"ttc": ShortTtc(self.ttc_s), "close": Close(self.close_m)}
        if self.collision_margin_m:
            terms["collision"] = Touching(self.collision_margin_m)
        terms |= {term.name: term.term for term in self.own}
        weights = {name: self.scale * weight for name, weight in self.weights().items()}
        return {name: weight * terms[name](before, now, around) for name, weight in weights.items()}
