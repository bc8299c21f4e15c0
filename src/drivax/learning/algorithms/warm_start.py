"""Warm starts: pretraining by behaviour cloning, then reinforcement learning with a decaying imitation loss.

One learner for every online algorithm: it wraps the algorithm's learner, with a phase before it and an auxiliary loss.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import Cloning, check_loss, demonstrated
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.environment import Environment, in_any
from drivax.networks.distributions import Distribution
from drivax.planners.planner import Planner
from drivax.scenario.record import record


@runtime_checkable
class Online(Protocol):
    """A learner that can fine-tune a policy: its state has ``parameters``, ``key`` and ``iteration``."""

    def init(self, data: Any, key: Array) -> Any:
        """Return the first state."""
        ...

    def iterate(self, data: Any, state: Any, auxiliary_loss: Any = None) -> tuple[Any, dict[str, Array]]:
        """Run one iteration, with an additional loss of the policy."""
        ...

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """Return the policy's action distribution."""
        ...

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """Return the policy as a planner."""
        ...

    def with_policy(self, parameters: Any, of: Any) -> Any:
        """Return parameters with the policy ``of`` others."""
        ...


@dataclass(frozen=True)
class WarmStart:
    """Settings of pretraining, and of the imitation loss during reinforcement learning.

    Attributes:
        iterations: Iterations of behaviour cloning; each counts as many steps as one that collects rollouts.
        cloning: Settings of behaviour cloning.
        settle: Iterations after them in which the policy stays fixed while values are learned.
        weight: Weight of the imitation loss during reinforcement learning; 0: none.
        half_life: Iterations after which that weight has halved; 0: constant.
    """

    iterations: int = 50
    cloning: Cloning = field(default_factory=Cloning)
    settle: int = 0
    weight: float = 0.0
    half_life: int = 0

    def __post_init__(self) -> None:
        if min(self.iterations, self.settle, self.half_life) < 0 or self.weight < 0.0:
            raise UsageError("a setting of warm_start is negative", cure="use 0 or more")

    def remaining(self, iterations: int) -> int:
        """Return the iterations of a run after pretraining; raises UsageError if none are left."""
        if iterations <= self.iterations:
            raise UsageError(
                f"all {iterations} iterations are behaviour cloning",
                cure="raise total_steps, or lower warm_start.iterations",
            )
        return iterations - self.iterations

    def build(
        self, config: SacConfig | PpoConfig, environment: Environment, data: Any, iterations: int
    ) -> WarmStarted:
        """Return the learner of a run of ``iterations``."""
        check_loss(self.cloning, config.network)
        return WarmStarted(self, config.build(environment, data, self.remaining(iterations)), environment)

    def weight_at(self, iteration: Int[Array, ""]) -> Float[Array, ""]:
        """Return the imitation weight, given the iterations since pretraining."""
        if not self.half_life:
            return jnp.asarray(self.weight)
        return self.weight * 0.5 ** (iteration.astype(jnp.float32) / self.half_life)


@dataclass(frozen=True)
class BcSacConfig:
    """Behaviour cloning, then SAC from its policy.

    Attributes:
        warm_start: Behaviour cloning, and the imitation loss of SAC.
        sac: SAC, with the policy.
    """

    kind: Literal["bc_sac"] = "bc_sac"
    warm_start: WarmStart = field(default_factory=WarmStart)
    sac: SacConfig = field(default_factory=lambda: SacConfig(explore="policy"))

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration that collects rollouts."""
        return self.sac.steps_per_iteration

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStarted:
        """Return behaviour cloning, then SAC, in an environment."""
        return self.warm_start.build(self.sac, environment, data, iterations)


@dataclass(frozen=True)
class BcPpoConfig:
    """Behaviour cloning, then PPO from its policy.

    Attributes:
        warm_start: Behaviour cloning, and the imitation loss of PPO.
        ppo: PPO, with the policy.
    """

    kind: Literal["bc_ppo"] = "bc_ppo"
    warm_start: WarmStart = field(default_factory=WarmStart)
    ppo: PpoConfig = field(default_factory=PpoConfig)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration that collects rollouts."""
        return self.ppo.steps_per_iteration

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStarted:
        """Return behaviour cloning, then PPO, in an environment."""
        return self.warm_start.build(self.ppo, environment, data, iterations)


@record
class WarmStartState:
    """Everything that a run needs to continue.

    Attributes:
        parameters: Parameters of the learner.
        learner: The learner's state without parameters; counts its own iterations.
        optimiser: State of the optimiser of behaviour cloning.
        iteration: Finished iterations, pretraining included.
    """

    networks: ClassVar[tuple[str, ...]] = ("parameters", "learner")

    parameters: Any
    learner: Any
    optimiser: Any
    iteration: Array


class WarmStarted:
    """A learner after a phase of behaviour cloning. Holds configuration; everything computed is in the state."""

    def __init__(self, config: WarmStart, online: Online, environment: Environment) -> None:
        self.config, self.online, self.environment = config, online, demonstrated(environment)
        self.optimiser = config.cloning.optimiser(config.iterations * config.cloning.updates)
        # Jitted, so that the names of logs do not trace them a second time.
        self._phases = jax.jit(self._clone), jax.jit(self._learn)

    def init(self, data: Any, key: Array) -> WarmStartState:
        """Return the first state."""
        learner = self.online.init(data, key)
        optimiser = self.optimiser.init(learner.parameters)
        return self._state(learner, optimiser, jnp.zeros((), jnp.int32))

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """Return the policy as a planner."""
        return self.online.planner(parameters, name, samples)

    def iterate(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Run one iteration of behaviour cloning or reinforcement learning. Pure; jit it with the state donated."""
        names = [jax.eval_shape(phase, data, state)[1] for phase in self._phases]

        def complete(phase: Any) -> Callable[[], tuple[Any, dict[str, Array]]]:
            def run() -> tuple[Any, dict[str, Array]]:
                after, logs = phase(data, state)
                # Zero counts for what only the other phase logs.
                zeros = {
                    name: jnp.zeros(leaf.shape, leaf.dtype)
                    for logged in names
                    for name, leaf in logged.items()
                }
                return after, zeros | logs

            return run

        return jax.lax.cond(in_any(state.iteration < self.config.iterations), *map(complete, self._phases))

    def _clone(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Update toward the expert, without stepping environments."""
        key, update_key = jax.random.split(state.learner.key)
        carry = (state.parameters, state.optimiser)
        carry, logs = self.config.cloning.run_updates(
            carry, self.optimiser, self._imitation(data), update_key
        )
        learner = replace(state.learner, key=key)
        return WarmStartState(carry[0], learner, carry[1], state.iteration + 1), _counted(logs)

    def _learn(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Run an iteration of the learner, with the imitation loss if it has a weight."""
        weight, imitation = self.config.weight_at(state.learner.iteration), self._imitation(data)

        def auxiliary_loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            loss, logs = imitation(parameters, key)
            return weight * loss, logs

        learner = replace(state.learner, parameters=state.parameters)
        after, logs = self.online.iterate(data, learner, auxiliary_loss if self.config.weight else None)
        if self.config.settle:
            fixed = self.online.with_policy(after.parameters, state.parameters)
            settling = state.learner.iteration < self.config.settle
            parameters = jax.tree.map(partial(jnp.where, settling), fixed, after.parameters)
            after = replace(after, parameters=parameters)
        return self._state(after, state.optimiser, state.iteration + 1), _counted(logs)

    def _imitation(self, data: Any) -> Callable[[Any, Array], tuple[Array, dict[str, Array]]]:
        def loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            return self.config.cloning.batch_loss(
                self.online.distribution, parameters, self.environment, data, key
            )

        return loss

    def _state(self, learner: Any, optimiser: Any, iteration: Array) -> WarmStartState:
        without_parameters = replace(learner, parameters=())
        return WarmStartState(learner.parameters, without_parameters, optimiser, iteration)


def _counted(logs: Mapping[str, Array]) -> dict[str, Array]:
    """Add a count of 1 to values without one, so that the other phase logs nothing for them."""
    counted = dict(logs)
    for name in logs:
        if not name.startswith("rollout/") and not name.endswith("/n") and f"{name}/n" not in logs:
            counted[f"{name}/n"] = jnp.ones(())
    return counted
