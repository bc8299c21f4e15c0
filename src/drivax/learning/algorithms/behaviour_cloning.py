"""Behaviour cloning of the logged expert, as an algorithm and as an imitation loss of other algorithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float

from drivax.checks import check_above_zero, check_at_least, check_at_most, check_counts
from drivax.errors import UsageError
from drivax.learning.algorithm import AuxiliaryLoss
from drivax.learning.algorithms.optimisers import check_decay_share, clipped_adam
from drivax.learning.environment import Environment
from drivax.learning.experience import (
    Experience,
    ExperienceConfig,
    ExpertActions,
    expert_actions,
    require_log,
    sample_steps,
)  # fmt: skip
from drivax.learning.program import sum_over_devices
from drivax.learning.recorded_episodes import RecordedEpisodes
from drivax.networks.actor_critic import NetworkConfig, Policy, graph_of
from drivax.networks.distributions import REPARAMETERISED, Actions, Distribution
from drivax.planners.functions import NetworkPlanner
from drivax.scenario.record import record

#: Maps parameters and a batch of observations to action distributions.
PolicyFunction = Callable[[Any, dict[str, Array]], Distribution]
#: Parameters and the optimiser's state.
Carry = tuple[Any, Any]


@runtime_checkable
class ExpertEnvironment(Environment, Protocol):
    """An environment whose data hold actions of an expert."""

    def demonstrations(self, data: Any, key: Array, count: int) -> ExpertActions:
        """Return the expert's actions at random steps."""
        ...


@dataclass(frozen=True)
class Cloning:
    """Settings of behaviour cloning.

    Attributes:
        loss: ``mse``: squared error of the policy's mode, in action units; ``likelihood``: negative log-likelihood of
            the expert's action, which also fits the standard deviation.
        batch: Logged steps per update.
        updates: Updates per iteration.
        learning_rate, last_rate: Initial learning rate of Adam, and the final one relative to it; 1: constant.
        decay_share: Share of the run (of pretraining, in a warm start) over which the rate decays linearly; it is
            constant afterwards.
        gradient_norm: Maximum global norm of the gradient; None: no clipping.
        mask_clipped: Leave out steps at which the expert's action is clipped to the bounds.
    """

    loss: Literal["mse", "likelihood"] = "mse"
    batch: int = 256
    updates: int = 50
    learning_rate: float = 1e-3
    last_rate: float = 0.1
    decay_share: float = 1.0
    gradient_norm: float | None = 1.0
    mask_clipped: bool = True

    #: Former key.
    renamed: ClassVar[dict[str, str]] = {"falling": "decay_share"}

    def __post_init__(self) -> None:
        check_counts(self, "batch", "updates")
        check_at_least(self, 0, "learning_rate", "last_rate")
        check_above_zero(self, "gradient_norm")
        check_decay_share(self.decay_share)

    def optimiser(self, updates: int) -> optax.GradientTransformation:
        """Return the optimiser of a run of ``updates``."""
        updates = max(round(self.decay_share * updates), 1)
        return clipped_adam(self.learning_rate, self.gradient_norm, updates=updates, last=self.last_rate)

    def batch_loss(
        self, policy: PolicyFunction, parameters: Any, environment: ExpertEnvironment, data: Any, key: Array
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Return the imitation loss on a random batch of expert actions, and values to log."""
        if isinstance(data, Experience):
            index = sample_steps(data.policy or data.critic, key, (self.batch,))
            batch = expert_actions(require_log(environment), data, index)
        else:
            batch = environment.demonstrations(data, key, self.batch)

        def sums(parameters: Any, samples: ExpertActions) -> tuple[dict[str, Array], Array]:
            observation, action, clipped = samples
            mask = ~(clipped & self.mask_clipped)
            return self._sums(policy(parameters, observation), action, mask)

        # One exchange for the whole gradient; otherwise XLA exchanges each parameter separately.
        return _mean(*sum_over_devices(sums, parameters, batch, axis=0), len(batch[1]))

    def imitation_loss(
        self, policy: Distribution, action: Float[Array, "B D"], mask: Bool[Array, " B"]
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """Return the mean loss of expert actions where ``mask`` holds, and values to log."""
        return _mean(*self._sums(policy, action, mask), len(mask))

    def _sums(
        self, policy: Distribution, action: Float[Array, "B D"], mask: Bool[Array, " B"]
    ) -> tuple[dict[str, Array], Float[Array, ""]]:
        """Return sums over the steps where ``mask`` holds: their number and values to log, and the loss."""
        error = policy.mode() - action
        is_mse = self.loss == "mse"
        loss = jnp.mean(error**2, axis=-1) if is_mse else -policy.log_prob(policy.raw_action(action))
        count, total = mask.sum(dtype=jnp.float32), jnp.sum(loss * mask)
        logs = {"count": count, "imitation_error": jnp.sum(jnp.mean(jnp.abs(error), axis=-1) * mask)}
        return logs, total

    def run_updates(
        self, carry: Carry, optimiser: optax.GradientTransformation, loss: AuxiliaryLoss, key: Array
    ) -> tuple[Carry, dict[str, Array]]:
        """Take the updates of one iteration, and return the mean of each logged value."""

        def update(carry: Carry, key: Array) -> tuple[Carry, dict[str, Array]]:
            return imitation_update(carry, optimiser, lambda parameters: loss(parameters, key))

        carry, logs = jax.lax.scan(update, carry, jax.random.split(key, self.updates))
        return carry, {f"loss/{name}": value.mean() for name, value in logs.items()}


@dataclass(frozen=True)
class BcConfig(Cloning):
    """Behaviour cloning: supervised learning of the expert's actions at random steps of the logs.

    Attributes:
        best: Share of the recorded episodes of each scenario, those with the highest return, to clone (filtered BC).
    """

    kind: Literal["bc"] = "bc"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    best: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_above_zero(self, "best")
        check_at_most(self, 1, "best")

    @property
    def steps_per_iteration(self) -> int:
        """Logged steps of one iteration; each counts as an environment step."""
        return self.batch * self.updates

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Any:
        """Return the data, to draw ``demonstrations`` from, or, with weights or recorded episodes, the experience."""
        if weights is None and not isinstance(data, RecordedEpisodes) and self.best == 1.0:
            return data
        # The loss masks clipped steps, and logs their share.
        return ExperienceConfig(mask_clipped=False, best=self.best).of(environment, data, weights)

    def build(self, environment: Environment, data: Any, iterations: int) -> Bc:
        """Return behaviour cloning in an environment."""
        return Bc(self, environment, data, iterations)


@record
class BcState:
    """State of a run."""

    parameters: Any
    optimiser: Any
    key: Array
    iteration: Array


class Bc:
    """Behaviour cloning in one environment."""

    def __init__(self, config: BcConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.config, self.environment, self.batch = config, require_expert(environment), config.batch
        check_loss(config, config.network)
        self.spec = environment.shapes(data)
        self.optimiser = config.optimiser(iterations * config.updates)
        # Traced only: no random numbers are drawn.
        self.graph = graph_of(nnx.eval_shape(lambda: self._network(jax.random.key(0))))

    def _network(self, key: Array) -> Policy:
        actions = Actions(self.environment.action_size, self.environment.levels)
        return Policy(self.config.network, self.spec, nnx.Rngs(key), actions)

    def init(self, data: Any, key: Array) -> BcState:
        """Return the initial state."""
        network_key, key = jax.random.split(key)
        parameters = nnx.state(self._network(network_key), nnx.Param)
        return BcState(parameters, self.optimiser.init(parameters), key, jnp.zeros((), jnp.int32))

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """Return the policy's action distribution."""
        return nnx.merge(self.graph, parameters)(observation)

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """Return the policy as a planner."""
        return NetworkPlanner(parameters, self.graph, name, samples)

    def iterate(self, data: Any, state: BcState) -> tuple[BcState, dict[str, Array]]:
        """Take the updates of one iteration on random steps of the logs."""
        update_key, key = jax.random.split(state.key)

        def loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            return self.config.batch_loss(self.distribution, parameters, self.environment, data, key)

        carry = (state.parameters, state.optimiser)
        carry, logs = self.config.run_updates(carry, self.optimiser, loss, update_key)
        if isinstance(data, Experience):
            logs |= data.sizes()
        return BcState(*carry, key, state.iteration + 1), logs


def _mean(sums: dict[str, Array], loss: Array, steps: int) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Return the mean loss and values to log, given sums over those of all ``steps`` steps where the mask holds."""
    share = 1.0 / jnp.maximum(sums["count"], 1.0)
    logs = {
        "imitation": loss * share,
        "imitation_error": sums["imitation_error"] * share,
        "left_out": 1.0 - sums["count"] / steps,
    }
    return logs["imitation"], logs


def imitation_update(
    carry: Carry,
    optimiser: optax.GradientTransformation,
    loss: Callable[[Any], tuple[Array, dict[str, Array]]],
) -> tuple[Carry, dict[str, Array]]:
    """Take one gradient step, and return the values that the loss logs."""
    parameters, state = carry
    (_, logs), gradient = jax.value_and_grad(loss, has_aux=True)(parameters)
    logs["imitation_gradient_norm"] = optax.tree.norm(gradient)
    updates, state = optimiser.update(gradient, state, parameters)
    return (optax.apply_updates(parameters, updates), state), logs


def require_expert(environment: Environment) -> ExpertEnvironment:
    """Return an environment with expert actions.

    Raises:
        UsageError: The environment has no expert actions.
    """
    if not isinstance(environment, ExpertEnvironment):
        problem = f"{type(environment).__name__} has no expert to imitate"
        raise UsageError(problem, cure="implement `demonstrations`")
    return environment


def check_loss(cloning: Cloning, network: NetworkConfig) -> None:
    """Raise UsageError for the loss ``mse`` of a grid or mixture policy, whose mode has no gradient in the logits."""
    if cloning.loss == "mse" and network.distribution not in REPARAMETERISED:
        problem = f"the mode of {network.distribution!r} has no gradient for the loss 'mse'"
        raise UsageError(problem, cure="use loss: likelihood")
