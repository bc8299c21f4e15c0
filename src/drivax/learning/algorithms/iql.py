"""Implicit Q-learning (Kostrikov et al. 2021, arXiv 2110.06169), which asks only for values of actions in the data."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.learning.algorithms.offline import Improved, Offline, OfflineConfig, Trained
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.networks.actor_critic import Value
from drivax.rl.offline import advantage_weights, expectile_loss
from drivax.rl.temporal_difference import td_target


@dataclass(frozen=True)
class IqlConfig(OfflineConfig):
    """IQL.

    Attributes:
        expectile: Of the targets that the value is: 0.5 their mean, toward 1 the best that was done.
        inverse_temperature: ``beta`` of ``exp(beta A)``, by which actions are imitated: 0 all alike.
        largest_weight: Where that is cut off.
        loss: How actions are imitated: ``likelihood``, as published, or ``mse`` of the mode, in action units.
    """

    kind: Literal["iql"] = "iql"
    expectile: float = 0.7
    inverse_temperature: float = 3.0
    largest_weight: float = 100.0
    loss: Literal["likelihood", "mse"] = "likelihood"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.expectile < 1.0:
            raise UsageError(f"an expectile of {self.expectile:g}", cure="use more than 0 and less than 1")
        if self.inverse_temperature < 0.0 or self.largest_weight <= 0.0:
            raise UsageError("weights of IQL that cannot be", cure="use 0 or more, and a cut above 0")
        if self.loss == "mse":
            self.refuse_choices()

    def build(self, environment: Environment, data: Any, iterations: int) -> Iql:
        """IQL in an environment."""
        return Iql(self, environment, data, iterations)


class Iql(Offline):
    """IQL in one environment."""

    def __init__(self, config: IqlConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config = config
        super().__init__(config, environment, data, iterations)

    def networks(self, key: Array) -> dict[str, nnx.Module]:
        """A value beside policy and critics."""
        key, value_key = jax.random.split(key)
        return super().networks(key) | {"value": Value(self.config.networks, self.spec, nnx.Rngs(value_key))}

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """The value learns as the critics do."""
        return super().optimisers() | {"value": self.adam(self.config.critic_rate)}

    def loss(
        self, trained: Trained, target: Mapping[str, Any], part: Transitions, improved: Improved, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Expectile regression, squared errors of the critics, advantage-weighted imitation."""
        config = self.config
        critic = self._best(target, part.observation, part.action)
        value = self._value(trained["value"], part.observation)
        value_loss = jnp.mean(expectile_loss(critic - value, config.expectile))

        then = jax.lax.stop_gradient(self._value(trained["value"], part.following))
        goal = td_target(part.reward, then, part.terminated, config.gamma)
        q = self.q(trained["critic"], part.observation, part.action)
        error = 0.5 * jnp.mean((q - goal) ** 2)

        advantage = critic - value
        if improved[0] is not part.observation:
            advantage = self._best(target, *improved) - self._value(trained["value"], improved[0])
        weights = advantage_weights(advantage, config.inverse_temperature, config.largest_weight)
        policy = self.distribution(trained["policy"], improved[0])
        off = policy.mode() - improved[1]
        squared = config.loss == "mse"
        loss = jnp.mean(off**2, axis=-1) if squared else -policy.log_prob(policy.choice_of(improved[1]))
        imitation = jnp.mean(weights * loss)
        return value_loss + error + imitation, {
            "value": value_loss,
            "critic": error,
            "policy": imitation,
            "mean_q": jnp.mean(q),
            "mean_value": jnp.mean(value),
            "advantage": jnp.mean(advantage),
            "weight": jnp.mean(weights),
            "weights_cut": jnp.mean(weights >= 0.999 * config.largest_weight),
            "imitation_error": jnp.mean(jnp.abs(off)),
        }

    def _best(
        self, target: Mapping[str, Any], observation: dict[str, Array], action: Float[Array, "B D"]
    ) -> Float[Array, " B"]:
        """The smaller of the target critics."""
        return jnp.min(self.q(target["critic"], observation, action), axis=0)

    def _value(self, parameters: Any, observation: dict[str, Array]) -> Float[Array, " B"]:
        return nnx.merge(self.graphs["value"], parameters)(observation)
