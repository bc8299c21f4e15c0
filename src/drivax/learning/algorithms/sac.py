"""Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905)."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool

from drivax.checks import (
    MOST_RETURN_STEPS,
    MOST_STEPS_PER_ITERATION,
    check_above_zero,
    check_at_least,
    check_counts,
    check_shares,
)
from drivax.errors import UsageError
from drivax.learning.algorithm import AuxiliaryLoss
from drivax.learning.algorithms.off_policy import Carry, OffPolicy, q_logs, sample_each, target_entropy
from drivax.learning.algorithms.optimisers import (
    add_auxiliary,
    average,
    check_average,
    clipped_adam,
    in_chunks,
    mean_gradients,
    trained_parameters,
)
from drivax.learning.environment import (
    Environment,
    Environments,
    Outcome,
    Rollout,
    SampledAction,
    any_across_learners,
    collect,
    transition,
)
from drivax.learning.experience import (
    Experience,
    ExperienceConfig,
    StepIndex,
    environment_data,
    require_log,
    sample_steps,
    transitions,
)
from drivax.learning.program import is_largest
from drivax.learning.replay import Replay, ReplayBuffer, ReplayConfig, ReplayIndex, Transitions
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.distributions import REPARAMETERISED
from drivax.rl.equations import soft_value
from drivax.scenario.record import record

#: Indices of steps in the replay buffer, and of logged steps or None.
_BatchIndex = tuple[ReplayIndex, StepIndex | None]
#: Two keys of each sample ``[batch, 2]``, and that of the auxiliary loss.
_BatchKeys = tuple[Array, Array]


@dataclass(frozen=True)
class SacConfig:
    """SAC. The defaults train on two CPU cores; the preset ``published/sac`` has the published sizes.

    Attributes:
        network: Architecture of policy and critics.
        replay: Size and format of the replay buffer.
        environments: Environments in parallel.
        unroll: Steps per environment and iteration.
        updates_per_step: Updates per step of all environments.
        batch: Steps per update.
        steps: Steps of the n-step returns; their actions are not corrected for later changes of the policy.
        demonstrations: Share of each batch drawn from the log's expert (Ball et al. 2023, arXiv 2302.02948).
        warm_up: Steps before the first update.
        explore: Actions before the first update: ``uniform``, or sampled from the ``policy``.
        policy_rate, critic_rate, temperature_rate: Learning rates of Adam.
        gamma: Discount.
        tau: Polyak averaging rate of the target critics.
        temperature: Initial temperature.
        target_entropy: Target entropy of the policy; by default minus the size of an action.
        gradient_norm: Maximum global norm of the policy's gradient, and of that of both critics; None: no clipping.
        average: Decay per iteration of an exponential moving average of the policy's parameters, which is validated
            and exported in place of the newest ones; 0: no average.
    """

    kind: Literal["sac"] = "sac"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    environments: int = 16
    unroll: int = 16
    updates_per_step: int = 2
    batch: int = 256
    steps: int = 1
    demonstrations: float = 0.0
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
    average: float = 0.0

    def __post_init__(self) -> None:
        check_average(self.average)
        check_counts(self, "environments", "unroll", "updates_per_step", "batch")
        check_counts(self, "steps_per_iteration", most=MOST_STEPS_PER_ITERATION)
        check_counts(self, "steps", most=MOST_RETURN_STEPS)
        check_at_least(self, 0, "policy_rate", "critic_rate", "temperature_rate")
        check_above_zero(self, "temperature", "gradient_norm")
        check_shares(self, "gamma", "tau")
        if not 0.0 <= self.demonstrations < 1.0:
            raise UsageError(
                f"demonstrations is {self.demonstrations}", cure="use a share of at least 0 and below 1"
            )
        if self.demonstrations and not 0 < self.logged_batch < self.batch:
            rounded = f"{self.logged_batch} logged steps in a batch of {self.batch}"
            problem = f"demonstrations {self.demonstrations} rounds to {rounded}"
            raise UsageError(problem, cure="choose a share of at least 1 step and less than the whole batch")
        rows = self.replay.rows(self.environments)
        if self.unroll > rows:
            problem = f"unroll of {self.unroll} steps does not fit a replay buffer of {rows} rows"
            raise UsageError(problem, cure=f"set replay.capacity to {self.steps_per_iteration} or more")
        if self.unroll < 2 and self.warm_up < 2 * self.environments:
            cure = f"set warm_up to {2 * self.environments} or more"
            raise UsageError("the first update has no step with a successor to sample", cure=cure)
        if self.network.distribution not in REPARAMETERISED:
            cure = "set distribution to gaussian or beta"
            raise UsageError("SAC needs a policy with reparameterised samples", cure=cure)

    @property
    def logged_batch(self) -> int:
        """Number of logged steps in each batch."""
        return round(self.demonstrations * self.batch)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.environments * self.unroll

    def experience(
        self, environment: Environment, data: Any, weights: np.ndarray | None
    ) -> Experience | None:
        """Return the logged steps to draw demonstrations from; None without ``demonstrations``."""
        return ExperienceConfig().of(environment, data, weights) if self.demonstrations else None

    def build(self, environment: Environment, data: Any, iterations: int) -> Sac:
        """Return SAC in an environment."""
        return Sac(self, environment, data)


@record
class SacParameters:
    """Parameters of all networks, and the temperature."""

    policy: Any
    critic: Any
    log_temperature: Any

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)


@record
class SacState:
    """State of a run.

    ``parameters`` are those of the planner. With ``average`` they are a moving average of the policy's parameters
    ``trained``; without, they are the policy's parameters, and ``trained`` is None.
    """

    networks: ClassVar[tuple[str, ...]] = ("parameters", "critic", "target")

    parameters: Any
    trained: Any
    critic: Any
    log_temperature: Array
    target: Any
    optimiser: Any
    replay: Replay
    environments: Environments
    key: Array
    iteration: Array


class Sac(OffPolicy[SacConfig]):
    """SAC in one environment."""

    def __init__(self, config: SacConfig, environment: Environment, data: Any) -> None:
        super().__init__(config, environment, data)
        self.buffer = ReplayBuffer(config.replay, environment)
        self.target_entropy = target_entropy(config, environment)
        optimisers: dict[Hashable, optax.GradientTransformation] = {
            "policy": clipped_adam(config.policy_rate, config.gradient_norm),
            "critic": clipped_adam(config.critic_rate, config.gradient_norm),
            "temperature": optax.adam(config.temperature_rate),
        }
        self.optimiser = optax.partition(optimisers, SacParameters("policy", "critic", "temperature"))

    def init(self, data: Any, key: Array) -> SacState:
        """Return the initial state."""
        network_key, environment_key, key = jax.random.split(key, 3)
        networks = self.networks(network_key)
        policy, critic = (nnx.state(networks[name], nnx.Param) for name in ("policy", "critic"))
        log_temperature = jnp.asarray(math.log(self.config.temperature), jnp.float32)
        bank = environment_data(data)
        environments = self.environment.start(bank, environment_key, self.config.environments)
        trained: Any = SacParameters(policy, critic, log_temperature)
        return SacState(
            parameters=policy,
            trained=jax.tree.map(jnp.copy, policy) if self.config.average else None,
            critic=critic,
            log_temperature=log_temperature,
            target=jax.tree.map(jnp.copy, critic),
            optimiser=self.optimiser.init(trained),
            replay=self.buffer.init(environments),
            environments=environments,
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def iterate(
        self, data: Any, state: SacState, auxiliary_loss: AuxiliaryLoss | None = None,
        settling: Bool[Array, ""] | None = None,
    ) -> tuple[SacState, dict[str, Array]]:  # fmt: skip
        """Collect a rollout, then update. Pure; jit it with the state donated.

        While ``settling`` only the critics learn.

        Returns:
            The next state, and sums to log: ``rollout/*`` of the collector, ``loss/*`` with ``loss/*/n``.
        """
        actor, key = partial(self.sample_action, state), self.rollout_key(state)
        unroll, keep = self.config.unroll, self.config.replay.store
        environments, rollout, totals = collect(
            self.environment, environment_data(data), state.environments, actor, key, unroll, keep
        )
        state = replace(state, environments=environments, replay=self.buffer.add(state.replay, rollout))
        state, losses = self.update(data, state, auxiliary_loss, settling)
        return state, {f"rollout/{name}": value for name, value in totals.items()} | losses

    def rollout_key(self, state: SacState) -> Array:
        """Return the random key of the next rollout."""
        return jax.random.split(state.key, 4)[0]

    def sample_action(self, state: SacState, observation: Any, key: Array) -> SampledAction:
        """Sample the policy, or uniform actions during warm-up; the buffer stores the action as raw action."""
        sample_key, uniform_key = jax.random.split(key)
        policy = self.distribution(trained_parameters(state), observation)
        action = policy.action(policy.sample(sample_key))
        if self.config.explore == "uniform":
            uniform = jax.random.uniform(uniform_key, action.shape, minval=-1.0)
            warming_up = state.iteration * self.config.steps_per_iteration < self.config.warm_up
            action = jnp.where(warming_up, uniform, action)
        return SampledAction(action, action, {})

    def transition(self, now: Environments, sampled: SampledAction, outcome: Outcome) -> Rollout:
        """Return one row of a rollout, in the format of the buffer."""
        return transition(self.environment, now, sampled, outcome, self.config.replay.store)

    def update(
        self, data: Any, state: SacState, auxiliary_loss: AuxiliaryLoss | None = None,
        settling: Bool[Array, ""] | None = None,
    ) -> tuple[SacState, dict[str, Array]]:  # fmt: skip
        """Take the updates of one iteration on batches from the buffer; none before ``warm_up`` steps.

        The state has the rollout of this iteration in ``replay``. With ``demonstrations``, ``data`` is the experience
        of :func:`~drivax.learning.algorithm.training_data`.
        """
        config = self.config
        _, draw_key, update_key, key = jax.random.split(state.key, 4)
        steps_before = state.iteration * config.steps_per_iteration
        trained = SacParameters(trained_parameters(state), state.critic, state.log_temperature)
        initial: Carry = (trained, {"critic": state.target}, state.optimiser)

        @jax.jit  # so that finding the shapes of its logs does not trace it a second time
        def learn() -> tuple[Carry, dict[str, Array]]:
            def update(carry: Carry, drawn: tuple[_BatchIndex, _BatchKeys]) -> tuple[Carry, dict[str, Array]]:
                index, (keys, auxiliary_key) = drawn
                batch = self._sample(data, state.replay, index)
                after, logs = self.update_networks(carry, batch, keys, auxiliary_key, auxiliary_loss)
                return after if settling is None else _keep_policy(settling, carry, after), logs

            updates = config.unroll * config.updates_per_step
            index = self._draw(data, state.replay, draw_key, updates)
            # In one call, which is faster than a call per update.
            keys = jax.vmap(self._batch_keys)(jax.random.split(update_key, updates))
            carry, logs = jax.lax.scan(update, initial, (index, keys))
            return carry, _sums(logs)

        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(learn)[1])
        is_warm = any_across_learners(steps_before + config.steps_per_iteration >= config.warm_up)
        (trained, target, optimiser), losses = jax.lax.cond(is_warm, learn, lambda: (initial, zeros))
        after = replace(
            state,
            **average(state, trained.policy, config.average),
            critic=trained.critic,
            log_temperature=trained.log_temperature,
            target=target["critic"],
            optimiser=optimiser,
            key=key,
            iteration=state.iteration + 1,
        )
        return after, losses

    def _draw(self, data: Any, replay: Replay, key: Array, updates: int) -> _BatchIndex:
        """Draw steps of the buffer and, with ``demonstrations``, of the log for all updates."""
        logged_batch = self.config.logged_batch
        index = self.buffer.draw(replay, key, (updates, self.config.batch - logged_batch))
        if not logged_batch:
            return index, None
        return index, sample_steps(data.critic, jax.random.fold_in(key, 1), (updates, logged_batch))

    def _batch_keys(self, key: Array) -> _BatchKeys:
        key, auxiliary_key = jax.random.split(key)
        return jax.random.split(key, (self.config.batch, 2)), auxiliary_key

    def _sample(self, data: Any, replay: Replay, index: _BatchIndex) -> Transitions:
        """Return the batch at an index of :meth:`_draw`."""
        gamma, steps = self.config.gamma, self.config.steps
        batch = self.buffer.sample(environment_data(data), replay, index[0], gamma, steps)
        if index[1] is None:
            return batch
        demonstrations = transitions(require_log(self.environment), data, index[1], gamma, steps)
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), batch, demonstrations)

    def gradient(
        self, trained: SacParameters, target: dict[str, Any], transitions: Transitions, keys: Array,
        auxiliary_key: Array, auxiliary_loss: AuxiliaryLoss | None,
    ) -> tuple[dict[str, Array], SacParameters]:  # fmt: skip
        """Return values to log, and the gradient of :meth:`loss`, in chunks, plus that of the auxiliary loss.

        ``keys`` are two per transition.
        """

        def loss(trained: SacParameters, samples: Any) -> tuple[Array, dict[str, Array]]:
            return self.loss(trained, target, *samples)

        samples = in_chunks((transitions, keys))
        logs, gradient = mean_gradients(loss, trained, samples)
        logs, policy = add_auxiliary(auxiliary_loss, trained.policy, auxiliary_key, logs, gradient.policy)
        return logs, replace(gradient, policy=policy)

    def loss(
        self, trained: SacParameters, target: Any, batch: Transitions, keys: Array
    ) -> tuple[Array, dict[str, Array]]:
        """Return the sum of the losses of critics, policy and temperature; ``keys`` are two per sample."""
        next_policy = self.distribution(trained.policy, batch.next_observation)
        raw_action = sample_each(next_policy, keys[:, 0])
        next_q = self.q_values(target["critic"], batch.next_observation, next_policy.action(raw_action))
        temperature = jnp.exp(trained.log_temperature)
        next_value = soft_value(next_q, next_policy.log_prob(raw_action), temperature)
        critic_loss, q = self.critic_loss(trained, batch, next_value)
        actor = self.soft_actor(trained, batch.observation, self.target_entropy, keys[:, 1])
        policy_loss = jnp.mean(actor.loss)
        logs = actor.logs | {"critic": critic_loss, "policy": policy_loss} | q_logs(q)
        return critic_loss + policy_loss + actor.temperature_loss, logs


def _keep_policy(settling: Bool[Array, ""], before: Carry, after: Carry) -> Carry:
    """Return the carry after an update that, while settling, leaves policy, temperature and their optimisers fixed."""
    (old, _, old_optimiser), (new, target, optimiser) = before, after
    keep = partial(jax.tree.map, partial(jnp.where, settling))
    fixed = {
        name: keep(old_optimiser.inner_states[name], optimiser.inner_states[name])
        for name in ("policy", "temperature")
    }
    policy, log_temperature = keep((old.policy, old.log_temperature), (new.policy, new.log_temperature))
    optimiser = optimiser._replace(inner_states={**optimiser.inner_states, **fixed})
    return SacParameters(policy, new.critic, log_temperature), target, optimiser


def _sums(logs: dict[str, Array]) -> dict[str, Array]:
    """Return the logs of an iteration with counts: sums over updates, and maxima of ``largest_*``."""
    sums: dict[str, Array] = {}
    for name, values in logs.items():
        largest = is_largest(name)
        sums[f"loss/{name}"] = values.max() if largest else values.sum()
        sums[f"loss/{name}/n"] = jnp.asarray(1.0 if largest else float(len(values)))
    return sums
