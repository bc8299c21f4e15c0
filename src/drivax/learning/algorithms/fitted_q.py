"""Fitted-Q evaluation (Le et al. 2019, arXiv 1903.08738): what a policy is worth, from recorded steps alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.learning.algorithms.optimisers import clipped_adam
from drivax.learning.experience import Experience, Recorded, transitions
from drivax.learning.sampler import draw
from drivax.networks.actor_critic import Critic, NetworkConfig
from drivax.networks.distributions import Actions
from drivax.networks.encoders import GroupSpec
from drivax.networks.normalised import Statistics, set_statistics
from drivax.rl.temporal_difference import polyak, td_target


@dataclass(frozen=True)
class FittedQConfig:
    """How a policy is evaluated on held-out steps, at every validation.

    Attributes:
        updates: Of a critic that begins anew at each validation; 0: no such evaluation.
        batch: Steps per update.
        rate: Learning rate of Adam, falling linearly to a tenth.
        tau: How far its target moves toward it per update.
        gradient_norm: Gradients are clipped to this global norm.
    """

    updates: int = 0
    batch: int = 256
    rate: float = 1e-3
    tau: float = 0.01
    gradient_norm: float = 10.0

    def __post_init__(self) -> None:
        if self.updates < 0 or self.batch < 1:
            raise UsageError("negative settings of fitted-Q evaluation", cure="use 0 updates for none")


@dataclass(frozen=True)
class FittedQ:
    """Evaluation of policies in one environment.

    Attributes:
        config: How.
        network: Of the critic.
        environment: With recorded steps.
        gamma: Discount.
    """

    config: FittedQConfig
    network: NetworkConfig
    environment: Recorded
    gamma: float

    def value(
        self,
        data: Experience,
        act: Callable[[dict[str, Array]], Float[Array, "B D"]],
        statistics: Statistics = MappingProxyType({}),
    ) -> Float[Array, ""]:
        """The discounted return that a policy earns from where episodes begin, as a critic estimates it.

        The critic learns ``Q(s, a) = r + gamma (1 - terminated) Q'(s', pi(s'))`` from recorded steps; the result is the
        mean of ``Q(s, pi(s))`` over the first usable step of every scenario. Always by the same draws, so that
        checkpoints differ by their policies alone.

        Args:
            data: The recorded steps.
            act: From a batch of observations to the policy's actions.
            statistics: Of features, where the network is to normalise them.
        """
        network_key, key = jax.random.split(jax.random.key(0))
        critic = self._critic(self.environment.shapes(data.data), network_key)
        set_statistics(critic, statistics)
        graph, first = nnx.split(critic, nnx.Param)
        config = self.config
        optimiser = clipped_adam(config.rate, config.gradient_norm, updates=config.updates)

        def q(parameters: Any, observation: dict[str, Array], action: Array) -> Array:
            return nnx.merge(graph, parameters)(observation, action)

        def update(now: tuple[Any, Any, Any], key: Array) -> tuple[tuple[Any, Any, Any], None]:
            parameters, target, state = now
            part = transitions(self.environment, data, draw(data.critic, key, (config.batch,)))
            then = q(target, part.following, act(part.following))
            goal = td_target(part.reward, then, part.terminated, self.gamma)

            def loss(parameters: Any) -> Array:
                return 0.5 * jnp.mean((q(parameters, part.observation, part.action) - goal) ** 2)

            change, state = optimiser.update(jax.grad(loss)(parameters), state, parameters)
            parameters: Any = optax.apply_updates(parameters, change)
            return (parameters, polyak(target, parameters, config.tau), state), None

        begun = (first, jax.tree.map(jnp.copy, first), optimiser.init(first))
        (parameters, _, _), _ = jax.lax.scan(update, begun, jax.random.split(key, config.updates))
        observation, counts = self._beginnings(data)
        return jnp.sum(q(parameters, observation, act(observation)) * counts) / counts.sum()

    def _critic(self, spec: GroupSpec, key: Array) -> Critic:
        actions = Actions(self.environment.action_size, self.environment.levels)
        return Critic(self.network, spec, nnx.Rngs(key), actions)

    def _beginnings(self, data: Experience) -> tuple[dict[str, Array], Float[Array, " N"]]:
        """The first usable step of every scenario, observed; 0 where a scenario has none."""
        usable = data.expert.usable
        places = jnp.arange(len(usable)), jnp.argmax(usable, axis=1)
        return self.environment.observe_recorded(data.data, places), usable.any(axis=1).astype(jnp.float32)
