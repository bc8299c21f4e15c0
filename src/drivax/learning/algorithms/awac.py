"""Advantage-weighted actor-critic (AWAC; Nair et al. 2020, arXiv 2006.09359), offline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.learning.algorithms.advantage_weighted import AdvantageWeighted, AdvantageWeightedConfig
from drivax.learning.algorithms.off_policy import Trained, q_logs, sample_each
from drivax.learning.algorithms.offline import PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.rl.equations import td_target


@dataclass(frozen=True)
class AwacConfig(AdvantageWeightedConfig):
    """AWAC. Advantages are relative to the critics' Q of a sampled action, instead of a value network."""

    kind: Literal["awac"] = "awac"
    inverse_temperature: float = 1.0

    def build(self, environment: Environment, data: Any, iterations: int) -> Awac:
        """Return AWAC in an environment."""
        return Awac(self, environment, data, iterations)


class Awac(AdvantageWeighted[AwacConfig]):
    """AWAC in one environment."""

    def loss(
        self, trained: Trained, target: Any, batch: Transitions, policy_batch: PolicyBatch, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the sum of the critics' loss and advantage-weighted imitation."""
        next_keys, policy_keys = jax.vmap(partial(jax.random.split, num=2), out_axes=1)(keys)
        parameters, critic = jax.lax.stop_gradient((trained["policy"], trained["critic"]))
        next_policy = self.distribution(parameters, batch.next_observation)
        next_action = next_policy.action(sample_each(next_policy, next_keys))
        next_value = self.q_value(target["critic"], batch.next_observation, next_action)
        critic_loss, q = self.critic_loss(trained, batch, next_value)

        observation, expert, _ = policy_batch
        policy = self.distribution(parameters, observation)
        actions = jnp.stack([expert, policy.action(sample_each(policy, policy_keys))])
        if self.config.advantage == "return":
            logged_q = td_target(batch.reward, next_value, batch.terminated, batch.discount)
            policy_q = self.q_value(target["critic"], observation, actions[1])
        else:
            logged_q, policy_q = self.q_value(critic, observation, actions)
        imitation, logs = self.imitation(trained, policy_batch, logged_q - policy_q)
        return critic_loss + imitation, logs | {
            "critic": critic_loss,
            **q_logs(q),
            "mean_q_policy": jnp.mean(policy_q),
        }
