"""Base of offline algorithms: weighted logged steps, normalisation, updates, and health of critics.

With Q values that diverge or only fit the data, training still yields a policy, but in effect one that imitates. Each
validation in :class:`~drivax.learning.driving.Driving` compares the critics with simulated returns of the current
policy, and with returns of held-out episodes; at its end, the run reports what is wrong (:func:`critic_problems`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float, Int

from drivax.checks import MOST_RETURN_STEPS, check_above_zero, check_at_least, check_counts, check_shares
from drivax.errors import UsageError
from drivax.learning.algorithms.off_policy import (
    Carry,
    OffPolicy,
    Trained,
    reduce_over_updates,
)
from drivax.learning.algorithms.off_policy_evaluation import FittedQ, FittedQConfig
from drivax.learning.algorithms.optimisers import check_decay_share, clipped_adam, mean_gradients
from drivax.learning.driving import BATCH, Driving
from drivax.learning.environment import Environment
from drivax.learning.experience import (
    Experience,
    ExperienceConfig,
    ExpertSteps,
    expert_actions,
    require_log,
    sample_steps,
    transitions,
)
from drivax.learning.program import map_over_devices
from drivax.learning.recorded_episodes import RecordedEpisodes
from drivax.learning.replay import Transitions
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.distributions import REPARAMETERISED
from drivax.networks.encoders import (
    NormalisedConfig,
    Statistics,
    feature_statistics,
    group_names,
    set_statistics,
)
from drivax.reading import explain_damage, read_json
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.stats.ranking import rank_correlation
from drivax.tasks.features import Features, feature_names

#: Steps that the mean Q and feature statistics are computed over, and steps per batch.
_SAMPLES, _BATCH = 2048, 256
#: Largest root mean square error of Q, in standard deviations of the simulated returns.
MOST_Q_ERROR = 0.5
#: Least rank correlation (Spearman) of Q with the returns of held-out episodes.
LEAST_Q_RANK = 0.5
#: Largest mean TD error of the last quarter of a run relative to the quarter before it.
MOST_TD_RISE = 1.05
#: Least share of episodes that end in a failure: with fewer, nothing tells critics what failures cost.
LEAST_FAILURES = 0.05
#: Largest distance of the entropy from its target over the last quarter of a run, nats.
MOST_ENTROPY_ERROR = 0.5

Observation = dict[str, Array]


@dataclass(frozen=True)
class OfflineConfig:
    """Settings of every offline algorithm.

    Attributes:
        network: Architecture of policy, critics and value.
        records: Logged steps to learn from.
        batch: Steps per update.
        updates: Updates per iteration.
        gamma: Discount.
        steps: Length of n-step returns, in decisions (Sutton 1988). They are returns of the logged actions, even where
            the policy would act differently.
        min_q_weight: Weight of the smaller of the two critics' values; the larger has the remaining weight (Fujimoto et
            al. 2019, arXiv 1812.02900, eq. 13). It applies to targets, advantages and validation. 1 is clipped double
            Q-learning; 0.5, the mean, underestimates less where actions are many and short.
        tau: Polyak averaging rate of target networks.
        policy_rate, critic_rate: Initial learning rates of Adam; a value network uses that of the critics.
        last_rate: Final learning rates relative to the initial ones; 1: constant.
        decay_share: Share of the run over which the rates decay linearly; they are constant afterwards.
        gradient_norm: Maximum global norm of each network's gradient.
        normalise: Normalise every feature of an observation by its mean and standard deviation: over logged steps
            (true), or as in a file that ``drivax inspect --observations --json`` wrote (its path; to resume, it must
            still be there).
        fitted_q: Fitted-Q evaluation on held-out steps, for ``checkpoint_rule: fitted_q``.
        needs_failures: Let critics guide the policy only if enough of their episodes end in a failure
            (:data:`LEAST_FAILURES`); otherwise the policy only imitates.
    """

    network: NetworkConfig = field(default_factory=NetworkConfig)
    records: ExperienceConfig = field(default_factory=ExperienceConfig)
    batch: int = 256
    updates: int = 50
    gamma: float = 0.99
    steps: int = 1
    min_q_weight: float = 1.0
    tau: float = 0.005
    policy_rate: float = 3e-4
    critic_rate: float = 3e-4
    last_rate: float = 1.0
    decay_share: float = 1.0
    gradient_norm: float = 10.0
    normalise: bool | str = False
    fitted_q: FittedQConfig = field(default_factory=FittedQConfig)
    needs_failures: bool = False

    #: Former key.
    renamed: ClassVar[dict[str, str]] = {"falling": "decay_share"}

    def __post_init__(self) -> None:
        check_counts(self, "batch", "updates")
        check_counts(self, "steps", most=MOST_RETURN_STEPS)
        check_at_least(self, 0, "policy_rate", "critic_rate", "last_rate")
        check_shares(self, "gamma", "tau", "min_q_weight")
        check_above_zero(self, "gradient_norm")
        check_decay_share(self.decay_share)

    @property
    def steps_per_iteration(self) -> int:
        """Logged steps of one iteration; each counts as an environment step."""
        return self.batch * self.updates

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Experience:
        """Return the experience to learn from; see :class:`ExperienceConfig`."""
        return self.records.of(environment, data, weights)

    @property
    def networks(self) -> NetworkConfig:
        """Configuration of the networks, with normalisation if configured."""
        if not self.normalise:
            return self.network
        return replace(self.network, encoder=NormalisedConfig(self.network.encoder))

    def check_gradient(self) -> None:
        """Raise UsageError for a grid or mixture policy, whose actions have no gradient in the logits."""
        if self.network.distribution not in REPARAMETERISED:
            problem = f"{type(self).__name__} needs a policy with a gradient through its actions"
            raise UsageError(problem, cure="use gaussian or beta, or iql or bc with loss: likelihood")


@record
class OfflineState:
    """State of a run; ``rest`` holds all that is trained in addition to the policy, by name."""

    networks: ClassVar[tuple[str, ...]] = ("parameters", "rest", "target")

    parameters: Any
    rest: dict[str, Any]
    target: dict[str, Any]
    optimiser: Any
    key: Array
    iteration: Array


Config = TypeVar("Config", bound=OfflineConfig)


class PolicyBatch(NamedTuple):
    """Steps for policy improvement.

    Attributes:
        observation: Their observations.
        action: The expert's actions.
        guidance: Factor of what the policy learns from critics, 0 if it only imitates.
    """

    observation: dict[str, Array]
    action: Float[Array, "B D"]
    guidance: Float[Array, " B"] | float = 1.0


class Offline(OffPolicy[Config]):
    """An offline algorithm in one environment.

    :meth:`loss` takes the steps for policy evaluation, those for policy improvement (the same unless weights are for
    the policy alone), and a key for each step. It is a mean over steps, which devices divide equally.
    """

    def __init__(self, config: Config, environment: Environment, data: Any, iterations: int) -> None:
        super().__init__(config, environment, data)
        self.batch = config.batch
        self.updates = iterations * config.updates
        self.optimiser = optax.partition(self.optimisers(), {name: name for name in self.optimisers()})

    @property
    def network(self) -> NetworkConfig:
        """Configuration of all networks."""
        return self.config.networks

    def scalars(self) -> dict[str, float]:
        """Return the initial values of trainable scalars."""
        return {}

    def optimisers(self) -> dict[Hashable, optax.GradientTransformation]:
        """Return the optimiser of each network and scalar."""
        return {"policy": self.adam(self.config.policy_rate), "critic": self.adam(self.config.critic_rate)}

    def adam(self, rate: float, every: int = 1) -> optax.GradientTransformation:
        """Return Adam for a network that only every n-th update changes (``every``)."""
        config = self.config
        updates = max(round(config.decay_share * self.updates) // every, 1) if config.last_rate != 1.0 else 0
        return clipped_adam(rate, config.gradient_norm, updates=updates, last=config.last_rate)

    def init(self, data: Any, key: Array) -> OfflineState:
        """Return the initial state."""
        network_key, key = jax.random.split(key)
        networks = self.networks(network_key)
        # Loading a policy only needs shapes of its parameters, and has no experience.
        if self.config.normalise and isinstance(data, Experience):
            statistics = self._statistics(data)
            for network in networks.values():
                set_statistics(network, statistics)
        trained = {name: nnx.state(network, nnx.Param) for name, network in networks.items()}
        trained |= {name: jnp.asarray(value, jnp.float32) for name, value in self.scalars().items()}
        return OfflineState(
            parameters=trained["policy"],
            rest=_without_policy(trained),
            target={name: jax.tree.map(jnp.copy, trained[name]) for name in self.targets},
            optimiser=self.optimiser.init(trained),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def iterate(self, data: Experience, state: OfflineState) -> tuple[OfflineState, dict[str, Array]]:
        """Take the updates of one iteration, each on newly drawn steps. Pure; jit it with the state donated."""
        update_key, key = jax.random.split(state.key)

        def update(carry: Carry, key: Array) -> tuple[Carry, dict[str, Array]]:
            draw_key, loss_key = jax.random.split(key)
            loss_keys = jax.random.split(loss_key, self.config.batch)
            return self.update_networks(carry, *self._draw(data, draw_key), loss_keys)

        initial = ({"policy": state.parameters, **state.rest}, state.target, state.optimiser)
        keys = jax.random.split(update_key, self.config.updates)
        (trained, target, optimiser), logs = jax.lax.scan(update, initial, keys)
        after = OfflineState(
            trained["policy"], _without_policy(trained), target, optimiser, key, state.iteration + 1
        )
        return after, reduce_over_updates(logs) | data.sizes()

    def gradient(
        self, trained: Trained, target: dict[str, Any], *batch: Any
    ) -> tuple[dict[str, Array], Trained]:
        """Return values to log, and the gradient of :meth:`loss`; ``batch`` is a result of :meth:`_draw`, and keys."""

        def loss(trained: Trained, samples: Any) -> tuple[Array, dict[str, Array]]:
            transitions, policy_steps, guidance, keys = samples
            observation, action = policy_steps or (transitions.observation, transitions.action)
            policy_batch = PolicyBatch(observation, action, 1.0 if guidance is None else guidance)
            return self.loss(trained, target, transitions, policy_batch, keys)

        # In a single chunk, because losses may be scaled by a mean over the batch.
        return mean_gradients(loss, trained, jax.tree.map(lambda leaf: leaf[None], batch))

    def _draw(
        self, data: Experience, key: Array
    ) -> tuple[Transitions, tuple[dict[str, Array], Array] | None, Array | None]:
        """Draw the steps for policy evaluation, and those for policy improvement (None: the same); and the guidance."""
        environment, count = require_log(self.environment), (self.config.batch,)
        is_guided = (data.failures >= LEAST_FAILURES).astype(jnp.float32)
        guidance = jnp.broadcast_to(is_guided, count) if self.config.needs_failures else None
        critic_key, policy_key = jax.random.split(key)
        index = sample_steps(data.critic, critic_key, count)
        observe = partial(transitions, environment, gamma=self.config.gamma, steps=self.config.steps)
        batch = map_over_devices(observe, data, index)
        if data.policy is None:
            return batch, None, guidance
        index = sample_steps(data.policy, policy_key, count)
        observation, action, _ = map_over_devices(partial(expert_actions, environment), data, index)
        return batch, (observation, action), guidance

    def _statistics(self, data: Experience) -> Statistics:
        """Return the feature statistics of the configured file, or over drawn steps, the same for every seed."""
        if isinstance(self.config.normalise, str):
            environment = self.environment
            features = (
                environment.task.observation.features if isinstance(environment, Driving) else Features()
            )
            names = feature_names(features, self.spec)
            return read_statistics(
                Path(self.config.normalise), {name: names[name] for name in group_names(self.spec)}
            )
        index = sample_steps(data.uniform, jax.random.key(0), (_SAMPLES // _BATCH, _BATCH))
        observe = partial(require_log(self.environment).observe_recorded, data.data)
        return feature_statistics(jax.lax.map(observe, index))

    def held_out_metrics(self, data: Experience, state: OfflineState) -> dict[str, float]:
        """Return metrics of the critics on held-out data.

        ``mean_q`` is the value of the policy's mode over a fixed set of steps; overestimation raises it. ``fitted_q``,
        if configured, is the return that :class:`FittedQ` estimates. In driving with decisions of one step, ``q_error``
        is the root mean square error of Q from simulated returns of the policy, in standard deviations of these, and
        ``q_rank`` the rank correlation of Q with returns of the held-out episodes.
        """
        policy, critic = state.parameters, state.rest["critic"]
        mean_q, q_and_returns = self._held_out_values(data, policy, critic)
        metrics = {"mean_q": float(mean_q)}
        if self.config.fitted_q.updates:
            metrics["fitted_q"] = float(self._fitted_q(data, policy))
        environment = self.environment
        if isinstance(environment, Driving) and environment.task.hold == 1:
            q, returns = np.asarray(self._policy_returns(data, policy, critic))
            if returns.std() > 0.0:  # more than one scenario
                metrics["q_error"] = float(np.sqrt(np.mean((q - returns) ** 2)) / returns.std())
            metrics["q_rank"] = rank_correlation(*np.asarray(q_and_returns))
        return metrics

    def critic_problems(self, rows: Sequence[Mapping[str, float]]) -> list[str] | None:
        """Return the problems of the critics of a finished run, given the rows of its log; None if not checked."""
        return critic_problems(rows, getattr(self, "target_entropy", None), self.config.needs_failures)

    def q_value(
        self, critic: Any, observation: dict[str, Array], action: Float[Array, "*actions D"]
    ) -> Float[Array, "*actions"]:
        """Return the combined value of both critics (:meth:`combine`)."""
        return self.combine(self.q_values(critic, observation, action))

    def combine(self, q: Float[Array, "2 *actions"]) -> Float[Array, "*actions"]:
        """Combine the values of both critics by the setting ``min_q_weight``."""
        smaller, weight = jnp.min(q, axis=0), self.config.min_q_weight
        return smaller if weight == 1.0 else weight * smaller + (1.0 - weight) * jnp.max(q, axis=0)

    def _policy_value(self, policy: Any, critic: Any, observation: dict[str, Array]) -> Float[Array, " B"]:
        """Return the value of the policy's mode."""
        return self.q_value(critic, observation, self.distribution(policy, observation).mode())

    @partial(jax.jit, static_argnums=0)
    def _policy_returns(self, data: Experience, policy: Any, critic: Any) -> Float[Array, "2 N"]:
        """Return Q of the first states of all scenarios, and the simulated returns of the policy from there."""
        bank = data.data.bank if isinstance(data.data, RecordedEpisodes) else data.data
        returns, discount, first, final = policy_returns(
            cast(Driving, self.environment),
            bank,
            lambda o: self.distribution(policy, o).mode(),
            self.config.gamma,
        )
        value = partial(self._policy_value, policy, critic)
        return jnp.stack([value(first), returns + discount * value(final)])

    @partial(jax.jit, static_argnums=0)
    def _held_out_values(
        self, data: Experience, policy: Any, critic: Any
    ) -> tuple[Float[Array, ""], Float[Array, "2 B"]]:
        """Return the mean Q of the policy, and Q and returns to go of logged actions, over fixed sets of steps."""
        environment, expert = require_log(self.environment), data.expert
        rows, last = jnp.arange(len(expert.usable)), expert.usable.shape[1] - 1
        final = jnp.minimum(last - jnp.argmax(expert.usable[:, ::-1], axis=1) + 1, last)
        key = jax.random.key(0)
        drawn, uniform = (sample_steps(sampler, key, (_SAMPLES,)) for sampler in (data.critic, data.uniform))
        # In one call, because tracing an observation takes long.
        index = jax.tree.map(lambda *sets: jnp.concatenate(sets), drawn, uniform, (rows, final))
        observation = environment.observe_recorded(data.data, index)
        value = self._policy_value(policy, critic, observation)
        logged = jax.tree.map(lambda leaf: leaf[_SAMPLES : 2 * _SAMPLES], observation)
        q = self.q_value(critic, logged, expert.action[uniform])
        returns = returns_to_go(expert, value[2 * _SAMPLES :], self.config.gamma)
        return value[:_SAMPLES].mean(), jnp.stack([q, returns[uniform]])

    @partial(jax.jit, static_argnums=0)
    def _fitted_q(self, data: Experience, policy: Any) -> Float[Array, ""]:
        config = self.config
        evaluation = FittedQ(config.fitted_q, config.networks, require_log(self.environment), config.gamma)
        statistics = self._statistics(data) if config.normalise else {}
        return evaluation.value(
            data, lambda observation: self.distribution(policy, observation).mode(), statistics
        )


def read_statistics(file: Path, names: Mapping[str, Sequence[str]]) -> Statistics:
    """Read statistics of features from the JSON of ``drivax inspect --observations``.

    ``names`` are those of the features of each group, in order. A feature without values has the mean 0 and the
    deviation 1.

    Raises:
        DataError: The file is missing or damaged, or describes another observation.
    """
    cure = "write it with `drivax inspect SET --observations --json`, for the task of the training"
    content = read_json(file, cure)
    statistics: dict[str, tuple[Array, Array]] = {}
    with explain_damage(file, cure, "no statistics of observations"):
        rows = [(str(row["group"]), str(row["name"]), row["mean"], row["std"]) for row in content["features"]]
        for group, expected in names.items():
            group_rows = [row for row in rows if row[0] == group]
            if [name for _, name, *_ in group_rows] != list(expected):
                raise ValueError(f"the features of {group} are not {', '.join(expected)}")
            mean = [0.0 if value is None else float(value) for *_, value, _ in group_rows]
            deviation = [1.0 if value is None else float(value) for *_, value in group_rows]
            if not all(map(math.isfinite, mean + deviation)) or min(deviation) < 0.0:
                raise ValueError(f"a mean or a deviation of {group} is invalid")
            statistics[group] = (jnp.asarray(mean, jnp.float32), jnp.asarray(deviation, jnp.float32))
    return statistics


def _without_policy(trained: Trained) -> Trained:
    return {name: value for name, value in trained.items() if name != "policy"}


def policy_returns(
    environment: Driving, bank: ScenarioBank, act: Callable[[Observation], Array], gamma: float
) -> tuple[Float[Array, " N"], Float[Array, " N"], Observation, Observation]:
    """Drive a policy in all scenarios from the current step to the end of the episode.

    Returns:
        Discounted return; ``gamma^n`` for an episode of n steps, 0 where it terminated; and the observations of the
        first and the final states. To bootstrap a truncated episode, add this discount times the value of the final
        state to the return.
    """
    simulator = Simulator(replace(environment.task, metrics="none"), environment.simulator.traffic)

    def step(carry: Any, is_first: Array) -> tuple[Any, None]:
        # One step more than the episode has, which observes the final state: a second trace would take long.
        state, over, value, discount, first, _ = carry
        observation = dict(simulator.observe(bank, state.context))
        action = act(jax.tree.map(lambda leaf: leaf[None], observation))[0]
        after, result = simulator.step(bank, state, action)
        value = value + jnp.where(over, 0.0, discount * result.reward)
        discount = jnp.where(over, discount, jnp.where(result.terminated, 0.0, gamma * discount))
        state = jax.tree.map(partial(jnp.where, over), state, after)
        over |= result.terminated | result.truncated
        first = jax.tree.map(partial(jnp.where, is_first), observation, first)
        return (state, over, value, discount, first, observation), None

    def episode(index: Int[Array, ""]) -> tuple[Array, Array, Observation, Observation]:
        initial = simulator.reset(bank, index)
        shapes = jax.eval_shape(lambda: dict(simulator.observe(bank, initial.context)))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        carry = (initial, jnp.zeros((), bool), jnp.zeros(()), jnp.ones(()), zeros, zeros)
        steps = jnp.arange(bank.steps - CURRENT_STEP)
        (_, _, value, discount, first, final), _ = jax.lax.scan(step, carry, steps == 0)
        return value, discount, first, final

    return jax.lax.map(episode, jnp.arange(len(bank)), batch_size=min(len(bank), BATCH))


def returns_to_go(steps: ExpertSteps, final_value: Float[Array, " M"], gamma: float) -> Float[Array, "M T"]:
    """Return the discounted return of recorded episodes from each usable step on; elsewhere it is undefined.

    ``final_value`` is the value of the state in which an episode ends without termination.
    """

    def step(value: Array, step_t: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, terminated, usable = step_t
        value = jnp.where(usable, reward + gamma * jnp.where(terminated, 0.0, value), value)
        return value, value

    columns = (steps.reward.T, steps.terminated.T, steps.usable.T)
    return jax.lax.scan(step, final_value, columns, reverse=True)[1].T


def critic_problems(
    rows: Sequence[Mapping[str, float]], entropy: float | None = None, needs_failures: bool = False
) -> list[str] | None:
    """Diagnose the critics of a run from its rows of ``metrics.jsonl`` up to the loaded policy; return the problems.

    None if Q was not compared with returns, as in runs without validation. ``entropy`` is the policy's target entropy,
    None for a policy without one; ``needs_failures`` is the setting of the algorithm.
    """
    problems, errors, ranks = [], _column(rows, "validation/q_error"), _column(rows, "validation/q_rank")
    if not len(errors) or not len(ranks):
        return None
    failures = _column(rows, "sampler/failures")
    if len(failures) and not failures[-1] >= LEAST_FAILURES:
        problem = f"{failures[-1]:.1%} of the episodes fail, too few to learn what failures cost"
        problems.append(f"{problem}; the policy only imitates" if needs_failures else problem)
    td_error = _column(rows, "loss/critic")
    before, last = (td_error[len(td_error) * k // 4 : len(td_error) * (k + 1) // 4] for k in (2, 3))
    if len(before) and not last.mean() <= MOST_TD_RISE * before.mean():
        values = f"from {before.mean():.3g} to {last.mean():.3g}"
        problems.append(f"the TD error rises over the second half, {values}")
    if not errors[-1] <= MOST_Q_ERROR:
        problems.append(f"Q is off by {errors[-1]:.2f} standard deviations of the policy's returns")
    if not ranks[-1] >= LEAST_Q_RANK:
        problems.append(f"Q has a rank correlation of {ranks[-1]:.2f} with the returns of held-out episodes")
    entropies = _column(rows, "loss/entropy")
    entropies = entropies[len(entropies) * 3 // 4 :]
    if entropy is not None and len(entropies) and not abs(entropies.mean() - entropy) <= MOST_ENTROPY_ERROR:
        problems.append(f"the entropy is {entropies.mean():.2f}, its target {entropy:.2f}")
    return problems


def _column(rows: Sequence[Mapping[str, float]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows if name in row], np.float64)
