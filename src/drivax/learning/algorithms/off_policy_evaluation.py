"""Off-policy evaluation: the return of a policy, estimated from episodes of other policies.

Fitted-Q evaluation needs no probabilities. Importance sampling and the doubly robust estimator also need those of the
behaviour policy; for recorded planners, a clone of all episodes stands in for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.checks import MOST_SAMPLES, check_above_zero, check_at_least, check_at_most, check_shares
from drivax.learning.algorithms.off_policy import squared_error
from drivax.learning.algorithms.optimisers import clipped_adam
from drivax.learning.experience import Experience, LoggedEnvironment, sample_steps, transitions
from drivax.networks.actor_critic import Critic, NetworkConfig
from drivax.networks.distributions import Actions, Distribution
from drivax.networks.encoders import Statistics, set_statistics
from drivax.rl.equations import Estimate, doubly_robust, polyak, td_target, weighted_importance_sampling

Observation = dict[str, Array]
#: Maps a batch of observations to actions.
Act = Callable[[Observation], Float[Array, "B D"]]
#: Maps a batch of observations and actions to values.
QFunction = Callable[[Observation, Float[Array, "B D"]], Float[Array, " B"]]
#: Maps a batch of observations to distributions of actions.
PolicyFunction = Callable[[Observation], Distribution]
#: Largest ratio of probabilities of one action, and its inverse the smallest: densities of a clone are inaccurate.
MOST_RATIO = 10.0
#: Actions that the value of a state is averaged over.
_SAMPLES = 8


@dataclass(frozen=True)
class FittedQConfig:
    """Settings of fitted-Q evaluation on held-out steps, at every validation.

    Attributes:
        updates: Updates of a new critic at each validation; 0: no fitted-Q evaluation.
        batch: Steps per update.
        rate: Initial learning rate of Adam; decays linearly to a tenth.
        tau: Polyak averaging rate of the target critic.
        gradient_norm: Maximum global norm of the gradient.
    """

    updates: int = 0
    batch: int = 256
    rate: float = 1e-3
    tau: float = 0.01
    gradient_norm: float = 10.0

    def __post_init__(self) -> None:
        check_at_least(self, 1, "batch")
        check_at_most(self, MOST_SAMPLES, "batch", "updates")
        check_at_least(self, 0, "updates", "rate")
        check_shares(self, "tau")
        check_above_zero(self, "gradient_norm")


@dataclass(frozen=True)
class FittedQ:
    """Fitted-Q evaluation (Le et al. 2019, arXiv 1903.08738) of policies, from logged steps alone."""

    config: FittedQConfig
    network: NetworkConfig
    environment: LoggedEnvironment
    gamma: float

    def fit(self, data: Experience, act: Act, statistics: Statistics = MappingProxyType({})) -> QFunction:
        """Return Q of a policy: ``Q(s, a) = r + gamma (1 - terminated) Q'(s', pi(s'))``, learned from logged steps.

        Every call draws the same steps. ``statistics`` are those of the features, for a network that normalises them.
        """
        network_key, key = jax.random.split(jax.random.key(0))
        actions = Actions(self.environment.action_size, self.environment.levels)
        critic = Critic(self.network, self.environment.shapes(data.data), nnx.Rngs(network_key), actions)
        set_statistics(critic, statistics)
        graph, initial = nnx.split(critic, nnx.Param)
        config = self.config
        optimiser = clipped_adam(config.rate, config.gradient_norm, updates=config.updates)

        def q_values(parameters: Any, observation: dict[str, Array], action: Array) -> Array:
            return nnx.merge(graph, parameters)(observation, action)

        def update(carry: tuple[Any, Any, Any], key: Array) -> tuple[tuple[Any, Any, Any], None]:
            parameters, target_parameters, state = carry
            index = sample_steps(data.critic, key, (config.batch,))
            batch = transitions(self.environment, data, index, self.gamma)
            next_action = act(batch.next_observation)
            next_value = q_values(target_parameters, batch.next_observation, next_action)
            target = td_target(batch.reward, next_value, batch.terminated, batch.discount)

            def loss(parameters: Any) -> Array:
                return squared_error(q_values(parameters, batch.observation, batch.action), target)

            updates, state = optimiser.update(jax.grad(loss)(parameters), state, parameters)
            parameters: Any = optax.apply_updates(parameters, updates)
            return (parameters, polyak(target_parameters, parameters, config.tau), state), None

        carry = (initial, jax.tree.map(jnp.copy, initial), optimiser.init(initial))
        (parameters, _, _), _ = jax.lax.scan(update, carry, jax.random.split(key, config.updates))
        return partial(q_values, parameters)

    def value(
        self, data: Experience, act: Act, statistics: Statistics = MappingProxyType({})
    ) -> Float[Array, ""]:
        """Return the estimated return of a policy: the mean of ``Q(s, pi(s))`` over the first usable steps of logs."""
        q = self.fit(data, act, statistics)
        observation, weight = self._first_steps(data)
        return jnp.sum(q(observation, act(observation)) * weight) / weight.sum()

    def _first_steps(self, data: Experience) -> tuple[dict[str, Array], Float[Array, " M"]]:
        """Observe the first usable step of every log; weight 0 where a log has none."""
        usable = data.expert.usable
        index = jnp.arange(len(usable)), jnp.argmax(usable, axis=1)
        return self.environment.observe_recorded(data.data, index), usable.any(axis=1).astype(jnp.float32)


def estimate_return(
    environment: LoggedEnvironment, data: Experience, policy: PolicyFunction, behaviour: PolicyFunction,
    q: QFunction, gamma: float,
) -> dict[str, Estimate]:  # fmt: skip
    """Return the discounted return of a policy over the episodes of ``data`` by two estimators.

    The policy samples its actions. Each step's ratio of probabilities lies in ``[1 / MOST_RATIO, MOST_RATIO]``, and is
    1 where the action was clipped.

    Args:
        environment: Environment of the episodes.
        data: Episodes, preferably of seeds or scenarios that did not train the policies and Q.
        policy: The evaluated policy.
        behaviour: The policy of the episodes.
        q: Q of the evaluated policy (:meth:`FittedQ.fit`).
        gamma: Discount.

    Returns:
        ``weighted_importance_sampling`` and ``doubly_robust`` (:mod:`drivax.rl.equations`).
    """
    expert = data.expert
    count, times = expert.usable.shape
    rows = jnp.arange(count)
    # Steps from the first usable one on, so that all episodes begin at step 0; the last step is never usable.
    steps = jnp.minimum(jnp.argmax(expert.usable, axis=1)[:, None] + jnp.arange(times), times - 1)
    usable, reward = expert.usable[rows[:, None], steps], expert.reward[rows[:, None], steps]

    def evaluate(step: Array) -> tuple[Array, Array, Array]:
        """Return ratio, Q and value at one step of all episodes."""
        index = rows, step
        observation = environment.observe_recorded(data.data, index)
        action = expert.action[index]
        target, source = policy(observation), behaviour(observation)
        log_ratio = target.log_prob(target.raw_action(action)) - source.log_prob(source.raw_action(action))
        bound = math.log(MOST_RATIO)
        ratio = jnp.where(expert.clipped[index], 1.0, jnp.exp(jnp.clip(log_ratio, -bound, bound)))
        keys = jax.random.split(jax.random.key(0), _SAMPLES)
        values = jax.vmap(lambda key: q(observation, target.action(target.sample(key))))(keys)
        return ratio, q(observation, action), values.mean(axis=0)

    ratio, q_t, value_t = (x.T for x in jax.lax.map(evaluate, steps.T))
    return {
        "weighted_importance_sampling": weighted_importance_sampling(reward, ratio, usable, gamma),
        "doubly_robust": doubly_robust(reward, ratio, usable, q_t, value_t, gamma),
    }
