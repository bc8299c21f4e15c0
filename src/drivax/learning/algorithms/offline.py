"""What offline algorithms have in common: recorded steps by weight, networks, updates, targets, and what is logged."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.learning.algorithms.fitted_q import FittedQ, FittedQConfig
from drivax.learning.algorithms.optimisers import check_falling, clipped_adam
from drivax.learning.devices import divided
from drivax.learning.environment import Environment
from drivax.learning.experience import Experience, ExperienceConfig, moments, recorded, transitions
from drivax.learning.replay import Transitions
from drivax.learning.sampler import draw
from drivax.networks.actor_critic import NetworkConfig, Policy, TwinCritic
from drivax.networks.distributions import REPARAMETRISED, Actions, Distribution
from drivax.networks.normalised import (
    NormalisedConfig,
    Statistics,
    feature_statistics,
    set_statistics,
)
from drivax.planners.network_planner import NetworkPlanner
from drivax.rl.temporal_difference import polyak
from drivax.scenario.record import record

#: Held-out steps that the mean Q is taken over, and recorded ones that features are normalised by; how many at once.
_JUDGED, _AT_ONCE = 2048, 256


@dataclass(frozen=True)
class OfflineConfig:
    """Settings of every offline algorithm.

    Attributes:
        network: Of policy, critics and value; an encoder each.
        records: Which recorded steps are learned from.
        batch: Steps per update.
        updates: Updates per iteration.
        gamma: Discount.
        tau: How far targets move toward what they follow per update.
        policy_rate, critic_rate: Learning rates of Adam; a value learns as fast as the critics.
        last_rate: Both fall linearly to so many times themselves; 1: they stay.
        falling: Share of the run over which they fall; then they stay, so that validations tell what was reached.
        gradient_norm: Gradients of each network are clipped to this global norm.
        normalise: Whether every feature of an observation is shifted and scaled by its mean and deviation over recorded
            steps, in front of every encoder.
        fitted_q: How the policy is evaluated on held-out steps, for ``checkpoint_rule: fitted_q``.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    records: ExperienceConfig = field(default_factory=ExperienceConfig)
    batch: int = 256
    updates: int = 50
    gamma: float = 0.99
    tau: float = 0.005
    policy_rate: float = 3e-4
    critic_rate: float = 3e-4
    last_rate: float = 1.0
    falling: float = 1.0
    gradient_norm: float = 10.0
    normalise: bool = False
    fitted_q: FittedQConfig = field(default_factory=FittedQConfig)

    def __post_init__(self) -> None:
        if self.batch < 1 or self.updates < 1:
            raise ValueError("batch and updates are at least 1")
        check_falling(self.falling)

    @property
    def steps_per_iteration(self) -> int:
        """Recorded steps of one iteration; each counts as a step."""
        return self.batch * self.updates

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Experience:
        """What is learned from; see :class:`ExperienceConfig`."""
        return self.records.of(environment, data, weights)

    @property
    def networks(self) -> NetworkConfig:
        """The networks, with normalisation if there is to be any."""
        network = self.network
        return (
            replace(network, encoder=NormalisedConfig(encoder=network.encoder)) if self.normalise else network
        )

    def refuse_choices(self) -> None:
        """Refuses a policy whose actions have no gradient.

        Raises:
            UsageError: The policy chooses among levels or parts.
        """
        if self.network.distribution not in REPARAMETRISED:
            raise UsageError(
                f"{type(self).__name__} needs a policy with a gradient through its actions",
                cure="use gaussian or beta; iql and bc learn all",
            )


@record
class OfflineState:
    """Everything that a run needs to continue.

    Attributes:
        parameters: The policy's.
        rest: What else is trained, by name.
        target: What follows it slowly, by name.
        optimiser: State of the optimiser.
        key: Of all draws.
        iteration: Iterations done.
    """

    networks: ClassVar[tuple[str, ...]] = ("parameters", "rest", "target")

    parameters: Any
    rest: dict[str, Any]
    target: dict[str, Any]
    optimiser: Any
    key: Array
    iteration: Array


#: Everything that gradients change, by name: networks, and single numbers.
Trained = dict[str, Any]
#: Where the policy is improved: observations, and what the expert did there.
Improved = tuple[dict[str, Array], Float[Array, "B D"]]


class Offline:
    """An offline algorithm in one environment: a subclass says what is trained and by which loss.

    Holds configuration and the networks' graphs; everything computed is in the state.
    """

    #: Names of what has a slowly following target.
    follows: ClassVar[tuple[str, ...]] = ("critic",)

    def __init__(self, config: OfflineConfig, environment: Environment, data: Any, iterations: int) -> None:
        self.settings, self.environment, self.batch = config, environment, config.batch
        self.updates = iterations * config.updates
        self.spec = environment.shapes(data)
        self.optimiser = optax.partition(self.optimisers(), {name: name for name in self.optimisers()})
        # Only the structures are wanted: no number is drawn.
        made = nnx.eval_shape(lambda: self.networks(jax.random.key(0)))
        self.graphs = {name: nnx.graphdef(network) for name, network in made.items()}

    def networks(self, key: Array) -> dict[str, nnx.Module]:
        """All networks, with fresh parameters."""
        actions = Actions(self.environment.action_size, self.environment.levels)
        policy_key, critic_key = jax.random.split(key)
        network = self.settings.networks
        return {
            "policy": Policy(network, self.spec, nnx.Rngs(policy_key), actions),
            "critic": TwinCritic(network, self.spec, nnx.Rngs(critic_key), actions),
        }

    def numbers(self) -> dict[str, float]:
        """Single numbers that are trained too, as they are at first."""
        return {}

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """What moves each of them."""
        return {
            "policy": self.adam(self.settings.policy_rate),
            "critic": self.adam(self.settings.critic_rate),
        }

    def adam(self, rate: float, every: int = 1) -> optax.GradientTransformation:
        """Adam of something that moves in every, or every so manieth, update."""
        config = self.settings
        falls = round(config.falling * self.updates) // every if config.last_rate != 1.0 else 0
        return clipped_adam(rate, config.gradient_norm, updates=falls, last=config.last_rate)

    def loss(
        self, trained: Trained, target: Mapping[str, Any], part: Transitions, improved: Improved, key: Array
    ) -> tuple[Array, dict[str, Array]]:
        """The sum of all losses, each of which reaches its own parameters only, and what to log.

        Args:
            trained: What is trained.
            target: What follows it slowly.
            part: Steps that values are learned from.
            improved: Where the policy is improved; of the same steps unless weights are for the policy alone.
            key: Of whatever is drawn.
        """
        raise NotImplementedError

    def init(self, data: Any, key: Array) -> OfflineState:
        """The state before the first iteration."""
        network_key, key = jax.random.split(key)
        networks = self.networks(network_key)
        # A policy that is loaded is given the shapes of its parameters only, without experience.
        if self.settings.normalise and isinstance(data, Experience):
            statistics = self._statistics(data)
            for network in networks.values():
                set_statistics(network, statistics)
        trained = {name: nnx.state(made, nnx.Param) for name, made in networks.items()}
        trained |= {name: jnp.asarray(number, jnp.float32) for name, number in self.numbers().items()}
        return OfflineState(
            parameters=trained["policy"],
            rest=_rest(trained),
            target={name: jax.tree.map(jnp.copy, trained[name]) for name in self.follows},
            optimiser=self.optimiser.init(trained),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def iterate(self, data: Experience, state: OfflineState) -> tuple[OfflineState, dict[str, Array]]:
        """One iteration: so many updates, each on steps drawn anew. Pure; jit it with the state donated."""
        update_key, key = jax.random.split(state.key)
        trained = {"policy": state.parameters, **state.rest}

        def update(now: tuple[Any, Any, Any], key: Array) -> tuple[tuple[Any, Any, Any], dict[str, Array]]:
            trained, target, optimiser = now
            draw_key, loss_key = jax.random.split(key)
            part, improved = self._drawn(data, draw_key)
            slope = jax.value_and_grad(self.loss, has_aux=True)
            (_, logs), gradient = slope(trained, target, part, improved, loss_key)
            for name in ("policy", "critic"):
                logs[f"{name}_gradient_norm"] = optax.tree.norm(gradient[name])
            change, optimiser = self.optimiser.update(gradient, optimiser, trained)
            trained: Any = optax.apply_updates(trained, change)
            online = {name: trained[name] for name in self.follows}
            return (trained, polyak(target, online, self.settings.tau), optimiser), logs

        first = (trained, state.target, state.optimiser)
        keys = jax.random.split(update_key, self.settings.updates)
        (trained, target, optimiser), logs = jax.lax.scan(update, first, keys)
        following = OfflineState(
            trained["policy"], _rest(trained), target, optimiser, key, state.iteration + 1
        )
        return following, {f"loss/{name}": value.mean() for name, value in logs.items()} | data.sizes()

    def _drawn(self, data: Experience, key: Array) -> tuple[Transitions, Improved]:
        """Steps to learn values from, and where to improve the policy."""
        environment, count = recorded(self.environment), (self.settings.batch,)
        critic_key, policy_key = jax.random.split(key)
        part = divided(transitions(environment, data, draw(data.critic, critic_key, count)), axis=0)
        if data.policy is None:
            return part, (part.observation, part.action)
        found = moments(environment, data, draw(data.policy, policy_key, count))
        observation, action, _ = divided(found, axis=0)
        return part, (observation, action)

    def _statistics(self, data: Experience) -> Statistics:
        """Of recorded steps, all alike, whatever their weights; the same for every seed."""
        index, step = draw(data.alike, jax.random.key(0), (_JUDGED // _AT_ONCE, _AT_ONCE))
        observe = partial(recorded(self.environment).observe_recorded, data.data)
        return feature_statistics(jax.lax.map(observe, (index, step)))

    def distribution(self, parameters: Any, observation: dict[str, Array]) -> Distribution:
        """The policy with these parameters."""
        return nnx.merge(self.graphs["policy"], parameters)(observation)

    def q(
        self, parameters: Any, observation: dict[str, Array], action: Float[Array, "*actions D"]
    ) -> Float[Array, "2 *actions"]:
        """Both critics with these parameters."""
        return nnx.merge(self.graphs["critic"], parameters)(observation, action)

    def judge(self, data: Experience, state: OfflineState) -> dict[str, float]:
        """``mean_q``: of held-out steps, what the smaller critic expects of the policy's mode.

        Always of the same steps. It compares neither algorithms nor checkpoints: overestimation raises it, too.
        ``fitted_q``, where it is configured, is what a critic that knows the policy expects from the beginnings.
        """
        found = {"mean_q": float(self._mean_q(data, state.parameters, state.rest["critic"]))}
        if self.settings.fitted_q.updates:
            found["fitted_q"] = float(self._fitted_q(data, state.parameters))
        return found

    @partial(jax.jit, static_argnums=0)
    def _mean_q(self, data: Experience, policy: Any, critic: Any) -> Float[Array, ""]:
        places = draw(data.critic, jax.random.key(0), (_JUDGED,))
        observation = recorded(self.environment).observe_recorded(data.data, places)
        action = self.distribution(policy, observation).mode()
        return jnp.mean(jnp.min(self.q(critic, observation, action), axis=0))

    @partial(jax.jit, static_argnums=0)
    def _fitted_q(self, data: Experience, policy: Any) -> Float[Array, ""]:
        config = self.settings
        judge = FittedQ(config.fitted_q, config.networks, recorded(self.environment), config.gamma)
        statistics = self._statistics(data) if config.normalise else {}
        return judge.value(
            data, lambda observation: self.distribution(policy, observation).mode(), statistics
        )

    def planner(self, parameters: Any, name: str, samples: bool) -> NetworkPlanner:
        """The policy as a planner."""
        return NetworkPlanner(parameters, self.graphs["policy"], name, samples)


def _rest(trained: Trained) -> Trained:
    return {name: part for name, part in trained.items() if name != "policy"}


def by_key(sample: Callable[[Array], Array], key: Array, count: int) -> Array:
    """So many samples, in a leading axis."""
    return jax.vmap(sample)(jax.random.split(key, count))
