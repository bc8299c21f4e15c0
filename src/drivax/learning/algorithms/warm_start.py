"""Warm starts: pretraining by behaviour cloning, then reinforcement learning with a decaying imitation loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from drivax.checks import check_at_least
from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import Cloning, check_loss, require_expert
from drivax.learning.algorithms.ppo import Ppo, PpoConfig
from drivax.learning.algorithms.sac import Sac, SacConfig
from drivax.learning.environment import Environment, any_across_learners
from drivax.learning.experience import Experience
from drivax.planners.planner import Planner
from drivax.scenario.record import record


@dataclass(frozen=True)
class WarmStart:
    """Settings of pretraining, and of the imitation loss during reinforcement learning.

    Attributes:
        iterations: Iterations of behaviour cloning; each counts for as many steps as one that collects rollouts.
        cloning: Settings of behaviour cloning.
        settle: Iterations after pretraining in which only values or critics are learned, SAC's warm-up included.
        weight: Weight of the imitation loss during reinforcement learning; 0: none.
        half_life: Iterations in which that weight halves; 0: constant.
    """

    iterations: int = 50
    cloning: Cloning = field(default_factory=Cloning)
    settle: int = 0
    weight: float = 0.0
    half_life: int = 0

    def __post_init__(self) -> None:
        check_at_least(self, 0, "iterations", "settle", "weight", "half_life")

    def online_iterations(self, iterations: int) -> int:
        """Return the iterations of a run after pretraining.

        Raises:
            UsageError: Pretraining leaves none.
        """
        if iterations <= self.iterations:
            cure = "raise total_steps, or lower warm_start.iterations"
            raise UsageError(f"all {iterations} iterations are behaviour cloning", cure=cure)
        return iterations - self.iterations

    def build(
        self, config: SacConfig | PpoConfig, environment: Environment, data: Any, iterations: int
    ) -> WarmStartLearner:
        """Return the learner of a run of ``iterations``."""
        check_loss(self.cloning, config.network)
        return WarmStartLearner(
            self, config.build(environment, data, self.online_iterations(iterations)), environment
        )

    def weight_at(self, iteration: Int[Array, ""]) -> Float[Array, ""]:
        """Return the imitation weight, given the iterations since pretraining."""
        if not self.half_life:
            return jnp.asarray(self.weight)
        return self.weight * 0.5 ** (iteration.astype(jnp.float32) / self.half_life)


@dataclass(frozen=True)
class BcSacConfig:
    """Behaviour cloning, then SAC from its policy."""

    kind: Literal["bc_sac"] = "bc_sac"
    warm_start: WarmStart = field(default_factory=WarmStart)
    sac: SacConfig = field(default_factory=lambda: SacConfig(explore="policy"))

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.sac.steps_per_iteration

    def experience(
        self, environment: Environment, data: Any, weights: np.ndarray | None
    ) -> Experience | None:
        """Return the logged steps to learn from if SAC uses ``demonstrations``."""
        return self.sac.experience(environment, data, weights)

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStartLearner:
        """Return behaviour cloning, then SAC, in an environment."""
        return self.warm_start.build(self.sac, environment, data, iterations)


@dataclass(frozen=True)
class BcPpoConfig:
    """Behaviour cloning, then PPO from its policy."""

    kind: Literal["bc_ppo"] = "bc_ppo"
    warm_start: WarmStart = field(default_factory=WarmStart)
    ppo: PpoConfig = field(default_factory=PpoConfig)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.ppo.steps_per_iteration

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStartLearner:
        """Return behaviour cloning, then PPO, in an environment."""
        return self.warm_start.build(self.ppo, environment, data, iterations)


@record
class WarmStartState:
    """Parameters, the learner's state without these, the optimiser of behaviour cloning, and finished iterations."""

    networks: ClassVar[tuple[str, ...]] = ("parameters", "learner")

    parameters: Any
    learner: Any
    optimiser: Any
    iteration: Array


class WarmStartLearner:
    """Behaviour cloning, then a learner that continues from its policy."""

    def __init__(self, config: WarmStart, online: Ppo | Sac, environment: Environment) -> None:
        self.config, self.online, self.environment = config, online, require_expert(environment)
        self.optimiser = config.cloning.optimiser(config.iterations * config.cloning.updates)
        # Jitted, so that finding the names of their logs does not trace them a second time.
        self._phases = jax.jit(self._clone), jax.jit(self._learn)

    def init(self, data: Any, key: Array) -> WarmStartState:
        """Return the initial state."""
        learner = self.online.init(data, key)
        optimiser = self.optimiser.init(learner.parameters)
        return self._state(learner, optimiser, jnp.zeros((), jnp.int32))

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """Return the policy as a planner."""
        return self.online.planner(parameters, name, samples)

    def iterate(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Run one iteration of behaviour cloning or reinforcement learning. Pure; jit it with the state donated."""
        shapes = [jax.eval_shape(phase, data, state)[1] for phase in self._phases]

        def run(phase: Any) -> tuple[Any, dict[str, Array]]:
            after, logs = phase(data, state)
            # Zero counts for what only the other phase logs.
            leaves = {name: leaf for log_shapes in shapes for name, leaf in log_shapes.items()}
            return after, {name: jnp.zeros(leaf.shape, leaf.dtype) for name, leaf in leaves.items()} | logs

        is_cloning = any_across_learners(state.iteration < self.config.iterations)
        return jax.lax.cond(is_cloning, *(partial(run, phase) for phase in self._phases))

    def _clone(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Run an iteration of behaviour cloning, which does not step environments."""
        key, update_key = jax.random.split(state.learner.key)
        carry, cloning = (state.parameters, state.optimiser), self.config.cloning
        carry, logs = cloning.run_updates(carry, self.optimiser, partial(self._imitation, data), update_key)
        learner = replace(state.learner, key=key)
        return WarmStartState(carry[0], learner, carry[1], state.iteration + 1), _with_counts(logs)

    def _learn(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Run an iteration of the learner, with the imitation loss if it has a weight."""
        weight = self.config.weight_at(state.learner.iteration)

        def auxiliary_loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            loss, logs = self._imitation(data, parameters, key)
            return weight * loss, logs

        learner, config = replace(state.learner, parameters=state.parameters), self.config
        settling = state.learner.iteration < config.settle if config.settle else None
        after, logs = self.online.iterate(data, learner, auxiliary_loss if config.weight else None, settling)
        return self._state(after, state.optimiser, state.iteration + 1), _with_counts(logs)

    def _imitation(self, data: Any, parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
        policy, cloning = self.online.distribution, self.config.cloning
        return cloning.batch_loss(policy, parameters, self.environment, data, key)

    def _state(self, learner: Any, optimiser: Any, iteration: Array) -> WarmStartState:
        return WarmStartState(learner.parameters, replace(learner, parameters=()), optimiser, iteration)


def _with_counts(logs: Mapping[str, Array]) -> dict[str, Array]:
    """Add a count of 1 to values without one, so that the other phase logs nothing for them."""
    means = [name for name in logs if not name.startswith("rollout/") and not name.endswith("/n")]
    return {**logs, **{f"{name}/n": jnp.ones(()) for name in means if f"{name}/n" not in logs}}
