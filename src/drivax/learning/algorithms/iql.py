"""Implicit Q-learning (Kostrikov et al. 2021, arXiv 2110.06169), which learns values of logged actions only."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.checks import check_above_zero, check_at_least
from drivax.errors import UsageError
from drivax.learning.algorithms.off_policy import Trained, q_logs
from drivax.learning.algorithms.offline import Offline, OfflineConfig, PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.networks.actor_critic import Value
from drivax.rl.equations import advantage_weights, expectile_loss


@dataclass(frozen=True)
class IqlConfig(OfflineConfig):
    """IQL.

    Attributes:
        expectile: Expectile of Q that the value regresses to: 0.5 is the mean; near 1, the best logged action.
        inverse_temperature: ``beta`` of the imitation weights ``exp(beta A)``; 0: uniform weights.
        largest_weight: Upper bound of the weights.
        loss: Imitation loss: ``likelihood``, as published, or ``mse`` of the mode, in action units.
    """

    kind: Literal["iql"] = "iql"
    expectile: float = 0.7
    inverse_temperature: float = 3.0
    largest_weight: float = 100.0
    loss: Literal["likelihood", "mse"] = "likelihood"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.expectile < 1.0:
            raise UsageError(f"expectile is {self.expectile:g}", cure="use more than 0 and less than 1")
        check_at_least(self, 0, "inverse_temperature")
        check_above_zero(self, "largest_weight")
        if self.loss == "mse":
            self.check_gradient()

    def build(self, environment: Environment, data: Any, iterations: int) -> Iql:
        """Return IQL in an environment."""
        return Iql(self, environment, data, iterations)


class Iql(Offline[IqlConfig]):
    """IQL in one environment."""

    def networks(self, key: Array) -> dict[str, nnx.Module]:
        """Return policy, critics, and value."""
        key, value_key = jax.random.split(key)
        return super().networks(key) | {"value": Value(self.network, self.spec, nnx.Rngs(value_key))}

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """Return the optimisers; the value uses the critics' learning rate."""
        return super().optimisers() | {"value": self.adam(self.config.critic_rate)}

    def loss(
        self, trained: Trained, target: Any, batch: Transitions, policy_batch: PolicyBatch, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the sum of expectile regression, the critics' loss, and advantage-weighted imitation."""
        config, (observation, expert) = self.config, policy_batch
        target_q = self._min_q(target, batch.observation, batch.action)
        value = self._value(trained["value"], batch.observation)
        value_loss = jnp.mean(expectile_loss(target_q - value, config.expectile))

        next_value = jax.lax.stop_gradient(self._value(trained["value"], batch.next_observation))
        critic_loss, q = self.critic_loss(trained, batch, next_value)

        advantage = target_q - value
        if observation is not batch.observation:
            policy_value = self._value(trained["value"], observation)
            advantage = self._min_q(target, observation, expert) - policy_value
        weights = advantage_weights(advantage, config.inverse_temperature, config.largest_weight)
        policy = self.distribution(trained["policy"], observation)
        error = policy.mode() - expert
        is_mse = config.loss == "mse"
        loss = jnp.mean(error**2, axis=-1) if is_mse else -policy.log_prob(policy.raw_action(expert))
        imitation = jnp.mean(weights * loss)
        return value_loss + critic_loss + imitation, {
            "value": value_loss,
            "critic": critic_loss,
            "policy": imitation,
            **q_logs(q),
            "mean_value": jnp.mean(value),
            "advantage": jnp.mean(advantage),
            "weight": jnp.mean(weights),
            # With a margin, because exponential and logarithm round.
            "weights_cut": jnp.mean(weights >= 0.999 * config.largest_weight),
            "imitation_error": jnp.mean(jnp.abs(error)),
        }

    def _min_q(
        self, target: Any, observation: dict[str, Array], action: Float[Array, "B D"]
    ) -> Float[Array, " B"]:
        return jnp.min(self.q_values(target["critic"], observation, action), axis=0)

    def _value(self, parameters: Any, observation: dict[str, Array]) -> Float[Array, " B"]:
        return nnx.merge(self.graphs["value"], parameters)(observation)
