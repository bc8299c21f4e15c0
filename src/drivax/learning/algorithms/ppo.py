"""Proximal policy optimisation (Schulman et al. 2017): configuration, state and one iteration on the device."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array

from drivax.learning.algorithm import Also
from drivax.learning.algorithms.optimisers import clipped_adam
from drivax.learning.collector import Rollout, collect
from drivax.learning.devices import divided
from drivax.learning.environment import Environment, Environments
from drivax.networks.actor_critic import ActorCritic, NetworkConfig
from drivax.networks.distributions import Actions, Distribution
from drivax.planners.network_planner import NetworkPlanner
from drivax.rl.advantages import generalised_advantages
from drivax.rl.policy_gradients import clipped_surrogate_loss
from drivax.scenario.record import record


@dataclass(frozen=True)
class PpoConfig:
    """PPO. The defaults train on two CPU cores; the preset ``published`` has the published sizes.

    Attributes:
        network: Policy and value.
        environments: Environments in parallel.
        unroll: Steps per environment and iteration.
        epochs, minibatches: Passes over the experience, and updates per pass.
        learning_rate: Of Adam, falling linearly over the run to ``last_rate`` times itself.
        last_rate: See ``learning_rate``; 1: it stays.
        gamma, lambda_: Discount, and mixing of advantages.
        clip: Of the probability ratio.
        value_coefficient, entropy_coefficient: Weights in the loss.
        gradient_norm: Gradients are clipped to this global norm (None: not at all); those of policy and value apart,
            unless they share an encoder.
    """

    kind: Literal["ppo"] = "ppo"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    environments: int = 256
    unroll: int = 64
    epochs: int = 4
    minibatches: int = 8
    learning_rate: float = 3e-4
    last_rate: float = 0.1
    gamma: float = 0.99
    lambda_: float = 0.95
    clip: float = 0.2
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.01
    gradient_norm: float | None = 0.5

    def __post_init__(self) -> None:
        if self.environments < 1 or self.unroll < 1 or self.minibatches < 1:
            raise ValueError("environments, unroll and minibatches are at least 1")
        if self.steps_per_iteration % self.minibatches:
            raise ValueError(
                f"environments x unroll = {self.steps_per_iteration} is no multiple of {self.minibatches} minibatches"
            )

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.environments * self.unroll

    def build(self, environment: Environment, data: Any, iterations: int) -> Ppo:
        """PPO in an environment."""
        return Ppo(self, environment, data, iterations)


@record
class PpoState:
    """Everything that a run needs to continue: networks, optimiser, environments, key and step."""

    networks: ClassVar[tuple[str, ...]] = ("parameters",)

    parameters: Any
    optimiser: Any
    environments: Environments
    key: Array
    iteration: Array


class Ppo:
    """PPO in one environment. Holds configuration and the network's graph; everything computed is in the state."""

    def __init__(self, config: PpoConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config, self.environment = config, environment
        self.spec = environment.shapes(data)
        self.optimiser = clipped_adam(
            config.learning_rate,
            config.gradient_norm,
            updates=max(iterations * config.epochs * config.minibatches, 1),
            last=config.last_rate,
            eps=1e-5,
            apart=not config.network.shared_encoder,
        )
        # Only the structure is wanted: no number is drawn.
        self.graph = nnx.graphdef(nnx.eval_shape(lambda: self._network(jax.random.key(0))))

    def _network(self, key: Array) -> ActorCritic:
        actions = Actions(self.environment.action_size, self.environment.levels)
        return ActorCritic(self.config.network, self.spec, nnx.Rngs(key), actions)

    def init(self, data: Any, key: Array) -> PpoState:
        """The state before the first iteration."""
        network_key, environment_key, key = jax.random.split(key, 3)
        parameters = nnx.state(self._network(network_key), nnx.Param)
        environments = self.environment.start(data, environment_key, self.config.environments)
        return PpoState(
            parameters, self.optimiser.init(parameters), environments, key, jnp.zeros((), jnp.int32)
        )

    def network(self, parameters: Any) -> ActorCritic:
        """The network with these parameters."""
        return nnx.merge(self.graph, parameters)

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """The policy with these parameters."""
        return self.network(parameters).policy(observation)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """The policy as a planner; the value network stays behind."""
        graph, weights = nnx.split(self.network(parameters).policy)
        return NetworkPlanner(weights, graph, name, samples)

    def with_policy(self, parameters: Any, of: Any) -> Any:
        """Parameters whose policy, a shared encoder included, is that ``of`` other ones."""
        return nnx.State({**parameters.raw_mapping, "policy": of.raw_mapping["policy"]})

    def iterate(
        self, data: Any, state: PpoState, also: Also | None = None
    ) -> tuple[PpoState, dict[str, Array]]:
        """One iteration: collect, then update. Pure; jit it with the state donated.

        Args:
            data: The environment's data.
            state: The state.
            also: A further loss of the parameters, added in every update.

        Returns:
            The next state, and sums (``rollout/*``, see ``collector.collect``) and means (``loss/*``) to log.
        """
        collect_key, update_key, key = jax.random.split(state.key, 3)
        network = self.network(state.parameters)

        def actor(observation: Any, key: Array) -> tuple[Array, Array, dict[str, Array]]:
            policy, value = network.both(observation)
            choice = policy.sample(key)
            return choice, policy.action(choice), {"log_prob": policy.log_prob(choice), "value": value}

        environments, rollout, totals = collect(
            self.environment, data, state.environments, actor, collect_key, self.config.unroll
        )
        batch = self._batch(rollout, network.value(environments.observation))
        parameters, optimiser, losses = self._update(state, batch, update_key, also)
        following = PpoState(parameters, optimiser, environments, key, state.iteration + 1)
        return following, {f"rollout/{name}": value for name, value in totals.items()} | losses

    def _batch(self, rollout: Rollout, last: Array) -> dict[str, Any]:
        """What is learned from, ``[time x batch]``; ``last`` is the value of where the rollout ends."""
        value_t = rollout.extra["value"]
        # The row behind a truncated step holds its final state, so this is the value that it bootstraps.
        value_tp1 = jnp.concatenate([value_t[1:], last[None]])
        advantage, target = generalised_advantages(
            rollout.reward,
            value_t,
            value_tp1,
            rollout.terminated,
            rollout.truncated,
            self.config.gamma,
            self.config.lambda_,
        )
        batch = {
            "observation": rollout.observation,
            "choice": rollout.choice,
            "log_prob": rollout.extra["log_prob"],
            "advantage": advantage,
            "target": target,
            "alive": rollout.alive.astype(jnp.float32),
        }
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)

    def _update(
        self, state: PpoState, batch: dict[str, Any], key: Array, also: Also | None
    ) -> tuple[Any, Any, dict[str, Array]]:
        config = self.config

        def epoch(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], dict[str, Array]]:
            order_key, noise_key = jax.random.split(key)
            order = jax.random.permutation(order_key, config.steps_per_iteration)
            order = order.reshape(config.minibatches, -1)
            # Shuffled once, outside of the loop: inside, the reads would be repeated for every use of a minibatch.
            shuffled = divided(jax.tree.map(lambda leaf: leaf[order], batch), axis=1)
            return jax.lax.scan(minibatch, carry, (shuffled, jax.random.split(noise_key, config.minibatches)))

        def minibatch(
            carry: tuple[Any, Any], now: tuple[dict[str, Any], Array]
        ) -> tuple[tuple[Any, Any], dict[str, Array]]:
            (parameters, optimiser), (part, key) = carry, now
            (_, logs), gradient = jax.value_and_grad(self._loss, has_aux=True)(parameters, part, key, also)
            logs["gradient_norm"] = optax.tree.norm(gradient)
            change, optimiser = self.optimiser.update(gradient, optimiser, parameters)
            return (optax.apply_updates(parameters, change), optimiser), logs

        carry = (state.parameters, state.optimiser)
        (parameters, optimiser), logs = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
        return parameters, optimiser, {f"loss/{name}": value.mean() for name, value in logs.items()}

    def _loss(
        self, parameters: Any, part: dict[str, Any], key: Array, also: Also | None
    ) -> tuple[Array, dict[str, Array]]:
        config, alive = self.config, part["alive"]
        entropy_key, also_key = jax.random.split(key)

        def mean(value: Array) -> Array:
            return jnp.sum(value * alive) / jnp.maximum(jnp.sum(alive), 1.0)

        policy, value = self.network(parameters).both(part["observation"])
        log_prob = policy.log_prob(part["choice"])
        centre = mean(part["advantage"])
        spread = jnp.sqrt(mean((part["advantage"] - centre) ** 2)) + 1e-8
        advantage = (part["advantage"] - centre) / spread
        policy_loss = mean(clipped_surrogate_loss(log_prob, part["log_prob"], advantage, config.clip))
        value_loss = mean((value - part["target"]) ** 2)
        entropy = mean(policy.entropy_estimate(entropy_key))
        total = policy_loss + config.value_coefficient * value_loss - config.entropy_coefficient * entropy
        further, logs = (0.0, {}) if also is None else also(parameters, also_key)
        ratio = jnp.exp(log_prob - part["log_prob"])
        return total + further, logs | {
            "policy": policy_loss,
            "value": value_loss,
            "entropy": entropy,
            "clipped_share": mean((jnp.abs(ratio - 1.0) > config.clip).astype(jnp.float32)),
            "kl": mean(part["log_prob"] - log_prob),
            "explained_variance": 1.0
            - value_loss / jnp.maximum(mean((part["target"] - mean(part["target"])) ** 2), 1e-8),
        }
