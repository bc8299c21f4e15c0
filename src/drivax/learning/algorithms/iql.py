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

from drivax.errors import UsageError
from drivax.learning.algorithms.awac import AdvantageWeighted, AdvantageWeightedConfig
from drivax.learning.algorithms.off_policy import Trained, q_logs
from drivax.learning.algorithms.offline import PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.networks.actor_critic import Value
from drivax.rl.equations import expectile_loss, td_target


@dataclass(frozen=True)
class IqlConfig(AdvantageWeightedConfig):
    """IQL.

    Attributes:
        expectile: Expectile of Q that the value regresses to: 0.5 is the mean; near 1, the best logged action.
    """

    kind: Literal["iql"] = "iql"
    expectile: float = 0.7

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.expectile < 1.0:
            raise UsageError(f"expectile is {self.expectile:g}", cure="use more than 0 and less than 1")

    def build(self, environment: Environment, data: Any, iterations: int) -> Iql:
        """Return IQL in an environment."""
        return Iql(self, environment, data, iterations)


class Iql(AdvantageWeighted[IqlConfig]):
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
        (observation, expert, _), parameters = policy_batch, target["critic"]
        target_q = self.q_value(parameters, batch.observation, batch.action)
        value = self._value(trained["value"], batch.observation)
        value_loss = jnp.mean(expectile_loss(target_q - value, self.config.expectile))

        next_value = jax.lax.stop_gradient(self._value(trained["value"], batch.next_observation))
        critic_loss, q = self.critic_loss(trained, batch, next_value)

        if self.config.advantage == "return":
            target_q = td_target(batch.reward, next_value, batch.terminated, batch.discount)
        advantage = target_q - value
        if observation is not batch.observation:
            policy_value = self._value(trained["value"], observation)
            advantage = self.q_value(parameters, observation, expert) - policy_value
        imitation, logs = self.imitation(trained, policy_batch, advantage)
        return value_loss + critic_loss + imitation, logs | {
            "value": value_loss,
            "critic": critic_loss,
            **q_logs(q),
            "mean_value": jnp.mean(value),
        }

    def _value(self, parameters: Any, observation: dict[str, Array]) -> Float[Array, " B"]:
        return nnx.merge(self.graphs["value"], parameters)(observation)
