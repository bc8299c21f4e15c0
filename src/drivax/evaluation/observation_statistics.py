"""Statistics of observation features, their correlation with collisions, and their importance to a policy.

States of closed-loop episodes are sampled at regular intervals. The statistics of a column are its mean, standard
deviation, minimum and maximum over finite entries of valid rows, the number of its non-finite entries, its correlation
with collisions, and its importance to the planner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.evaluation.rollout import advance, check_actions, episode_keys, evaluation_task
from drivax.planners.planner import Planner, hold
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import SimState, Traffic
from drivax.tasks.features import Features, feature_names
from drivax.tasks.task import Task

#: Steps between sampled states, scenarios per program call, and maximum number of states with permuted features.
EVERY, BATCH, PERMUTED = 10, 64, 512
Values = np.ndarray[Any, Any]


@record
class SampledStates:
    """Sampled states of episodes, ``[episode, sample]``, with the planner's carry, random key and observation.

    ``has_collided`` marks states from ego's first collision on, and ``collides``, ``[episode]``, marks episodes with a
    collision. The last state of a short log is repeated after its end.
    """

    state: SimState
    carry: Any
    key: Array
    observation: dict[str, Array]
    has_collided: Bool[Array, "*batch sample"]
    collides: Bool[Array, "*batch"]


@dataclass(frozen=True)
class FeatureStatistics:
    """Statistics of one column of one group; NaN if undefined.

    Attributes:
        count: Finite entries of valid rows, from which ``mean``, ``std``, ``low`` and ``high`` are computed.
        broken: NaN or infinite entries, including those of masked rows.
        collision: Correlation with collisions (:func:`collision_correlation`).
        importance: Change of the planner's action when the column is permuted (:func:`importances`).
    """

    group: str
    name: str
    count: int
    broken: int
    mean: float
    std: float
    low: float
    high: float
    collision: float
    importance: float


@dataclass(frozen=True)
class ObservationStatistics:
    """Statistics of all columns, ordered by group.

    Attributes:
        planner: Name of the planner.
        episodes, collisions: Numbers of episodes, and of episodes with a collision.
        states, permuted: Numbers of sampled states before the last step of a log, and of those with permuted features.
        features: Statistics of each column.
        groups: Importance of each group as a whole, if features were permuted.
    """

    planner: str
    episodes: int
    collisions: int
    states: int
    permuted: int
    features: tuple[FeatureStatistics, ...]
    groups: Mapping[str, float]

    @property
    def broken(self) -> int:
        """Number of NaN or infinite entries."""
        return sum(feature.broken for feature in self.features)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; undefined values are null."""
        names = ("planner", "episodes", "collisions", "states", "permuted")
        features = [_plain(asdict(feature)) for feature in self.features]
        summary = {name: getattr(self, name) for name in names}
        return summary | {"groups": _plain(self.groups), "features": features}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Replace NaN and infinite floats by None."""
    return {
        name: None if isinstance(value, float) and not np.isfinite(value) else value
        for name, value in values.items()
    }


def observation_statistics(
    planner: Planner, bank: ScenarioBank, task: Task, *, permute: bool, traffic: Traffic | None = None,
    every: int = EVERY, seed: int = 0,
) -> ObservationStatistics:  # fmt: skip
    """Run a planner on every scenario of a bank from its current step on, and summarise the observations.

    Args:
        planner: The planner; ``expert`` for the log itself.
        bank: The scenarios.
        task: Observations and actions.
        permute: Whether to measure the importance of features to the planner.
        traffic: Traffic model; log replay by default.
        every: Steps between two sampled states; a shorter remainder at the end of an episode is not sampled.
        seed: Seed of the planner, as in an evaluation, and of the permutations.

    Raises:
        UsageError: Planner and task have different action spaces, the planner needs stored scenarios, or ``every`` is
            below 1 or above the steps of an episode.
    """
    check_actions(planner, task)
    steps = bank.steps - 1 - CURRENT_STEP
    if not 1 <= every <= steps:
        raise UsageError(f"every {every} steps", cure=f"use 1 to {steps}")
    if getattr(planner, "prepare", None) is not None:
        problem = f"planner {planner.name} needs stored scenarios"
        raise UsageError(problem, cure="choose another planner")
    traffic = traffic or LogTraffic()
    simulator, bank = Simulator(evaluation_task(task), traffic), prepare_bank(traffic, bank)
    samples = sample_states(simulator, hold(planner, task.hold), bank, every, seed)
    if task.hold > 1:
        # Importances are those of decisions, not of actions that repeat an earlier one.
        samples = replace(samples, carry=samples.carry[0])
    observations = {name: np.asarray(leaf) for name, leaf in samples.observation.items()}
    has_collided, collides = np.asarray(samples.has_collided), np.asarray(samples.collides)
    context = samples.state.context
    in_log = np.asarray(context.step < bank.last_step[context.row])
    columns, groups, permuted = {}, {}, 0
    if permute:
        candidates = np.flatnonzero(in_log)
        positions = np.linspace(0, len(candidates) - 1, min(PERMUTED, len(candidates))).round().astype(int)
        indices = candidates[np.unique(positions)]
        columns, groups = _planner_importances(simulator, planner, bank, samples, indices, seed)
        permuted = len(indices)
    observations = _mask_after_log(observations, in_log)
    features = column_statistics(task.observation.features, observations, has_collided, collides, columns)
    return ObservationStatistics(
        planner.name, len(collides), int(collides.sum()), int(in_log.sum()), permuted, features, groups
    )


def _planner_importances(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, samples: SampledStates, indices: Values, seed: int
) -> tuple[dict[tuple[str, int], float], dict[str, float]]:  # fmt: skip
    """Return the :func:`importances` for a planner in the sampled states with these flat ``indices``."""

    def select(leaf: Array) -> Array:
        return leaf.reshape(samples.has_collided.size, *leaf.shape[2:])[indices]

    states = (samples.state, samples.carry, samples.key, samples.observation)
    *planner_inputs, observation = jax.tree.map(select, states)
    act = partial(_actions, simulator, planner, bank, *planner_inputs)
    return importances(act, jax.device_get(observation), seed)


def _mask_after_log(observation: Mapping[str, Values], in_log: Values) -> dict[str, Values]:
    """Return observations ``[episode, sample, ...]`` with every group masked where ``in_log`` is false."""
    result = dict(observation)
    masks = {f"{group}_mask" for group in observation}
    for group in (name for name in observation if name not in masks):
        shape = observation[group].shape[:-1]
        valid = result.get(f"{group}_mask", np.ones(shape, bool))
        result[f"{group}_mask"] = valid & in_log.reshape(*in_log.shape, *(1,) * (len(shape) - in_log.ndim))
    return result


def column_statistics(
    features: Features, observation: Mapping[str, Values], has_collided: Values, collides: Values,
    importance: Mapping[tuple[str, int], float],
) -> tuple[FeatureStatistics, ...]:  # fmt: skip
    """Return the statistics of every column of observations ``[episode, sample, ...]``, ordered by group.

    ``has_collided`` and ``collides`` are those of :class:`SampledStates`; ``importance`` maps group and column number
    to the permutation importance.
    """
    names = feature_names(features, {name: values.shape[2:] for name, values in observation.items()})
    statistics = []
    for group, columns in names.items():
        for column, name in enumerate(columns):
            values = observation[group][..., column]
            valid = observation.get(f"{group}_mask", np.ones(values.shape, bool))
            dimensions = (*has_collided.shape, *(1,) * (valid.ndim - has_collided.ndim))
            before_collision = valid & ~has_collided.reshape(dimensions)
            correlation = collision_correlation(values, before_collision, collides)
            column_importance = importance.get((group, column), math.nan)
            moments = _moments(values, valid)
            statistics.append(FeatureStatistics(group, name, *moments, correlation, column_importance))
    return tuple(statistics)


def sample_states(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, every: int, seed: int = 0
) -> SampledStates:
    """Return sampled states of one episode per scenario, the same as in an evaluation with this seed until a crash."""
    batches, size = [], min(BATCH, len(bank))
    for first in range(0, len(bank), BATCH):
        scenarios = np.arange(first, min(first + BATCH, len(bank)))
        # Pad the last batch with its last scenario, so that all batches share one compilation.
        index = jnp.asarray(np.pad(scenarios, (0, size - len(scenarios)), mode="edge"), jnp.int32)
        samples = _sample_batch(simulator, planner, bank, index, episode_keys(bank, index, seed), every)
        count = len(scenarios)
        batches.append(jax.tree.map(lambda leaf, count=count: leaf[:count], samples))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *batches)


@partial(jax.jit, static_argnames=("simulator", "every"))
def _sample_batch(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, index: Int[Array, " B"], keys: Array, every: int
) -> SampledStates:  # fmt: skip
    return jax.vmap(partial(_sample_episode, simulator, planner, bank, every))(index, keys)


def _sample_episode(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, every: int, index: Array, key: Array
) -> SampledStates:
    state = simulator.reset(bank, index)
    init_key, key = jax.random.split(key)
    carry = planner.init(bank, state, init_key)
    steps = bank.steps - 1 - CURRENT_STEP
    keys = jax.random.split(key, steps)

    def step(loop_state: Any, key: Array) -> tuple[Any, None]:
        state, carry, has_collided = loop_state
        is_over = state.context.step >= bank.last_step[state.context.row]
        next_state, carry, _ = advance(simulator, planner, bank, state, carry, key)
        state = jax.tree.map(partial(jnp.where, is_over), state, next_state)
        return (state, carry, has_collided | state.facts.collision), None

    def sample(loop_state: Any, keys: Array) -> tuple[Any, Any]:
        state, carry, has_collided = loop_state
        samples = state, carry, keys[0], dict(simulator.observe(bank, state.context)), has_collided
        return jax.lax.scan(step, loop_state, keys)[0], samples

    sampled_steps = steps - steps % every
    initial = (state, carry, state.facts.collision)
    loop_state, samples = jax.lax.scan(sample, initial, keys[:sampled_steps].reshape(-1, every))
    (_, _, collides), _ = jax.lax.scan(step, loop_state, keys[sampled_steps:])
    return SampledStates(*samples, collides=collides)


@partial(jax.jit, static_argnames=("simulator",))
def _actions(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, state: SimState, carry: Any, key: Array,
    observation: dict[str, Array],
) -> Float[Array, "M D"]:  # fmt: skip
    """Return the planner's actions for given observations in given states."""

    def act(state: SimState, carry: Any, key: Array, observation: dict[str, Array]) -> Array:
        return planner.act(carry, bank, state, simulator.situation(bank, state), observation, key)[0]

    return jax.vmap(act)(state, carry, key, observation)


def _moments(values: Values, valid: Values) -> tuple[int, int, float, float, float, float]:
    """Return ``count``, ``broken``, ``mean``, ``std``, ``low`` and ``high`` of :class:`FeatureStatistics`."""
    finite = np.isfinite(values)
    x, broken = values[valid & finite].astype(np.float64), int((~finite).sum())
    if not x.size:
        return 0, broken, math.nan, math.nan, math.nan, math.nan
    return x.size, broken, float(x.mean()), float(x.std()), float(x.min()), float(x.max())


def collision_correlation(values: Values, valid: Values, collides: Values) -> float:
    """Return the point-biserial correlation of a column with collisions, over episodes (Tate 1954).

    It is Pearson's r between the column's mean over its valid entries ``[episode, sample, ...]`` and the collision
    indicator of the episode. Episodes without valid entries are excluded. The result is NaN if fewer than three remain,
    or if all have the same outcome or the same mean.
    """
    included = (valid & np.isfinite(values)).reshape(len(values), -1)
    total = np.where(included, values.reshape(len(values), -1), 0.0).sum(axis=1, dtype=np.float64)
    has_values = included.any(axis=1)
    mean = total[has_values] / included.sum(axis=1)[has_values]
    outcome = collides[has_values].astype(np.float64)
    # Treat a column as constant if it only varies by rounding.
    if len(mean) < 3 or outcome.std() == 0 or mean.std() <= 1e-6 * max(np.abs(mean).max(), 1e-6):
        return math.nan
    return float(((mean - mean.mean()) * (outcome - outcome.mean())).mean() / (mean.std() * outcome.std()))


def importances(
    act: Callable[[dict[str, Any]], Any], observation: Mapping[str, Values], seed: int = 0
) -> tuple[dict[tuple[str, int], float], dict[str, float]]:
    """Return the change of actions when a feature is permuted, by (group, column) and by group.

    This is permutation importance (Breiman 2001) of the action instead of a loss. A column is permuted among the valid
    rows of all states; a whole group is permuted between states, including its mask. The change is the root mean
    square difference from the action for the true observation, over states and the action dimensions that vary, in
    standard deviations of each dimension over the states. A feature without influence has 0; 1.41 is the difference
    between the actions of independent states. The result is NaN if the action is the same in all states.

    Args:
        act: Function from a batch of observations to actions ``[state, D]``.
        observation: Observations ``[state, ...]`` by group.
        seed: Seed of the permutations.
    """
    rng = np.random.default_rng(seed)
    actions = np.asarray(act(dict(observation)), np.float64)
    std = actions.std(axis=0)
    varies = std > 1e-6

    def change(permuted_groups: dict[str, Values]) -> float:
        if not varies.any():
            return math.nan
        shift = np.asarray(act(dict(observation) | permuted_groups), np.float64) - actions
        return float(np.sqrt(np.mean((shift[:, varies] / std[varies]) ** 2)))

    columns, groups = {}, {}
    for group, values in observation.items():
        mask_name = f"{group}_mask"
        if group.removesuffix("_mask") in observation and group.endswith("_mask"):
            continue
        order, names = rng.permutation(len(values)), (group, mask_name)
        groups[group] = change({name: observation[name][order] for name in names if name in observation})
        valid = observation.get(mask_name, np.ones(values.shape[:-1], bool))
        for column in range(values.shape[-1]):
            permuted = np.array(values)
            permuted[valid, column] = rng.permutation(values[valid, column])
            columns[group, column] = change({group: permuted})
    return columns, groups
