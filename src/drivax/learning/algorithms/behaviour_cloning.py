"""Imitation: behaviour cloning of the logged expert, and the same as a term of other algorithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.learning.algorithms.optimisers import check_falling, clipped_adam
from drivax.learning.devices import divided
from drivax.learning.environment import Environment
from drivax.learning.experience import Experience, ExperienceConfig, moments, recorded
from drivax.learning.sampler import draw
from drivax.networks.actor_critic import NetworkConfig, Policy
from drivax.networks.distributions import REPARAMETRISED, Actions, Distribution
from drivax.planners.network_planner import NetworkPlanner
from drivax.scenario.record import record

#: From parameters and a batch of observations to action distributions.
Act = Callable[[Any, dict[str, Array]], Distribution]


@runtime_checkable
class Demonstrated(Environment, Protocol):
    """An environment whose data hold what an expert did."""

    def demonstrations(
        self, data: Any, key: Array, count: int
    ) -> tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]:
        """Random moments: observations, the expert's actions within bounds, whether it took clipping to get there."""
        ...


@dataclass(frozen=True)
class Cloning:
    """How an expert is cloned.

    Attributes:
        loss: ``mse``: squared error of the mode of the policy, in action units; ``likelihood``: minus the log-density
            of the expert's action, which also fits the spread.
        batch: Moments per update, drawn anew from the logs each time.
        updates: Updates per iteration.
        learning_rate: Of Adam, falling linearly to ``last_rate`` times itself.
        last_rate: See ``learning_rate``; 1: it stays.
        falling: Share of the run over which it falls; then it stays.
        gradient_norm: Gradients are clipped to this global norm; None: not at all.
        mask_clipped: Whether moments at which the expert did what no action does are left out.
    """

    loss: Literal["mse", "likelihood"] = "mse"
    batch: int = 256
    updates: int = 50
    learning_rate: float = 1e-3
    last_rate: float = 0.1
    falling: float = 1.0
    gradient_norm: float | None = 1.0
    mask_clipped: bool = True

    def __post_init__(self) -> None:
        if self.batch < 1 or self.updates < 1:
            raise ValueError("batch and updates are at least 1")
        check_falling(self.falling)

    def optimiser(self, updates: int) -> optax.GradientTransformation:
        """The optimiser of a run of so many updates."""
        falls = max(round(self.falling * updates), 1)
        return clipped_adam(self.learning_rate, self.gradient_norm, updates=falls, last=self.last_rate)

    def of_batch(
        self, act: Act, parameters: Any, environment: Demonstrated, data: Any, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """The loss on random moments, and what to log: it, the mean error of the mode, the share left out."""
        observation, action, clipped = divided(_moments(environment, data, key, self.batch), axis=0)
        return self.of_moments(act(parameters, observation), action, ~(clipped & self.mask_clipped))

    def of_moments(
        self, policy: Distribution, action: Float[Array, "B D"], counts: Bool[Array, " B"]
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """The loss of a policy at moments that count, where the expert did this, and what to log."""
        error = policy.mode() - action
        squared = self.loss == "mse"
        loss = jnp.mean(error**2, axis=-1) if squared else -policy.log_prob(policy.choice_of(action))
        share = 1.0 / jnp.maximum(counts.sum(dtype=jnp.float32), 1.0)
        mean = jnp.sum(loss * counts) * share
        logs = {
            "imitation": mean,
            "imitation_error": jnp.sum(jnp.mean(jnp.abs(error), axis=-1) * counts) * share,
            "left_out": 1.0 - counts.mean(dtype=jnp.float32),
        }
        return mean, logs

    def improve(
        self,
        trained: tuple[Any, Any],
        optimiser: optax.GradientTransformation,
        loss: Callable[[Any, Array], tuple[Array, dict[str, Array]]],
        key: Array,
    ) -> tuple[tuple[Any, Any], dict[str, Array]]:
        """One iteration's updates of (parameters, optimiser's state), and the means of what the loss logs."""

        def update(trained: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], dict[str, Array]]:
            return updated(trained, optimiser, lambda parameters: loss(parameters, key))

        trained, logs = jax.lax.scan(update, trained, jax.random.split(key, self.updates))
        return trained, {f"loss/{name}": value.mean() for name, value in logs.items()}


@dataclass(frozen=True)
class BcConfig(Cloning):
    """Behaviour cloning: supervised learning of the expert's actions at random moments of the logs.

    Attributes:
        network: The policy.
    """

    kind: Literal["bc"] = "bc"
    network: NetworkConfig = field(default_factory=NetworkConfig)

    @property
    def steps_per_iteration(self) -> int:
        """Moments of one iteration; each counts as a step."""
        return self.batch * self.updates

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Any:
        """The data as they are, whose moments are all alike; or their recorded steps, drawn by weight."""
        if weights is None:
            return data
        # Clipped steps have their place in what is logged, and no part in the loss.
        return ExperienceConfig(mask_clipped=False).of(environment, data, weights)

    def build(self, environment: Environment, data: Any, iterations: int) -> Bc:
        """Cloning of the expert of an environment."""
        return Bc(self, environment, data, iterations)


@record
class BcState:
    """Everything that a run needs to continue."""

    parameters: Any
    optimiser: Any
    key: Array
    iteration: Array


class Bc:
    """Behaviour cloning in one environment. Holds configuration and the network's graph."""

    def __init__(self, config: BcConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config, self.environment, self.batch = config, demonstrated(environment), config.batch
        refuse_flat(config, config.network)
        self.spec = environment.shapes(data)
        self.optimiser = config.optimiser(iterations * config.updates)
        # Only the structure is wanted: no number is drawn.
        self.graph = nnx.graphdef(nnx.eval_shape(lambda: self._network(jax.random.key(0))))

    def _network(self, key: Array) -> Policy:
        actions = Actions(self.environment.action_size, self.environment.levels)
        return Policy(self.config.network, self.spec, nnx.Rngs(key), actions)

    def init(self, data: Any, key: Array) -> BcState:
        """The state before the first iteration."""
        network_key, key = jax.random.split(key)
        parameters = nnx.state(self._network(network_key), nnx.Param)
        return BcState(parameters, self.optimiser.init(parameters), key, jnp.zeros((), jnp.int32))

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """The policy with these parameters."""
        return nnx.merge(self.graph, parameters)(observation)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """The policy as a planner."""
        return NetworkPlanner(parameters, self.graph, name, samples)

    def iterate(self, data: Any, state: BcState) -> tuple[BcState, dict[str, Array]]:
        """One iteration: so many updates, on random moments of the logs."""
        update_key, key = jax.random.split(state.key)

        def loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            return self.config.of_batch(self.distribution, parameters, self.environment, data, key)

        trained = (state.parameters, state.optimiser)
        trained, logs = self.config.improve(trained, self.optimiser, loss, update_key)
        if isinstance(data, Experience):
            logs |= data.sizes()
        return BcState(*trained, key, state.iteration + 1), logs


def updated(
    trained: tuple[Any, Any],
    optimiser: optax.GradientTransformation,
    loss: Callable[[Any], tuple[Array, dict[str, Array]]],
) -> tuple[tuple[Any, Any], dict[str, Array]]:
    """(Parameters, optimiser's state) after one update, and what the loss logs."""
    parameters, state = trained
    (_, logs), gradient = jax.value_and_grad(loss, has_aux=True)(parameters)
    logs["imitation_gradient_norm"] = optax.tree.norm(gradient)
    change, state = optimiser.update(gradient, state, parameters)
    return (optax.apply_updates(parameters, change), state), logs


def _moments(
    environment: Demonstrated, data: Any, key: Array, count: int
) -> tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]:
    """Random moments: all alike, or where experience has weights, by those."""
    if isinstance(data, Experience):
        return moments(recorded(environment), data, draw(data.policy or data.critic, key, (count,)))
    return environment.demonstrations(data, key, count)


def demonstrated(environment: Environment) -> Demonstrated:
    """The environment, if it has an expert.

    Raises:
        UsageError: It has none.
    """
    if not isinstance(environment, Demonstrated):
        raise UsageError(
            f"{type(environment).__name__} has no expert to imitate", cure="give it `demonstrations`"
        )
    return environment


def refuse_flat(cloning: Cloning, network: NetworkConfig) -> None:
    """Refuses a loss without a gradient.

    Raises:
        UsageError: The mode is a choice among levels or parts, which no squared error moves.
    """
    if cloning.loss == "mse" and network.distribution not in REPARAMETRISED:
        raise UsageError(
            f"the mode of {network.distribution!r} has no gradient for the loss 'mse'",
            cure="use loss: likelihood",
        )
