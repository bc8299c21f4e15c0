"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905): configuration, state and one iteration on the device."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool

from drivax.errors import UsageError
from drivax.learning import replay
from drivax.learning.algorithm import Also
from drivax.learning.algorithms.optimisers import clipped_adam
from drivax.learning.branches import in_any
from drivax.learning.collector import Actor, collect
from drivax.learning.environment import Environment, Environments
from drivax.learning.replay import Replay, ReplayConfig, Transitions
from drivax.networks.actor_critic import NetworkConfig, Policy, TwinCritic
from drivax.networks.distributions import REPARAMETRISED, Actions, Distribution
from drivax.planners.network_planner import NetworkPlanner
from drivax.rl.temporal_difference import polyak, soft_policy_loss, soft_value, td_target, temperature_loss
from drivax.scenario.record import record


@dataclass(frozen=True)
class SacConfig:
    """SAC. The defaults train on two CPU cores; the preset ``published/sac`` has the published sizes.

    Attributes:
        network: Policy and critics; an encoder each.
        replay: How much is kept, and as what.
        environments: Environments in parallel.
        unroll: Steps per environment and iteration.
        updates_per_step: Updates per step of all environments.
        batch: Steps per update.
        warm_up: Steps before the first update.
        explore: What acts before the first update: uniform actions, or the policy.
        policy_rate, critic_rate, temperature_rate: Learning rates of Adam.
        gamma: Discount.
        tau: How far target critics move toward the critics per update.
        temperature: The first one.
        target_entropy: Of the policy; by default minus the numbers in an action.
        gradient_norm: Gradients of the policy and of the critics are clipped to this global norm; None: not at all.
    """

    kind: Literal["sac"] = "sac"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    environments: int = 16
    unroll: int = 16
    updates_per_step: int = 2
    batch: int = 256
    warm_up: int = 5_000
    explore: Literal["uniform", "policy"] = "uniform"
    policy_rate: float = 3e-4
    critic_rate: float = 3e-4
    temperature_rate: float = 3e-4
    gamma: float = 0.99
    tau: float = 0.005
    temperature: float = 0.1
    target_entropy: float | None = None
    gradient_norm: float | None = 10.0

    def __post_init__(self) -> None:
        if min(self.environments, self.unroll, self.updates_per_step, self.batch) < 1:
            raise ValueError("environments, unroll, updates_per_step and batch are at least 1")
        rows = self.replay.rows(self.environments)
        if self.unroll > rows:
            raise UsageError(
                f"a replay of {rows} rows for an unroll of {self.unroll} steps", cure="give it more capacity"
            )
        if self.unroll < 2 and self.warm_up < 2 * self.environments:
            raise UsageError(
                "there is no step with a successor before the first update",
                cure=f"set warm_up to {2 * self.environments} or more",
            )
        if self.network.distribution not in REPARAMETRISED:
            raise UsageError(
                "SAC needs a policy with a gradient through its samples", cure="gaussian or beta"
            )

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.environments * self.unroll

    def build(self, environment: Environment, data: Any, iterations: int) -> Sac:
        """SAC in an environment."""
        return Sac(self, environment, data)


@record
class Trained:
    """What gradients change."""

    policy: Any
    critic: Any
    log_temperature: Any


@record
class SacState:
    """Everything that a run needs to continue; ``parameters`` are the policy's."""

    networks: ClassVar[tuple[str, ...]] = ("parameters", "critic", "target")

    parameters: Any
    critic: Any
    log_temperature: Array
    target: Any
    optimiser: Any
    replay: Replay
    environments: Environments
    key: Array
    iteration: Array


class Sac:
    """SAC in one environment. Holds configuration and the networks' graphs; everything computed is in the state."""

    def __init__(self, config: SacConfig, environment: Environment, data: Any) -> None:
        self.config, self.environment = config, environment
        self.spec = environment.shapes(data)
        self.target_entropy = (
            -float(environment.action_size) if config.target_entropy is None else config.target_entropy
        )
        optimisers: dict[Hashable, optax.GradientTransformation] = {
            "policy": clipped_adam(config.policy_rate, config.gradient_norm),
            "critic": clipped_adam(config.critic_rate, config.gradient_norm),
            "temperature": optax.adam(config.temperature_rate),
        }
        self.optimiser = optax.partition(optimisers, Trained("policy", "critic", "temperature"))
        # Only the structures are wanted: no number is drawn.
        policy, critic = nnx.eval_shape(lambda: self._networks(jax.random.key(0)))
        self.policy_graph, self.critic_graph = nnx.graphdef(policy), nnx.graphdef(critic)

    def _networks(self, key: Array) -> tuple[Policy, TwinCritic]:
        actions = Actions(self.environment.action_size, self.environment.levels)
        policy_key, critic_key = jax.random.split(key)
        return (
            Policy(self.config.network, self.spec, nnx.Rngs(policy_key), actions),
            TwinCritic(self.config.network, self.spec, nnx.Rngs(critic_key), actions),
        )

    def init(self, data: Any, key: Array) -> SacState:
        """The state before the first iteration."""
        network_key, environment_key, key = jax.random.split(key, 3)
        policy, critic = (nnx.state(network, nnx.Param) for network in self._networks(network_key))
        log_temperature = jnp.asarray(math.log(self.config.temperature), jnp.float32)
        environments = self.environment.start(data, environment_key, self.config.environments)
        trained: Any = Trained(policy, critic, log_temperature)
        return SacState(
            parameters=policy,
            critic=critic,
            log_temperature=log_temperature,
            target=jax.tree.map(jnp.copy, critic),
            optimiser=self.optimiser.init(trained),
            replay=replay.init(self.config.replay, self.environment, environments),
            environments=environments,
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """The policy with these parameters."""
        return nnx.merge(self.policy_graph, parameters)(observation)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """The policy as a planner."""
        return NetworkPlanner(parameters, self.policy_graph, name, samples)

    def with_policy(self, parameters: Any, of: Any) -> Any:
        """Parameters whose policy is that ``of`` other ones: these, since there are no others among them."""
        return of

    def iterate(
        self, data: Any, state: SacState, also: Also | None = None
    ) -> tuple[SacState, dict[str, Array]]:
        """One iteration: collect, then update so many times. Pure; jit it with the state donated.

        Args:
            data: The environment's data.
            state: The state.
            also: A further loss of the policy.

        Returns:
            The next state, and sums to log: ``rollout/*`` of the collector, ``loss/*`` with ``loss/*/n``.
        """
        config = self.config
        collect_key, draw_key, update_key, key = jax.random.split(state.key, 4)
        before = state.iteration * config.steps_per_iteration
        actor = self._actor(state.parameters, explores=before < config.warm_up)
        environments, rollout, totals = collect(
            self.environment, data, state.environments, actor, collect_key, config.unroll, config.replay.store
        )
        kept = replay.add(state.replay, rollout)
        first = (
            Trained(state.parameters, state.critic, state.log_temperature),
            state.target,
            state.optimiser,
        )

        @jax.jit  # so that asking for the shapes of what it logs traces nothing a second time
        def learn() -> tuple[tuple[Trained, Any, Any], dict[str, Array]]:
            places = replay.draw(kept, draw_key, (config.unroll * config.updates_per_step, config.batch))

            def update(now: Any, drawn: tuple[replay.Places, Array]) -> Any:
                part = replay.sample(self.environment, data, kept, drawn[0])
                return self._update(now, part, drawn[1], also)

            keys = jax.random.split(update_key, len(places[0]))
            trained, logs = jax.lax.scan(update, first, (places, keys))
            return trained, _sums(logs)

        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(learn)[1])
        warm = in_any(before + config.steps_per_iteration >= config.warm_up)
        (trained, target, optimiser), losses = jax.lax.cond(warm, learn, lambda: (first, nothing))
        following = SacState(
            trained.policy, trained.critic, trained.log_temperature, target, optimiser, kept, environments, key,
            state.iteration + 1,
        )  # fmt: skip
        return following, {f"rollout/{name}": value for name, value in totals.items()} | losses

    def _actor(self, parameters: Any, explores: Bool[Array, ""]) -> Actor:
        """Samples the policy, or as configured where it ``explores``; remembers the action as its choice."""

        def actor(observation: Any, key: Array) -> tuple[Array, Array, dict[str, Array]]:
            sample_key, uniform_key = jax.random.split(key)
            policy = self.distribution(parameters, observation)
            action = policy.action(policy.sample(sample_key))
            if self.config.explore == "uniform":
                anything = jax.random.uniform(uniform_key, action.shape, minval=-1.0)
                action = jnp.where(explores, anything, action)
            return action, action, {}

        return actor

    def _update(
        self, now: tuple[Any, Any, Any], part: Transitions, key: Array, also: Also | None
    ) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
        """All three losses at the same parameters, then the target critics.

        Args:
            now: What is :class:`Trained`, the target critics, and the optimiser's state.
            part: The batch.
            key: Of samples.
            also: A further loss of the policy.
        """
        trained, target, optimiser = now
        (_, logs), gradient = jax.value_and_grad(self._loss, has_aux=True)(trained, target, part, key, also)
        logs["policy_gradient_norm"] = optax.tree.norm(gradient.policy)
        logs["critic_gradient_norm"] = optax.tree.norm(gradient.critic)
        change, optimiser = self.optimiser.update(gradient, optimiser, trained)
        trained: Any = optax.apply_updates(trained, change)
        return (trained, polyak(target, trained.critic, self.config.tau), optimiser), logs

    def _loss(
        self, trained: Trained, target: Any, part: Transitions, key: Array, also: Also | None
    ) -> tuple[Array, dict[str, Array]]:
        """The sum of the losses; each reaches its own parameters only."""
        next_key, key, also_key = jax.random.split(key, 3)
        temperature = jnp.exp(trained.log_temperature)
        following = self.distribution(trained.policy, part.following)
        choice = following.sample(next_key)
        value = soft_value(
            self._q(target, part.following, following.action(choice)), following.log_prob(choice), temperature
        )
        goal = td_target(part.reward, value, part.terminated, self.config.gamma)
        q = self._q(trained.critic, part.observation, part.action)
        critic_loss = 0.5 * jnp.mean((q - goal) ** 2)

        policy = self.distribution(trained.policy, part.observation)
        choice = policy.sample(key)
        log_prob = policy.log_prob(choice)
        judged = self._q(jax.lax.stop_gradient(trained.critic), part.observation, policy.action(choice))
        policy_loss = jnp.mean(soft_policy_loss(judged, log_prob, temperature))
        heat = jnp.mean(temperature_loss(trained.log_temperature, log_prob, self.target_entropy))
        further, logs = (0.0, {}) if also is None else also(trained.policy, also_key)
        return critic_loss + policy_loss + heat + further, logs | {
            "critic": critic_loss,
            "policy": policy_loss,
            "mean_q": jnp.mean(q),
            "entropy": -jnp.mean(log_prob),
            "temperature": temperature,
        }

    def _q(self, parameters: Any, observation: dict[str, Array], action: Array) -> Array:
        return nnx.merge(self.critic_graph, parameters)(observation, action)


def _sums(logs: dict[str, Array]) -> dict[str, Array]:
    """Sums over updates, and of how many."""
    sums = {}
    for name, values in logs.items():
        sums[f"loss/{name}"] = values.sum()
        sums[f"loss/{name}/n"] = jnp.asarray(float(len(values)))
    return sums
