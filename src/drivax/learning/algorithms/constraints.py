"""Constraints: Lagrange multipliers as weights of reward penalties (RCPO, Tessler et al. 2018, arXiv 1805.11074)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.errors import UsageError, did_you_mean
from drivax.learning.environment import Environment, Rollout


@dataclass(frozen=True)
class Constraints:
    """Limits of costs, and the dual ascent of their multipliers.

    A cost is a penalty of the environment without its weight; that of a failure is 1 at its step.

    Attributes:
        limits: Largest mean sum of a cost per episode.
        weights: Minus the weights of these penalties in the reward, above 0, at which the multipliers start.
        rate: Step size of the dual ascent.
    """

    limits: Mapping[str, float]
    weights: Mapping[str, float]
    rate: float

    @classmethod
    def of(cls, limits: Mapping[str, float], rate: float, environment: Environment) -> Constraints:
        """Return constraints in an environment.

        Raises:
            UsageError: The environment's reward has no penalty of a name with a constant weight.
        """
        weights = getattr(environment, "penalties", {})
        for name in limits:
            if name not in weights:
                cure = did_you_mean(
                    name, weights, otherwise="give that term a weight below 0, and no condition"
                )
                problem = f"constraints: {name!r} is not a penalty with a constant weight"
                raise UsageError(problem, cure=cure)
        return cls(limits, {name: weights[name] for name in limits}, rate)

    def init(self) -> dict[str, Array]:
        """Return the first multipliers."""
        return {name: jnp.asarray(weight, jnp.float32) for name, weight in self.weights.items()}

    def update(
        self, multipliers: Mapping[str, Array], rollout: Rollout
    ) -> tuple[Float[Array, "time batch"], dict[str, Array], dict[str, Array]]:
        """Return the rewards of a rollout with the multipliers as weights, the next multipliers, and values to log.

        ``multiplier' = max(0, multiplier + rate (cost - limit))`` with the cost per episode that ended; unchanged if
        none did.
        """
        reward, after, logs = rollout.reward, dict[str, Array](), dict[str, Array]()
        for name, limit in self.limits.items():
            multiplier, weight = multipliers[name], self.weights[name]
            cost = jnp.where(rollout.alive, rollout.terms[name] / -weight, 0.0)
            reward = reward - (multiplier - weight) * cost
            ends = (rollout.terminated | rollout.truncated) & rollout.alive
            episodes = jnp.sum(ends).astype(jnp.float32)
            excess = jnp.sum(cost) / jnp.maximum(episodes, 1.0) - limit
            step = jnp.where(episodes > 0.0, self.rate * excess, 0.0)
            after[name] = jnp.maximum(multiplier + step, 0.0)
            logs |= {f"multiplier/{name}": multiplier, f"cost/{name}": jnp.sum(cost)}
            logs[f"cost/{name}/n"] = episodes
        return reward, after, logs
