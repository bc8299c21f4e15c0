"""Rewards: functions of the facts before and now, weighted and summed. Definitions: semantics, Reward."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.scenario.schema import DT_S
from drivax.simulator.types import Facts, Surroundings

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

SAFETY = {"collision": -1.0, "offroad": -1.0, "red_light": -1.0}
NAVIGATION = SAFETY | {"off_route": -0.2, "progress": 0.2}
BEHAVIOUR = NAVIGATION | {"discomfort": -0.2, "speeding": -0.1}
PRESETS = {"safety": SAFETY, "navigation": NAVIGATION, "behaviour": BEHAVIOUR}


@dataclass(frozen=True)
class RewardConfig:
    """A preset and what differs from it: a weight that is not None replaces the preset's.

    Attributes:
        preset: Each preset includes those before it: safety, navigation, behaviour.
    """

    preset: Literal["safety", "navigation", "behaviour"] = "navigation"
    collision: float | None = None
    offroad: float | None = None
    red_light: float | None = None
    off_route: float | None = None
    progress: float | None = None
    discomfort: float | None = None
    speeding: float | None = None

    def weights(self) -> dict[str, float]:
        """The weight of every term that counts."""
        own = {name: getattr(self, name) for name in TERMS}
        return PRESETS[self.preset] | {name: weight for name, weight in own.items() if weight is not None}
