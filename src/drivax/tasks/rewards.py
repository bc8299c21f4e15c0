"""Rewards: functions of the facts before and now, weighted and summed. Definitions: semantics, Reward."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.scenario.schema import DT_S
from drivax.simulator.types import FACTS, Facts, Surroundings
from drivax.tasks.own import own_name, refuse_taken

Term = Callable[[Facts, Facts, Surroundings], Float[Array, ""]]

#: Progress of one step that earns the whole progress reward: 12 m/s.
_FULL_PROGRESS_M = 12.0 * DT_S
#: Speeding by more than this is penalised, m/s (5 mph).
_SPEEDING_MPS = 2.23


def collision(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while the agent touches another."""
    return now.collision.astype(jnp.float32)


def offroad(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while a corner is off the road."""
    return now.offroad.astype(jnp.float32)


def red_light(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 at the step that runs a red light."""
    return now.red_light.astype(jnp.float32)


def off_route(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while off the corridor of the route; 0 for agents without a route."""
    return now.off_route.astype(jnp.float32)


def progress(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """Progress gained along the route as a share of what 12 m/s gain, in [0, 1]; 0 for agents without a route."""
    return now.routed * jnp.clip((now.progress_m - before.progress_m) / _FULL_PROGRESS_M, 0.0, 1.0)


def discomfort(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """How far acceleration, lateral acceleration and jerk go towards nuPlan's limits, squared, in [0, 1].

    Causal differences over 0.5 s, so that the reward never needs the future.
    """
    along = jnp.where(now.acceleration_mps2 < 0, now.acceleration_mps2 / 4.05, now.acceleration_mps2 / 2.40)
    parts = jnp.stack([along, now.lateral_acceleration_mps2 / 4.89, now.jerk_mps3 / 8.37])
    return jnp.clip(jnp.max(parts * parts), 0.0, 1.0)


def speeding(before: Facts, now: Facts, around: Surroundings) -> Float[Array, ""]:
    """1 while faster than a known limit by more than 2.23 m/s."""
    return ((now.limit_mps > 0) & (now.speed_mps > now.limit_mps + _SPEEDING_MPS)).astype(jnp.float32)


TERMS: dict[str, Term] = {
    "collision": collision,
    "offroad": offroad,
    "red_light": red_light,
    "off_route": off_route,
    "progress": progress,
    "discomfort": discomfort,
    "speeding": speeding,
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
}

SAFETY = {"collision": -1.0, "offroad": -1.0, "red_light": -1.0}
NAVIGATION = SAFETY | {"off_route": -0.2, "progress": 0.2}
BEHAVIOUR = NAVIGATION | {"discomfort": -0.2, "speeding": -0.1}
PRESETS = {"safety": SAFETY, "navigation": NAVIGATION, "behaviour": BEHAVIOUR}


@dataclass(frozen=True)
class OwnTerm:
    """A reward term of the user's own.

    Attributes:
        term: From the facts before, the facts now and the surroundings to a number, as the terms of this module;
            ``testing.check_reward`` tells whether it keeps to the rules.
        weight: What it is multiplied by.
        name: As logged; by default the function's own.
    """

    term: Term
    weight: float
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", own_name(self.term, self.name))


@dataclass(frozen=True)
class RewardConfig:
    """A preset and what differs from it: a weight that is not None replaces the preset's.

    Attributes:
        preset: Each preset includes those before it: safety, navigation, behaviour.
        own: Terms beside those of this module.
    """

    preset: Literal["safety", "navigation", "behaviour"] = "navigation"
    collision: float | None = None
    offroad: float | None = None
    red_light: float | None = None
    off_route: float | None = None
    progress: float | None = None
    discomfort: float | None = None
    speeding: float | None = None
    own: tuple[OwnTerm, ...] = ()

    def __post_init__(self) -> None:
        refuse_taken("rewards.own", [term.name for term in self.own], tuple(TERMS))

    def weights(self) -> dict[str, float]:
        """The weight of every term that counts."""
        changed = {name: getattr(self, name) for name in TERMS}
        given = {name: weight for name, weight in changed.items() if weight is not None}
        return PRESETS[self.preset] | given | {term.name: term.weight for term in self.own}

    @property
    def reads(self) -> frozenset[str]:
        """Facts that the terms look at: all of them where some term is the user's own."""
        return frozenset[str]().union(*(READS.get(name, FACTS) for name in self.weights()))

    def weigh(self, before: Facts, now: Facts, around: Surroundings) -> dict[str, Float[Array, ""]]:
        """Weighted terms by name."""
        terms = TERMS | {term.name: term.term for term in self.own}
        return {name: weight * terms[name](before, now, around) for name, weight in self.weights().items()}
