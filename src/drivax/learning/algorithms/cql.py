"""Conservative Q-learning (Kumar et al. 2020, arXiv 2006.04779), on top of soft actor-critic, offline."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from drivax.checks import check_above_zero, check_at_least, check_at_most
from drivax.errors import UsageError
from drivax.learning.algorithms.off_policy import (
    Trained,
    q_logs,
    sample_each,
    squared_error,
    target_entropy,
)
from drivax.learning.algorithms.offline import Offline, OfflineConfig, PolicyBatch
from drivax.learning.environment import Environment
from drivax.learning.program import mean_over_devices
from drivax.learning.replay import Transitions
from drivax.networks.distributions import Distribution
from drivax.rl.equations import conservative_penalty, penalty_weight_loss, scaled_policy_loss, td_target

#: Largest number of sampled actions.
MOST_ACTIONS = 1000
#: Largest logarithm of the Lagrange multiplier.
_MAX_LOG_WEIGHT = math.log(1e6)


@dataclass(frozen=True)
class CqlConfig(OfflineConfig):
    """CQL(H); with ``imitation`` above 0, the policy's loss also has a behaviour cloning term.

    Attributes:
        penalty: Weight of the conservative penalty relative to half the squared TD error; initial value with a ``gap``.
        relative: Multiply the weight by the mean absolute Q, so that it does not depend on the scale of rewards.
        gap: Target penalty of a Lagrange multiplier that replaces the weight; None: constant weight.
        penalty_rate: Learning rate of the multiplier.
        actions: Number of actions that the penalty samples from each distribution: uniform, and the current policy.
        next_actions: Also sample the penalty's actions from the policy at the next state.
        backup_actions: Number of actions sampled at the next state; the highest value (of both critics combined) is
            backed up. A single one has a lower value than the expert's action on average, an error that accumulates.
        importance: Weight sampled actions by their inverse density; if false, add the logged action to the samples.
        penalty_temperature: Temperature of the penalty's soft maximum.
        imitation: Weight of the squared error of the policy's mode from the expert's action. Above 0, the policy's loss
            is divided by the mean absolute Q, so that the weight does not depend on the scale of rewards.
        temperature: Initial temperature of the policy's entropy.
        temperature_rate: Learning rate of the temperature; 0: constant.
        target_entropy: Target entropy of the policy; by default minus the size of an action.
    """

    kind: Literal["cql"] = "cql"
    penalty: float = 5.0
    relative: bool = False
    gap: float | None = None
    penalty_rate: float = 3e-4
    actions: int = 10
    next_actions: bool = True
    backup_actions: int = 1
    importance: bool = True
    penalty_temperature: float = 1.0
    imitation: float = 0.0
    temperature: float = 0.1
    temperature_rate: float = 3e-4
    target_entropy: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_gradient()
        check_at_least(self, 1, "actions", "backup_actions")
        check_at_most(self, MOST_ACTIONS, "actions", "backup_actions")
        check_above_zero(self, "temperature", "penalty_temperature")
        check_at_least(self, 0, "penalty", "imitation", "penalty_rate", "temperature_rate")
        if self.needs_failures and self.imitation == 0.0:
            problem = "needs_failures needs a policy that imitates"
            raise UsageError(problem, cure="use imitation above 0, or leave out needs_failures")
        if self.gap is not None and self.penalty == 0.0:
            problem = "penalty is 0, from which the multiplier of a gap cannot start"
            raise UsageError(problem, cure="use more than 0, or no gap")
        if self.gap is not None and self.relative:
            raise UsageError(
                "a gap replaces the weight of the penalty", cure="leave out relative, or the gap"
            )

    def build(self, environment: Environment, data: Any, iterations: int) -> Cql:
        """Return CQL in an environment."""
        return Cql(self, environment, data, iterations)


class Cql(Offline[CqlConfig]):
    """CQL in one environment."""

    def __init__(self, config: CqlConfig, environment: Environment, data: Any, iterations: int) -> None:
        super().__init__(config, environment, data, iterations)
        self.target_entropy = target_entropy(config, environment)

    def scalars(self) -> dict[str, float]:
        """Return logarithms of the temperature, and of the multiplier if there is one."""
        scalars = {"log_temperature": math.log(self.config.temperature)}
        if self.config.gap is not None:
            scalars["log_penalty"] = math.log(self.config.penalty)
        return scalars

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """Return the optimisers of networks and scalars."""
        rates = {"log_temperature": self.config.temperature_rate, "log_penalty": self.config.penalty_rate}
        return super().optimisers() | {name: optax.adam(rates[name]) for name in self.scalars()}

    def loss(
        self, trained: Trained, target: Any, batch: Transitions, policy_batch: PolicyBatch, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the sum of TD error, penalty, and the losses of policy, temperature and multiplier."""
        policy_keys, *critic_keys = jax.vmap(partial(jax.random.split, num=5), out_axes=1)(keys)
        critic, critic_logs = self._penalised_critic_loss(trained, target, batch, critic_keys)
        policy, policy_logs = self._policy_loss(trained, policy_batch, policy_keys)
        return critic + policy, critic_logs | policy_logs

    def _penalised_critic_loss(
        self, trained: Trained, target: Any, batch: Transitions, keys: Sequence[Array]
    ) -> tuple[Array, dict[str, Array]]:
        next_keys, *sample_keys = keys
        parameters = jax.lax.stop_gradient(trained["policy"])
        next_policy = self.distribution(parameters, batch.next_observation)
        next_action = next_policy.action(_samples(next_policy, next_keys, self.config.backup_actions))
        # As in the reference implementation the target has no entropy, though the policy's loss has.
        next_q = self.q_values(target["critic"], batch.next_observation, next_action)
        next_value = jnp.max(self.combine(next_q), axis=0)
        target_q = td_target(batch.reward, next_value, batch.terminated, batch.discount)
        policy = self.distribution(parameters, batch.observation)
        action, log_density = self._penalty_actions(policy, next_policy, batch.action, sample_keys)
        # In one call, so that each observation is encoded and differentiated once.
        actions = jnp.concatenate([batch.action[None], action])
        q_values = self.q_values(trained["critic"], batch.observation, actions)
        q, sampled_q = q_values[:, 0], jnp.moveaxis(q_values[:, 1:], 1, 0)
        error = squared_error(q, target_q)
        densities = jnp.broadcast_to(log_density[:, None], sampled_q.shape)
        penalty = conservative_penalty(sampled_q, densities, q, self.config.penalty_temperature)
        weight, weight_loss = self._penalty_weight(trained, penalty, q)
        return error + weight * jnp.mean(penalty) + weight_loss, {
            "critic": error,
            "penalty": jnp.mean(penalty),
            "penalty_weight": weight,
            **q_logs(q),
            "mean_q_uniform": jnp.mean(sampled_q[: self.config.actions]),
        }

    def _penalty_actions(
        self,
        policy: Distribution,
        next_policy: Distribution,
        logged: Float[Array, "B D"],
        keys: Sequence[Array],
    ) -> tuple[Float[Array, "K B D"], Float[Array, "K B"]]:
        """Return the penalty's actions and their log-densities, 0 without importance weights."""
        config = self.config
        uniform_keys, policy_keys, next_keys = keys
        size, dimensions = logged.shape
        draw = partial(jax.random.uniform, shape=(config.actions, dimensions), minval=-1.0)
        actions = [jax.vmap(draw, out_axes=1)(uniform_keys)]
        densities = [jnp.full((config.actions, size), -dimensions * math.log(2.0))]
        sources = ((policy, policy_keys), (next_policy, next_keys))
        for distribution, sample_keys in sources[: 2 if config.next_actions else 1]:
            raw_actions = _samples(distribution, sample_keys, config.actions)
            actions.append(distribution.action(raw_actions))
            densities.append(jax.vmap(distribution.log_prob)(raw_actions))
        if config.importance:
            return jnp.concatenate(actions), jnp.concatenate(densities)
        stacked = jnp.concatenate([*actions, logged[None]])
        return stacked, jnp.zeros(stacked.shape[:-1])

    def _penalty_weight(self, trained: Trained, penalty: Array, q: Array) -> tuple[Array, Array]:
        """Return the penalty's weight, without gradient, and the loss of its multiplier."""
        if self.config.gap is None:
            scale = mean_over_devices(jnp.abs(q)) if self.config.relative else jnp.ones(())
            return self.config.penalty * scale, jnp.zeros(())
        log_weight = jnp.minimum(trained["log_penalty"], _MAX_LOG_WEIGHT)
        loss = jnp.mean(penalty_weight_loss(log_weight, penalty, self.config.gap))
        return jax.lax.stop_gradient(jnp.exp(log_weight)), loss

    def _policy_loss(
        self, trained: Trained, policy_batch: PolicyBatch, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        observation, expert, guidance = policy_batch
        actor = self.soft_actor(trained, observation, self.target_entropy, keys)
        error = actor.policy.mode() - expert
        total = jnp.mean(actor.loss)
        if self.config.imitation:
            mean_q = mean_over_devices(jnp.abs(jnp.min(actor.q_values, axis=0)))
            scaled = jnp.mean(guidance * scaled_policy_loss(actor.loss, mean_q))
            total = scaled + self.config.imitation * jnp.mean(error**2)
        # Without guidance the entropy does not depend on the temperature, which would grow without limit.
        return total + jnp.mean(guidance) * actor.temperature_loss, actor.logs | {
            "policy": total,
            "mean_q_policy": jnp.mean(actor.q_values),
            "imitation_error": jnp.mean(jnp.abs(error)),
        }


def _samples(policy: Distribution, keys: Array, count: int) -> Float[Array, "count B raw"]:
    """Draw ``count`` raw actions from each distribution, with a key for each."""
    return jax.vmap(partial(sample_each, policy))(
        jax.vmap(partial(jax.random.split, num=count), out_axes=1)(keys)
    )
