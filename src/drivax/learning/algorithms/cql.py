"""Conservative Q-learning (Kumar et al. 2020, arXiv 2006.04779), on top of soft actor-critic, offline."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.learning.algorithms.offline import Improved, Offline, OfflineConfig, Trained, by_key
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.networks.distributions import Distribution
from drivax.rl.offline import conservative_penalty, penalty_weight_loss, scaled_policy_loss
from drivax.rl.temporal_difference import soft_policy_loss, td_target, temperature_loss

#: The multiplier stays below.
_LARGEST_WEIGHT = math.log(1e6)


@dataclass(frozen=True)
class CqlConfig(OfflineConfig):
    """CQL(H), and with ``imitation`` above 0 the same with a term of behaviour cloning beside the policy's loss.

    Attributes:
        penalty: Weight of the conservative penalty beside half the squared error; with a ``gap`` the first one.
        gap: Penalty that a Lagrange multiplier in place of the weight aims at; None: the weight stays.
        penalty_rate: Learning rate of the multiplier.
        actions: Actions from each distribution that the penalty samples.
        next_actions: Whether actions of the policy at the next state are among them, beside uniform ones and those of
            the policy at the state.
        backup_actions: Of so many actions of the policy at the next state the one of the highest value (of the smaller
            critic) is backed up. One alone is in the mean worth less than what the expert does next, and that adds up
            from step to step.
        importance: Whether each is divided by its density; if not, the action of the data stands among them instead.
        penalty_temperature: Of the penalty's soft maximum.
        imitation: Weight of the squared error of the policy's mode from the expert's action. If there is one, the
            policy's loss is divided by the mean size of Q, so that the weight means the same whatever rewards are.
        temperature: Of the policy's entropy, the first one.
        temperature_rate: Its learning rate; 0: it stays.
        target_entropy: Of the policy; by default minus the numbers in an action.
    """

    kind: Literal["cql"] = "cql"
    penalty: float = 5.0
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
        self.refuse_choices()
        if (
            min(self.actions, self.backup_actions) < 1
            or min(self.temperature, self.penalty_temperature) <= 0.0
        ):
            raise UsageError("actions or a temperature of CQL is too small", cure="use more than 0")
        if self.penalty < 0.0 or self.imitation < 0.0 or (self.gap is not None and self.penalty == 0.0):
            raise UsageError(
                "a weight of CQL is negative, or nothing for a multiplier to begin with", cure="use more"
            )

    def build(self, environment: Environment, data: Any, iterations: int) -> Cql:
        """CQL in an environment."""
        return Cql(self, environment, data, iterations)


class Cql(Offline):
    """CQL in one environment."""

    def __init__(self, config: CqlConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config = config
        self.target_entropy = (
            -float(environment.action_size) if config.target_entropy is None else config.target_entropy
        )
        super().__init__(config, environment, data, iterations)

    def numbers(self) -> dict[str, float]:
        """Logarithms of the temperature, and of the multiplier if there is one."""
        found = {"log_temperature": math.log(self.config.temperature)}
        return found if self.config.gap is None else found | {"log_penalty": math.log(self.config.penalty)}

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """Adam for the numbers, too."""
        rates = {"log_temperature": self.config.temperature_rate, "log_penalty": self.config.penalty_rate}
        return super().optimisers() | {name: optax.adam(rates[name]) for name in self.numbers()}

    def loss(
        self, trained: Trained, target: Mapping[str, Any], part: Transitions, improved: Improved, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Squared errors, the penalty, the policy's loss, and those of temperature and multiplier."""
        critic_key, policy_key = jax.random.split(key)
        critic, critic_logs = self._critic_loss(trained, target, part, critic_key)
        policy, policy_logs = self._policy_loss(trained, improved, policy_key)
        return critic + policy, critic_logs | policy_logs

    def _critic_loss(
        self, trained: Trained, target: Mapping[str, Any], part: Transitions, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        next_key, sample_key = jax.random.split(key)
        policy = jax.lax.stop_gradient(trained["policy"])
        following = self.distribution(policy, part.following)
        then = following.action(by_key(following.sample, next_key, self.config.backup_actions))
        # As in the reference implementation the target has no entropy, though the policy's loss has.
        value = jnp.max(jnp.min(self.q(target["critic"], part.following, then), axis=0), axis=0)
        goal = td_target(part.reward, value, part.terminated, self.config.gamma)
        now = self.distribution(policy, part.observation)
        action, log_density = self._sampled(now, following, part.action, sample_key)
        # All in one call: an observation is encoded, and its gradient taken, once.
        found = self.q(trained["critic"], part.observation, jnp.concatenate([part.action[None], action]))
        q, judged = found[:, 0], jnp.moveaxis(found[:, 1:], 1, 0)
        error = 0.5 * jnp.mean((q - goal) ** 2)
        densities = jnp.broadcast_to(log_density[:, None], judged.shape)
        penalty = conservative_penalty(judged, densities, q, self.config.penalty_temperature)
        weight, weight_loss = self._weight(trained, penalty)
        return error + weight * jnp.mean(penalty) + weight_loss, {
            "critic": error,
            "penalty": jnp.mean(penalty),
            "penalty_weight": weight,
            "mean_q": jnp.mean(q),
            "mean_q_uniform": jnp.mean(judged[: self.config.actions]),
        }

    def _sampled(
        self, now: Distribution, following: Distribution, data: Float[Array, "B D"], key: Array
    ) -> tuple[Float[Array, "K B D"], Float[Array, "K B"]]:
        """Actions that the penalty looks at, and the log-density of each; zero where none is to be divided by."""
        config = self.config
        uniform_key, now_key, then_key = jax.random.split(key, 3)
        shape = (config.actions, *data.shape)
        uniform = jax.random.uniform(uniform_key, shape, minval=-1.0)
        actions = [uniform]
        densities = [jnp.full(shape[:-1], -data.shape[-1] * math.log(2.0))]
        for policy, own_key in ((now, now_key), (following, then_key))[: 2 if config.next_actions else 1]:
            choice = by_key(policy.sample, own_key, config.actions)
            actions.append(policy.action(choice))
            densities.append(jax.vmap(policy.log_prob)(choice))
        if config.importance:
            return jnp.concatenate(actions), jnp.concatenate(densities)
        found = jnp.concatenate([*actions, data[None]])
        return found, jnp.zeros(found.shape[:-1])

    def _weight(self, trained: Trained, penalty: Array) -> tuple[Array, Array]:
        """The penalty's weight, to which no gradient of the penalty flows, and the loss that moves it."""
        if self.config.gap is None:
            return jnp.asarray(self.config.penalty), jnp.zeros(())
        log_weight = jnp.minimum(trained["log_penalty"], _LARGEST_WEIGHT)
        loss = jnp.mean(penalty_weight_loss(log_weight, penalty, self.config.gap))
        return jax.lax.stop_gradient(jnp.exp(log_weight)), loss

    def _policy_loss(
        self, trained: Trained, improved: Improved, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        observation, expert = improved
        temperature = jnp.exp(trained["log_temperature"])
        policy = self.distribution(trained["policy"], observation)
        choice = policy.sample(key)
        log_prob = policy.log_prob(choice)
        judged = self.q(jax.lax.stop_gradient(trained["critic"]), observation, policy.action(choice))
        loss = soft_policy_loss(judged, log_prob, temperature)
        error = policy.mode() - expert
        total = jnp.mean(loss)
        if self.config.imitation:
            lowest = jnp.min(judged, axis=0)
            total = jnp.mean(scaled_policy_loss(loss, lowest)) + self.config.imitation * jnp.mean(error**2)
        heat = jnp.mean(temperature_loss(trained["log_temperature"], log_prob, self.target_entropy))
        return total + heat, {
            "policy": total,
            "mean_q_policy": jnp.mean(judged),
            "entropy": -jnp.mean(log_prob),
            "temperature": temperature,
            "imitation_error": jnp.mean(jnp.abs(error)),
        }
