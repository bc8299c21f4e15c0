"""Advantage-weighted actor-critic (AWAC; Nair et al. 2020, arXiv 2006.09359), offline, and its base, as of IQL."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.checks import check_above_zero, check_at_least
from drivax.errors import UsageError
from drivax.learning.algorithms.off_policy import Trained, q_logs, sample_each
from drivax.learning.algorithms.offline import Offline, OfflineConfig, PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.program import mean_over_devices
from drivax.learning.replay import Transitions
from drivax.rl.equations import advantage_weights, td_target

#: Least standard deviation that advantages are divided by.
_LEAST_DEVIATION = 1e-6


@dataclass(frozen=True)
class AdvantageWeightedConfig(OfflineConfig):
    """Settings of advantage-weighted imitation.

    Attributes:
        inverse_temperature: ``beta`` of the imitation weights ``exp(beta A)``; 0: uniform weights.
        relative: Divide advantages by their standard deviation over the batch, so that weights do not depend on the
            scale of rewards.
        advantage: ``critic``: Q of the logged action minus the value, as published; ``return``: its n-step return
            (``steps``) minus the value, as in advantage-weighted regression (Peng et al. 2019, arXiv 1910.00177). A
            single action of 0.1 s hardly changes Q; the logged actions after it are likely to be similar.
        largest_weight: Upper bound of the weights.
        loss: Imitation loss: ``likelihood``, as published, or ``mse`` of the mode, in action units.
    """

    inverse_temperature: float = 3.0
    relative: bool = False
    advantage: Literal["critic", "return"] = "critic"
    largest_weight: float = 100.0
    loss: Literal["likelihood", "mse"] = "likelihood"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, 0, "inverse_temperature")
        check_above_zero(self, "largest_weight")
        if self.loss == "mse":
            self.check_gradient()
        if self.advantage == "return" and self.records.weighted == "policy":
            problem = "advantage: return needs the transitions of the steps that the policy imitates"
            raise UsageError(problem, cure="set records.weighted to all")


Config = TypeVar("Config", bound=AdvantageWeightedConfig)


class AdvantageWeighted(Offline[Config]):
    """An advantage-weighted algorithm in one environment."""

    def imitation(
        self, trained: Trained, policy_batch: PolicyBatch, advantage: Float[Array, " B"]
    ) -> tuple[Array, dict[str, Array]]:
        """Return the imitation loss, and values to log, given the advantages of the logged actions."""
        config, (observation, expert, guidance) = self.config, policy_batch
        if config.relative:
            centred = advantage - mean_over_devices(advantage)
            advantage = advantage / jnp.maximum(jnp.sqrt(mean_over_devices(centred**2)), _LEAST_DEVIATION)
        weights = advantage_weights(guidance * advantage, config.inverse_temperature, config.largest_weight)
        policy = self.distribution(trained["policy"], observation)
        error = policy.mode() - expert
        is_mse = config.loss == "mse"
        loss = jnp.mean(error**2, axis=-1) if is_mse else -policy.log_prob(policy.raw_action(expert))
        imitation = jnp.mean(weights * loss)
        return imitation, {
            "policy": imitation,
            "advantage": jnp.mean(advantage),
            "weight": jnp.mean(weights),
            # With a margin, because exponential and logarithm round.
            "weights_cut": jnp.mean(weights >= 0.999 * config.largest_weight),
            "imitation_error": jnp.mean(jnp.abs(error)),
        }


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
