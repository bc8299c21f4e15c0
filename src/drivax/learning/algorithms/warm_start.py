"""Warm starts: clone the expert first, then learn on from that policy by reward, with imitation fading out.

One learner for every algorithm that learns on: it is given the algorithm's own learner, and adds a phase before it and
a loss beside its policy's.
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
from drivax.learning.algorithms.behaviour_cloning import Cloning, demonstrated, refuse_flat
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.branches import in_any
from drivax.learning.environment import Environment
from drivax.networks.distributions import Distribution
from drivax.planners.planner import Planner
from drivax.scenario.record import record


@runtime_checkable
class Online(Protocol):
    """A learner that can learn on from a policy: its state has ``parameters``, ``key`` and ``iteration``."""

    def init(self, data: Any, key: Array) -> Any:
        """The state before the first iteration."""
        ...

    def iterate(self, data: Any, state: Any, also: Any = None) -> tuple[Any, dict[str, Array]]:
        """One iteration, with a further loss of the policy."""
        ...

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """The policy with these parameters."""
        ...

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """The policy as a planner."""
        ...

    def with_policy(self, parameters: Any, of: Any) -> Any:
        """Parameters whose policy is that ``of`` other ones."""
        ...


@dataclass(frozen=True)
class WarmStart:
    """What comes before learning by reward, and beside it.

    Attributes:
        iterations: Iterations that only clone; each counts as many steps as one that drives.
        cloning: How the expert is cloned.
        settle: Iterations after them in which the policy stays the clone, so that values are not made up any more when
            it begins to follow them.
        weight: Of the imitation loss beside the policy's own, once it learns by reward; 0 leaves it out.
        half_life: Iterations after which that weight has halved; 0: it stays.
    """

    iterations: int = 50
    cloning: Cloning = field(default_factory=Cloning)
    settle: int = 0
    weight: float = 0.0
    half_life: int = 0

    def __post_init__(self) -> None:
        if min(self.iterations, self.settle, self.half_life) < 0 or self.weight < 0.0:
            raise UsageError("a warm start has negative settings", cure="use 0 or more")

    def rest(self, iterations: int) -> int:
        """How many iterations of a run are left to learn by reward.

        Raises:
            UsageError: There is none.
        """
        if iterations <= self.iterations:
            raise UsageError(
                f"all {iterations} iterations clone", cure="raise total_steps, or lower warm_start.iterations"
            )
        return iterations - self.iterations

    def before(
        self, config: SacConfig | PpoConfig, environment: Environment, data: Any, iterations: int
    ) -> WarmStarted:
        """The learner of a run of so many iterations."""
        refuse_flat(self.cloning, config.network)
        return WarmStarted(self, config.build(environment, data, self.rest(iterations)), environment)

    def weight_at(self, iteration: Int[Array, ""]) -> Float[Array, ""]:
        """The weight so many iterations after cloning."""
        if not self.half_life:
            return jnp.asarray(self.weight)
        return self.weight * 0.5 ** (iteration.astype(jnp.float32) / self.half_life)


@dataclass(frozen=True)
class BcSacConfig:
    """Behaviour cloning, then SAC from the clone.

    Attributes:
        warm_start: Cloning before, and imitation beside.
        sac: SAC, with the policy.
    """

    kind: Literal["bc_sac"] = "bc_sac"
    warm_start: WarmStart = field(default_factory=WarmStart)
    sac: SacConfig = field(default_factory=lambda: SacConfig(explore="policy"))

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration that drives."""
        return self.sac.steps_per_iteration

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStarted:
        """Cloning, then SAC."""
        return self.warm_start.before(self.sac, environment, data, iterations)


@dataclass(frozen=True)
class BcPpoConfig:
    """Behaviour cloning, then PPO from the clone.

    Attributes:
        warm_start: Cloning before, and imitation beside.
        ppo: PPO, with the policy.
    """

    kind: Literal["bc_ppo"] = "bc_ppo"
    warm_start: WarmStart = field(default_factory=WarmStart)
    ppo: PpoConfig = field(default_factory=PpoConfig)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration that drives."""
        return self.ppo.steps_per_iteration

    def build(self, environment: Environment, data: Any, iterations: int) -> WarmStarted:
        """Cloning, then PPO."""
        return self.warm_start.before(self.ppo, environment, data, iterations)


@record
class WarmStartState:
    """Everything that a run needs to continue.

    Attributes:
        parameters: The policy's, and what belongs to it in the learner's state.
        learner: The learner's state, which counts its own iterations, but for its parameters.
        optimiser: Of cloning.
        iteration: Iterations done, cloning included.
    """

    networks: ClassVar[tuple[str, ...]] = ("parameters", "learner")

    parameters: Any
    learner: Any
    optimiser: Any
    iteration: Array


class WarmStarted:
    """A learner behind a phase of cloning. Holds configuration; everything computed is in the state."""

    def __init__(self, config: WarmStart, online: Online, environment: Environment) -> None:
        self.config, self.online, self.environment = config, online, demonstrated(environment)
        self.optimiser = config.cloning.optimiser(config.iterations * config.cloning.updates)
        # Jitted, so that asking for the names of what is logged traces nothing a second time.
        self._phases = jax.jit(self._clone), jax.jit(self._learn)

    def init(self, data: Any, key: Array) -> WarmStartState:
        """The state before the first iteration."""
        learner = self.online.init(data, key)
        optimiser = self.optimiser.init(learner.parameters)
        return self._apart(learner, optimiser, jnp.zeros((), jnp.int32))

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """The policy as a planner."""
        return self.online.planner(parameters, name, samples)

    def iterate(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """One iteration of cloning, or of learning by reward. Pure; jit it with the state donated."""
        names = [jax.eval_shape(phase, data, state)[1] for phase in self._phases]

        def complete(phase: Any) -> Callable[[], tuple[Any, dict[str, Array]]]:
            def run() -> tuple[Any, dict[str, Array]]:
                after, logs = phase(data, state)
                # What only the other phase logs was measured no time in this one.
                other = {
                    name: jnp.zeros(leaf.shape, leaf.dtype) for part in names for name, leaf in part.items()
                }
                return after, other | logs

            return run

        return jax.lax.cond(in_any(state.iteration < self.config.iterations), *map(complete, self._phases))

    def _clone(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """Updates toward the expert; environments stand still."""
        key, update_key = jax.random.split(state.learner.key)
        trained = (state.parameters, state.optimiser)
        trained, logs = self.config.cloning.improve(
            trained, self.optimiser, self._imitation(data), update_key
        )
        learner = replace(state.learner, key=key)
        return WarmStartState(trained[0], learner, trained[1], state.iteration + 1), _counted(logs)

    def _learn(self, data: Any, state: WarmStartState) -> tuple[WarmStartState, dict[str, Array]]:
        """An iteration of the learner, with the imitation's loss while that has a weight."""
        weight, imitation = self.config.weight_at(state.learner.iteration), self._imitation(data)

        def also(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            loss, logs = imitation(parameters, key)
            return weight * loss, logs

        learner = replace(state.learner, parameters=state.parameters)
        after, logs = self.online.iterate(data, learner, also if self.config.weight else None)
        if self.config.settle:
            clone = self.online.with_policy(after.parameters, state.parameters)
            settling = state.learner.iteration < self.config.settle
            parameters = jax.tree.map(partial(jnp.where, settling), clone, after.parameters)
            after = replace(after, parameters=parameters)
        return self._apart(after, state.optimiser, state.iteration + 1), _counted(logs)

    def _imitation(self, data: Any) -> Callable[[Any, Array], tuple[Array, dict[str, Array]]]:
        def loss(parameters: Any, key: Array) -> tuple[Array, dict[str, Array]]:
            return self.config.cloning.of_batch(
                self.online.distribution, parameters, self.environment, data, key
            )

        return loss

    def _apart(self, learner: Any, optimiser: Any, iteration: Array) -> WarmStartState:
        rest = replace(learner, parameters=())
        return WarmStartState(learner.parameters, rest, optimiser, iteration)


def _counted(logs: Mapping[str, Array]) -> dict[str, Array]:
    """Numbers of a phase as sums over one, so that another phase logs none."""
    counted = dict(logs)
    for name in logs:
        if not name.startswith("rollout/") and not name.endswith("/n") and f"{name}/n" not in logs:
            counted[f"{name}/n"] = jnp.ones(())
    return counted
