"""Proximal policy optimisation (Schulman et al. 2017, arXiv 1707.06347)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from drivax.checks import (
    MOST_STEPS_PER_ITERATION,
    check_above_zero,
    check_at_least,
    check_counts,
    check_shares,
)
from drivax.errors import UsageError, did_you_mean
from drivax.learning.algorithm import AuxiliaryLoss
from drivax.learning.algorithms.optimisers import (
    add_auxiliary,
    average,
    check_average,
    chunk_size,
    clipped_adam,
    sum_gradients,
    trained_parameters,
    unless_first,
)
from drivax.learning.environment import (
    Environment,
    Environments,
    Outcome,
    Rollout,
    SampledAction,
    collect,
    past_policy,
    transition,
)
from drivax.learning.program import compute_on_each_device, device_count, map_over_devices, shard_axis
from drivax.networks.actor_critic import ActorCritic, NetworkConfig, graph_of
from drivax.networks.distributions import Actions, Distribution
from drivax.planners.functions import NetworkPlanner
from drivax.rl.equations import clipped_surrogate_loss, generalised_advantages
from drivax.scenario.record import record

#: Parameters, the optimiser's state, and whether ``target_kl`` stopped the updates.
_Carry = tuple[Any, ...]
#: Arrays of a minibatch that are averaged before the gradient: every device has them whole.
_WHOLE = ("alive", "advantage", "target")


@dataclass(frozen=True)
class PpoConfig:
    """PPO. The defaults train on two CPU cores; the preset ``published/ppo`` has the published sizes.

    Attributes:
        network: Architecture of policy and value.
        environments: Environments in parallel.
        unroll: Steps per environment and iteration.
        epochs, minibatches: Passes over the rollout, and updates per pass.
        learning_rate, last_rate: Initial learning rate of Adam, and the final one relative to it; the decay is linear.
        gamma, lambda_: Discount, and decay of generalised advantages.
        clip: Clipping range of the probability ratio around 1.
        value_coefficient, entropy_coefficient: Weights in the loss.
        target_kl: Largest KL divergence from the policy that sampled the rollout. A minibatch above it is skipped, with
            all later ones of the iteration; skipped ones do not decay the learning rate. None: no limit.
        gradient_norm: Maximum global norm of gradients (None: no clipping), separately for policy and value unless they
            share an encoder.
        average: Decay per iteration of an exponential moving average of the parameters, which is validated and
            exported in place of the newest ones; 0: no average.
        constraints: Upper limits of costs, by penalty of the reward. A cost is the mean sum of the penalty per episode,
            divided by its weight; that of a failure that ends the episode is the share of episodes that it ends.
            Lagrange multipliers replace the weights.
        multiplier_rate: Step size of the multipliers per iteration.
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
    target_kl: float | None = None
    gradient_norm: float | None = 0.5
    average: float = 0.0
    constraints: dict[str, float] = field(default_factory=dict)
    multiplier_rate: float = 0.1

    def __post_init__(self) -> None:
        for name, limit in self.constraints.items():
            if not limit >= 0.0:
                raise UsageError(f"the limit of constraint {name!r} is {limit}", cure="use 0 or more")
        check_average(self.average)
        check_counts(self, "environments", "unroll", "epochs", "minibatches")
        check_counts(self, "steps_per_iteration", most=MOST_STEPS_PER_ITERATION)
        check_at_least(self, 0, "learning_rate", "last_rate", "clip", "value_coefficient", "multiplier_rate")
        check_shares(self, "gamma", "lambda_")
        check_above_zero(self, "target_kl", "gradient_norm")
        steps, minibatches = self.steps_per_iteration, self.minibatches
        if steps % minibatches:
            problem = f"environments x unroll = {steps} is not a multiple of {minibatches} minibatches"
            raise UsageError(problem, cure="change environments, unroll or minibatches")

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.environments * self.unroll

    def build(self, environment: Environment, data: Any, iterations: int) -> Ppo:
        """Return PPO in an environment."""
        return Ppo(self, environment, data, iterations)


@record
class PpoState:
    """State of a run: networks, optimiser, environments, key, iteration, and multipliers of constraints.

    ``parameters`` are those of the planner: with ``average``, the moving average of ``trained``, which is None without
    ``average``. ``past`` are the parameters of the older copy of ``environment.PastPolicy``; None if there is none.
    """

    networks: ClassVar[tuple[str, ...]] = ("parameters",)

    parameters: Any
    trained: Any
    optimiser: Any
    environments: Environments
    key: Array
    iteration: Array
    multipliers: dict[str, Array] = field(default_factory=dict)
    past: Any = None


class Ppo:
    """PPO in one environment."""

    def __init__(self, config: PpoConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config, self.environment = config, environment
        self.spec = environment.shapes(data)
        self.constraints = Constraints.of(config.constraints, config.multiplier_rate, environment)
        self.past = past_policy(environment, config.environments)
        self.optimiser = clipped_adam(
            config.learning_rate,
            config.gradient_norm,
            updates=max(iterations * config.epochs * config.minibatches, 1),
            last=config.last_rate,
            eps=1e-5,
            per_network=not config.network.shared_encoder,
        )
        # Traced only: no random numbers are drawn.
        self.graph = graph_of(nnx.eval_shape(lambda: self._network(jax.random.key(0))))

    def _network(self, key: Array) -> ActorCritic:
        actions = Actions(self.environment.action_size, self.environment.levels)
        return ActorCritic(self.config.network, self.spec, nnx.Rngs(key), actions)

    def init(self, data: Any, key: Array) -> PpoState:
        """Return the initial state."""
        network_key, environment_key, key = jax.random.split(key, 3)
        parameters = nnx.state(self._network(network_key), nnx.Param)
        environments = self.environment.start(data, environment_key, self.config.environments)
        optimiser = self.optimiser.init(parameters)
        # Copies, because a donated state must not hold an array twice.
        copy = partial(jax.tree.map, jnp.copy, parameters)
        trained = copy() if self.config.average else None
        past = None if self.past is None else copy()
        iteration, multipliers = jnp.zeros((), jnp.int32), self.constraints.init()
        return PpoState(parameters, trained, optimiser, environments, key, iteration, multipliers, past)

    def network(self, parameters: Any) -> ActorCritic:
        """Return the network with these parameters."""
        return nnx.merge(self.graph, parameters)

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """Return the policy's action distribution."""
        return self.network(parameters).policy(observation)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """Return the policy as a planner, without the value network."""
        graph, weights = nnx.split(self.network(parameters).policy)
        return NetworkPlanner(weights, graph, name, samples)

    def iterate(
        self, data: Any, state: PpoState, auxiliary_loss: AuxiliaryLoss | None = None,
        settling: Bool[Array, ""] | None = None,
    ) -> tuple[PpoState, dict[str, Array]]:  # fmt: skip
        """Collect a rollout, then update. Pure; jit it with the state donated.

        While ``settling`` the policy is fixed, a shared encoder included.

        Returns:
            The next state, and values to log: sums (``rollout/*``, see ``environment.collect``; ``loss/cost/*`` with
            counts) and means (other ``loss/*``).
        """
        actor, key = partial(self.sample_action, state), self.rollout_key(state)
        environments, rollout, totals = collect(
            self.environment, data, state.environments, actor, key, self.config.unroll,
            terms=self.config.constraints,
        )  # fmt: skip
        state = replace(state, environments=environments)
        after, losses = self.update(data, state, rollout, auxiliary_loss, settling)
        return after, {f"rollout/{name}": value for name, value in totals.items()} | losses

    def rollout_key(self, state: PpoState) -> Array:
        """Return the random key of the next rollout."""
        return jax.random.split(state.key, 3)[0]

    def sample_action(self, state: PpoState, observation: Any, key: Array) -> SampledAction:
        """Sample the policy, with log-probabilities and values as extras.

        In the environments of ``PastPolicy`` an older copy chooses the action, while raw action and extras are still
        those of the policy; :meth:`update` masks these steps.
        """
        policy, value = self.network(trained_parameters(state)).policy_and_value(observation)
        raw_action = policy.sample(key)
        extra = {"log_prob": policy.log_prob(raw_action), "value": value}
        action = policy.action(raw_action)
        if self.past is not None:
            index = self.past.environments
            past_observation = {name: group[index] for name, group in observation.items()}
            older = self.distribution(unless_first(state, state.past), past_observation)
            action = action.at[index].set(older.action(older.sample(jax.random.fold_in(key, 1))))
        return SampledAction(raw_action, action, extra)

    def transition(self, now: Environments, sampled: SampledAction, outcome: Outcome) -> Rollout:
        """Return one row of a rollout, with its observation."""
        return transition(self.environment, now, sampled, outcome, terms=self.config.constraints)

    def update(
        self, data: Any, state: PpoState, rollout: Rollout, auxiliary_loss: AuxiliaryLoss | None = None,
        settling: Bool[Array, ""] | None = None,
    ) -> tuple[PpoState, dict[str, Array]]:  # fmt: skip
        """Take the updates of one iteration on a rollout of ``unroll`` steps; ``data`` is unused.

        The state is the one that the rollout was sampled with, with the environments after it.
        """
        config, before = self.config, trained_parameters(state)
        _, update_key, key = jax.random.split(state.key, 3)
        if self.past is not None:
            rollout = replace(rollout, alive=rollout.alive.at[:, self.past.environments].set(False))
        reward, multipliers, constraint_logs = self.constraints.update(state.multipliers, rollout)
        rollout = replace(rollout, reward=reward)
        batch = self._batch(rollout, self.network(before).value(state.environments.observation))
        carry = (before, state.optimiser, jnp.zeros((), bool))
        epoch, keys = partial(self._epoch, batch, auxiliary_loss), jax.random.split(update_key, config.epochs)
        (parameters, optimiser, _), logs = jax.lax.scan(epoch, carry, keys)
        if settling is not None:
            fixed = nnx.State({**parameters.raw_mapping, "policy": before.raw_mapping["policy"]})
            parameters = jax.tree.map(partial(jnp.where, settling), fixed, parameters)
        losses = {f"loss/{name}": value.mean() for name, value in (logs | constraint_logs).items()}
        after = replace(state, optimiser=optimiser, key=key, iteration=state.iteration + 1)
        past, averaged = self._past(state, parameters), average(state, parameters, config.average)
        return replace(after, multipliers=multipliers, past=past, **averaged), losses

    def _epoch(
        self, batch: dict[str, Any], auxiliary_loss: AuxiliaryLoss | None, carry: _Carry, key: Array
    ) -> tuple[_Carry, dict[str, Array]]:
        """Shuffle a rollout, and take an update on each of its minibatches."""
        order_key, noise_key, auxiliary_key = jax.random.split(key, 3)
        shape, minibatches = batch["alive"].shape, self.config.minibatches
        devices = _dividing_devices(shape, minibatches)
        order = minibatch_order(order_key, shape, minibatches, devices)
        # Shuffled once, outside of the loop: inside, the reads would be repeated for every use of a minibatch.
        whole, divided = _split(batch)
        noise = jax.random.normal(noise_key, (*shape, self.environment.action_size))
        divided |= {"noise": shard_axis(noise, axis=1)}
        shuffled = compute_on_each_device(_read, whole, order) | _read_shares(divided, order, devices)
        keys = jax.random.split(auxiliary_key, minibatches)
        return jax.lax.scan(partial(self._update, auxiliary_loss), carry, (shuffled, keys))

    def _update(
        self, auxiliary_loss: AuxiliaryLoss | None, carry: _Carry, inputs: tuple[dict[str, Any], Array]
    ) -> tuple[_Carry, dict[str, Array]]:
        """Take an update on a minibatch, unless ``target_kl`` stops the updates of this iteration."""
        (parameters, optimiser, stops), (minibatch, key) = carry, inputs
        logs, gradient = self._gradient(parameters, minibatch, key, auxiliary_loss)
        logs["gradient_norm"] = optax.tree.norm(gradient)
        updates, next_optimiser = self.optimiser.update(gradient, optimiser, parameters)
        after = (optax.apply_updates(parameters, updates), next_optimiser)
        if self.config.target_kl is not None:
            stops |= logs["kl"] > self.config.target_kl
            after = jax.tree.map(partial(jnp.where, stops), (parameters, optimiser), after)
            logs["skipped_share"] = stops.astype(jnp.float32)
        return (*after, stops), logs

    def _past(self, state: PpoState, parameters: Any) -> Any:
        """Return the older copy after an iteration, given the new parameters; None if there is none."""
        if self.past is None:
            return None
        refresh = (state.iteration + 1) % self.past.refresh == 0
        older = unless_first(state, state.past)
        return jax.tree.map(partial(jnp.where, refresh), parameters, older)

    def _batch(self, rollout: Rollout, last_value: Array) -> dict[str, Any]:
        """Return the rollout with advantages, ``[time, environment, ...]``, given the values after it."""
        value_t = rollout.extra["value"]
        # The row after a truncated step holds its final state, so this is the value to bootstrap.
        value_tp1 = jnp.concatenate([value_t[1:], last_value[None]])
        advantage, target = generalised_advantages(
            rollout.reward, value_t, value_tp1, rollout.terminated, rollout.truncated, self.config.gamma,
            self.config.lambda_,
        )  # fmt: skip
        # As rows: XLA reads arrays with an axis of size 1 in another layout, and copies them.
        rows = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:2], -1), rollout.observation)
        return {
            "observation": rows,
            "raw_action": rollout.raw_action,
            "log_prob": rollout.extra["log_prob"],
            "advantage": advantage,
            "target": target,
            "alive": rollout.alive.astype(jnp.float32),
        }

    def _gradient(
        self, parameters: Any, minibatch: dict[str, Any], key: Array, auxiliary_loss: AuxiliaryLoss | None
    ) -> tuple[dict[str, Array], Any]:
        """Return values to log, and the gradient of the loss of a minibatch ``[chunk, sample]``."""
        whole, samples = _split(minibatch)
        normalised, variance = compute_on_each_device(_normalise, whole)
        logs, gradient = sum_gradients(self._loss, parameters, samples | normalised)
        logs["explained_variance"] = 1.0 - logs["value"] / jnp.maximum(variance, 1e-8)
        return add_auxiliary(auxiliary_loss, parameters, key, logs, gradient)

    def _loss(self, parameters: Any, samples: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        """Return the weighted sum of the samples' losses, and sums to log."""
        config, weight = self.config, samples["weight"]
        rows = samples["observation"]
        observation = {name: rows[name].reshape(-1, *shape) for name, shape in self.spec.items()}
        policy, value = self.network(parameters).policy_and_value(observation)
        log_prob, old_log_prob = policy.log_prob(samples["raw_action"]), samples["log_prob"]
        surrogate = clipped_surrogate_loss(log_prob, old_log_prob, samples["advantage"], config.clip)
        entropy = policy.entropy_estimate(samples["noise"])
        is_outside = jnp.abs(jnp.exp(log_prob - old_log_prob) - 1.0) > config.clip
        values = {
            "policy": surrogate,
            "value": (value - samples["target"]) ** 2,
            "entropy": entropy,
            "clipped_share": is_outside.astype(jnp.float32),
            "kl": old_log_prob - log_prob,
        }
        logs = {name: jnp.sum(value * weight) for name, value in values.items()}
        value_loss, entropy_bonus = config.value_coefficient * logs["value"], logs["entropy"]
        return logs["policy"] + value_loss - config.entropy_coefficient * entropy_bonus, logs


def _group_size(time: int, minibatches: int) -> int:
    """Return the smallest number of environments whose steps of a rollout can be divided equally among minibatches."""
    return minibatches // math.gcd(time, minibatches)


def _dividing_devices(shape: tuple[int, int], minibatches: int) -> int:
    """Return the number of devices that can divide each minibatch of a rollout by environments; 1 if they cannot."""
    groups = shape[1] // _group_size(shape[0], minibatches)
    chunk = chunk_size(math.prod(shape) // minibatches)
    return 1 if groups % device_count() or chunk % device_count() else device_count()


def minibatch_order(
    key: Array, shape: tuple[int, int], minibatches: int, devices: int = 1
) -> Int[Array, "minibatch chunk sample"]:
    """Draw the minibatches of an epoch: indices of a flattened rollout of the shape ``[time, environment]``.

    Every minibatch has the same number of steps of each environment, or if that is impossible, of each group of
    environments. Devices that divide the environments find an equal share of each chunk among their own. The number of
    devices does not change the minibatches, only the order of their samples.
    """
    (time, environments), members = shape, _group_size(shape[0], minibatches)
    groups, count = environments // members, time * members
    # Random bits above an index, sorted: ten times as fast on CPUs as sorting pairs like `jax.random.permutation`.
    mask = jnp.uint32(2 ** (count - 1).bit_length() - 1)
    bits = jax.random.bits(key, (groups, count)) & ~mask
    step = (jnp.sort(bits | jnp.arange(count, dtype=jnp.uint32)) & mask).astype(jnp.int32)
    environment = members * jnp.arange(groups)[:, None] + step % members
    index = environments * (step // members) + environment
    chunk = chunk_size(time * environments // minibatches)
    index = index.reshape(devices, groups // devices, minibatches, -1)
    index = jnp.moveaxis(index, 2, 0).reshape(minibatches, devices, -1, chunk // devices)
    return jnp.moveaxis(index, 1, 2).reshape(minibatches, -1, chunk)


def _read(batch: dict[str, Any], order: Int[Array, "*samples"]) -> dict[str, Any]:
    """Return the samples of a batch (leaves ``[time, environment, ...]``) at indices of its flattened leaves."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[order], batch)


def _read_shares(
    batch: dict[str, Any], order: Int[Array, "minibatch chunk sample"], devices: int
) -> dict[str, Any]:
    """Return samples as :func:`_read` does; each of several devices reads its share from its own environments."""
    if devices == 1:
        return shard_axis(_read(batch, order), axis=2)
    environments = batch["log_prob"].shape[1]

    def read(share: dict[str, Any], order: Array) -> dict[str, Any]:
        own_environments = environments // devices
        return _read(share, order // environments * own_environments + order % own_environments)

    return map_over_devices(read, batch, order, in_axes=(1, 2), out_axis=2)


def _split(minibatch: dict[str, Any]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the arrays that every device has whole, and those that devices divide."""
    whole = {name: minibatch[name] for name in _WHOLE}
    return whole, {name: value for name, value in minibatch.items() if name not in whole}


def _normalise(samples: dict[str, Array]) -> tuple[dict[str, Array], Float[Array, ""]]:
    """Return weights with sum 1, normalised advantages and targets of samples, and the variance of targets."""
    weight = samples["alive"] / jnp.maximum(jnp.sum(samples["alive"]), 1.0)

    def deviations(value: Array) -> tuple[Array, Array]:
        """Return differences from the mean of the minibatch, and the variance."""
        difference = value - jnp.sum(value * weight)
        return difference, jnp.sum(difference**2 * weight)

    advantage, variance = deviations(samples["advantage"])
    advantage = advantage / (jnp.sqrt(variance) + 1e-8)
    normalised = {"weight": weight, "advantage": advantage, "target": samples["target"]}
    return normalised, deviations(samples["target"])[1]


@dataclass(frozen=True)
class Constraints:
    """Limits of costs, and dual ascent of their Lagrange multipliers.

    A cost is a penalty of the environment without its weight; that of a failure is 1 at its step.

    Attributes:
        limits: Largest mean sum of a cost per episode.
        weights: Minus the weights of these penalties in the reward, above 0, at which the multipliers start.
        rate: Step size of the dual ascent.
    """

    limits: Mapping[str, float]
    weights: Mapping[str, float]
    rate: float

    @classmethod
    def of(cls, limits: Mapping[str, float], rate: float, environment: Environment) -> Constraints:
        """Return constraints in an environment.

        Raises:
            UsageError: A name is not that of a penalty with a constant weight in the environment's reward.
        """
        weights = getattr(environment, "penalties", {})
        for name in limits:
            if name not in weights:
                cure = did_you_mean(
                    name, weights, otherwise="give that term a weight below 0, and no condition"
                )
                problem = f"constraints: {name!r} is not a penalty with a constant weight"
                raise UsageError(problem, cure=cure)
        return cls(limits, {name: weights[name] for name in limits}, rate)

    def init(self) -> dict[str, Array]:
        """Return the initial multipliers."""
        return {name: jnp.asarray(weight, jnp.float32) for name, weight in self.weights.items()}

    def update(
        self, multipliers: Mapping[str, Array], rollout: Rollout
    ) -> tuple[Float[Array, "time batch"], dict[str, Array], dict[str, Array]]:
        """Return the rewards of a rollout with the multipliers as weights, the next multipliers, and values to log.

        ``multiplier' = max(0, multiplier + rate (cost - limit))`` with the cost per episode that ended; unchanged if
        none did.
        """
        reward, next_multipliers, logs = rollout.reward, dict[str, Array](), dict[str, Array]()
        for name, limit in self.limits.items():
            multiplier, weight = multipliers[name], self.weights[name]
            cost = jnp.where(rollout.alive, rollout.terms[name] / -weight, 0.0)
            reward = reward - (multiplier - weight) * cost
            ends = (rollout.terminated | rollout.truncated) & rollout.alive
            episodes = jnp.sum(ends).astype(jnp.float32)
            excess = jnp.sum(cost) / jnp.maximum(episodes, 1.0) - limit
            step = jnp.where(episodes > 0.0, self.rate * excess, 0.0)
            next_multipliers[name] = jnp.maximum(multiplier + step, 0.0)
            logs |= {f"multiplier/{name}": multiplier, f"cost/{name}": jnp.sum(cost)}
            logs[f"cost/{name}/n"] = episodes
        return reward, next_multipliers, logs
