"""Ensemble of behaviour cloning policies, whose disagreement is high on rare data.

Each member excludes one fold of the recordings. All members are trained in one program, from different initial
parameters, on the same batches; a member masks the steps of its own fold. Deep ensembles: Lakshminarayanan et al. 2017,
arXiv 1612.01474.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.checks import check_at_least, check_at_most
from drivax.curation.logged import Progress, map_batches
from drivax.curation.rarity import KernelRarity, rarity_steps
from drivax.errors import DataError, UsageError
from drivax.evaluation.memory import free_memory
from drivax.files import check_output, replace_folder
from drivax.learning.algorithms.behaviour_cloning import Bc, BcConfig, imitation_update
from drivax.learning.driving import Driving, Egos, check_learnable
from drivax.learning.experience import (
    Experience,
    ExperienceConfig,
    expert_actions,
    require_log,
    sample_steps,
    sampler,
)
from drivax.learning.program import all_finite, isolated_leaves
from drivax.learning.training_log import DivergenceError, nonfinite_leaf, nonfinite_log
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.attention import EntityConfig
from drivax.networks.distributions import Distribution
from drivax.reading import explain_damage
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.store import ScenarioSet
from drivax.seal import seal
from drivax.simulator.simulator import Simulator
from drivax.stats.clusters import recordings_of
from drivax.tasks.features import Features
from drivax.tasks.observations import PRESETS
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import pack, unpack
from drivax.tracking.run_folder import RUN_FILE, RunFolder, training_sets

#: Logs per batch of observations.
_LOG_BATCH = 8
#: Scenarios per block of predictions, which limits the memory of float64 copies.
_BLOCK_SIZE = 4096
#: Actions sampled from every member to estimate the mutual information.
_SAMPLES = 16
#: File of the members in the folder of a saved ensemble.
_MEMBERS = "members.npz"
#: Largest number of members.
MOST_FOLDS = 1000
#: Observation without past steps and the last action, which a policy could copy.
OBSERVATION = replace(PRESETS["minimal"], agents=16, features=Features(ego_static=("length", "width")))

_NETWORK = NetworkConfig(encoder=EntityConfig(), activation="relu")

Numbers = np.ndarray[Any, Any]


@dataclass(frozen=True)
class EnsembleConfig:
    """Configuration of an ensemble.

    Attributes:
        folds: Number of members; each excludes a random 1 / ``folds`` of the recordings.
        cloning: Training of each member, on the steps of the other folds in every ``batch``. With ``loss: mse`` the
            disagreement is the variance of the predicted actions; with ``likelihood`` it is the mutual information of
            the action distributions, so that ``network.distribution: mixture`` can disagree about modes.
        learn_from: Approximate number of scenarios to train on, in randomly chosen whole recordings; null: all, which
            must fit on the device. All scenarios are scored.
        total_steps: Logged steps drawn for all members, rounded up to whole iterations of ``cloning``.
        weighted: ``plain``: uniform draws; ``rarity``: draws by the clipped inverse density of the expert's action
            (:class:`~drivax.curation.rarity.KernelRarity` with exponent 1).
        task: Observation and action space.
        seed: Seed of folds, networks and draws.
    """

    folds: int = 5
    cloning: BcConfig = field(default_factory=lambda: BcConfig(batch=128, network=_NETWORK))
    learn_from: int | None = None
    total_steps: int = 384_000
    weighted: Literal["plain", "rarity"] = "plain"
    task: Task = field(default_factory=lambda: Task(observation=OBSERVATION, metrics="none"))
    seed: int = 0

    def __post_init__(self) -> None:
        if self.folds < 2:
            raise UsageError(f"{self.folds} folds", cure="use 2 or more: disagreement needs two members")
        if self.learn_from is not None and self.learn_from < 1:
            raise UsageError(f"learn_from is {self.learn_from}", cure="use 1 or more, or null")
        check_at_least(self, 1, "total_steps")
        check_at_most(self, MOST_FOLDS, "folds")
        check_at_least(self, 0, "seed")
        check_learnable(self.task.actions)
        if self.weighted == "rarity" and self.task.actions.size != 2:
            raise UsageError("rarity needs actions of two dimensions", cure="use weighted: plain")

    @property
    def iterations(self) -> int:
        """Number of training iterations."""
        return -(-self.total_steps // self.cloning.steps_per_iteration)


@dataclass(frozen=True)
class Predictions:
    """Predictions of the members at every step of M logs, and the expert's actions, in units of the action space.

    ``action`` holds the modes of the K members. ``known`` marks usable steps (``ExpertSteps``) with an action within
    the bounds. ``information`` is the mutual information of action and member in nats; None for ``loss: mse``.
    """

    action: Float[Numbers, "M T K D"]
    expert: Float[Numbers, "M T D"]
    known: Bool[Numbers, "M T"]
    information: Float[Numbers, "M T"] | None

    def disagreement(self, deviation: Float[Numbers, " D"]) -> Float[Numbers, "M T D"]:
        """Return the unbiased variance among members, relative to the variance of the expert's actions."""
        variance = [self.action[block].astype(np.float64).var(axis=2, ddof=1) for block in self._blocks()]
        return np.concatenate(variance) / deviation**2

    def error(
        self, deviation: Float[Numbers, " D"], fold: Int[Numbers, " M"] | None
    ) -> Float[Numbers, "M T"]:
        """Return the squared error relative to the variance of the expert's actions, summed over the dimensions.

        The prediction is that of member ``fold``, which excluded the log, or the mean of all members (-1 or None).
        """
        members = np.full(len(self.action), -1) if fold is None else fold
        errors = []
        for block in self._blocks():
            action, member = self.action[block].astype(np.float64), members[block, None, None]
            member_action = np.take_along_axis(action, member[..., None], axis=2)[:, :, 0]
            prediction = np.where(member < 0, action.mean(axis=2), member_action)
            errors.append((((prediction - self.expert[block]) / deviation) ** 2).sum(axis=-1))
        return np.concatenate(errors)

    def _blocks(self) -> list[slice]:
        return [slice(first, first + _BLOCK_SIZE) for first in range(0, len(self.action), _BLOCK_SIZE)]


@dataclass(frozen=True, eq=False)
class Ensemble:
    """A trained ensemble: the learner of one member, and the parameters of all members along a leading axis.

    ``set_hash`` is the hash of the training set, ``fold`` the fold of every scenario (-1 for those not trained on),
    and ``deviation`` the standard deviation of the expert's actions, in units of the action space.
    """

    config: EnsembleConfig
    learner: Bc
    parameters: Any
    set_hash: str
    fold: Int[Numbers, " N"]
    deviation: Float[Numbers, " D"]

    def predictions(self, data: ScenarioSet, progress: Progress | None = None) -> Predictions:
        """Return the predictions on a set, which may differ from the training set."""
        values = map_batches(data, lambda bank, _: self._predict_bank(self.parameters, bank), progress)
        return Predictions(**{"information": None, **values})

    @partial(jax.jit, static_argnums=0)
    def _predict_bank(self, parameters: Any, bank: ScenarioBank) -> dict[str, Array]:
        environment = require_log(self.learner.environment)
        steps = jnp.arange(bank.steps)

        def predict(index: Array) -> dict[str, Array]:
            observation = environment.observe_recorded(bank, (jnp.full_like(steps, index), steps))
            act = partial(self.learner.distribution, observation=observation)
            modes = jax.vmap(lambda member: act(member).mode())(parameters)
            values = {"action": jnp.moveaxis(modes, 0, 1)}
            if self.config.cloning.loss == "likelihood":
                values["information"] = mutual_information(jax.vmap(act)(parameters), jax.random.key(0))
            return values

        expert = environment.expert_steps(bank)
        values = jax.lax.map(predict, jnp.arange(len(expert.usable)), batch_size=_LOG_BATCH)
        return {**values, "expert": expert.action, "known": expert.usable & ~expert.clipped}


def save_ensemble(ensemble: Ensemble, out: Path) -> None:
    """Write an ensemble as a folder, for :func:`load_ensemble`.

    Raises:
        UsageError: ``out`` exists.
    """
    check_output(out, False, folder=True)
    data = [{"hash": ensemble.set_hash, "scenarios": len(ensemble.fold)}]
    with replace_folder(out) as partial_folder:
        deviation = [float(number) for number in ensemble.deviation]
        folder = RunFolder.create(partial_folder, ensemble.config, overwrite=True, kind="ensemble")
        folder.note(data=data, deviation=deviation)
        arrays = {"parameters": ensemble.parameters, "fold": ensemble.fold.astype(np.int32)}
        pack(partial_folder / _MEMBERS, arrays)
        seal(partial_folder, _MEMBERS)


def load_ensemble(
    path: str | Path, data: ScenarioSet, egos: Egos = "recorded", trust: Sequence[str] = ()
) -> Ensemble:
    """Load an ensemble to score a set, which need not be that of its training.

    ``trust`` are the modules outside drivax whose code its settings may name.

    Raises:
        DataError: The folder is missing or damaged, or no ensemble.
        UsageError: It names code that is not trusted.
    """
    folder = RunFolder.open(path)
    if folder.kind != "ensemble":
        cure = "name a folder that drivax curate ensemble --members wrote"
        raise DataError(f"is of kind {folder.kind!r}, not ensemble", file=path, cure=cure)
    config = folder.config(EnsembleConfig, trust=trust)
    with explain_damage(folder.path / RUN_FILE, "train the ensemble again"):
        (source,) = training_sets(folder.info)
        set_hash, scenarios = str(source["hash"]), int(source["scenarios"])
        deviation = np.array(folder.info["deviation"], np.float64)
        if deviation.shape != (config.task.actions.size,) or not (deviation > 0.0).all():
            raise ValueError("a deviation is missing or not above 0")
    bank = ScenarioBank.from_scenarios([data[0]], trim=Sizes.used(data))
    learner = config.cloning.build(Driving(Simulator(config.task), egos=egos), bank, config.iterations)
    keys = jax.random.split(jax.random.key(0), config.folds)
    parameters = jax.eval_shape(jax.vmap(lambda key: learner.init(bank, key).parameters), keys)
    template = {"parameters": parameters, "fold": jax.ShapeDtypeStruct((scenarios,), jnp.int32)}
    arrays = unpack(folder.path / _MEMBERS, template)
    fold = np.asarray(arrays["fold"], np.int64)
    return Ensemble(config, learner, arrays["parameters"], set_hash, fold, deviation)


def mutual_information(members: Distribution, key: Array) -> Float[Array, "*batch"]:
    """Return the mutual information of action and member in nats: 0 for equal distributions, at most ``ln K``.

    It is the mean of ``ln p_k(a) - ln (1/K sum_j p_j(a))`` over members k and their actions a (Jensen-Shannon
    divergence; Lin 1991), estimated from 16 samples of each member. The members lie along the leading axis.
    """
    count = jax.tree.leaves(members)[0].shape[0]
    density = jax.vmap(lambda member, action: member.log_prob(action), (0, None))

    def estimate(key: Array) -> Array:
        actions = jax.vmap(lambda member, key: member.sample(key))(members, jax.random.split(key, count))
        log_prob = jax.vmap(density, (None, 0))(members, actions)  # [sampled member, density member, ...]
        own_log_prob = jnp.moveaxis(jnp.diagonal(log_prob), -1, 0)
        return jnp.mean(own_log_prob - jax.nn.logsumexp(log_prob, axis=1) + math.log(count), axis=0)

    mean = jnp.mean(jax.lax.map(estimate, jax.random.split(key, _SAMPLES)), axis=0)
    return jnp.clip(mean, 0.0, math.log(count))


def assign_folds(clusters: Sequence[str], folds: int, seed: int) -> Int[Numbers, " N"]:
    """Return a random fold of every scenario; all scenarios of a recording have the same fold.

    Raises:
        UsageError: There are fewer recordings than folds.
    """
    names, recording = np.unique(clusters, return_inverse=True)
    if len(names) < folds:
        cure = f"use {folds} recordings or more, or fewer folds"
        raise UsageError(f"{len(names)} recordings for {folds} folds", cure=cure)
    return np.random.default_rng(seed).permutation(len(names))[recording] % folds


def sample_recordings(clusters: Sequence[str], count: int | None, seed: int) -> Int[Numbers, " n"]:
    """Return sorted scenario indices of random whole recordings, at least ``count`` if there are as many; None: all."""
    if count is None:
        return np.arange(len(clusters))
    names, recording = np.unique(clusters, return_inverse=True)
    rank = np.random.default_rng(seed).permutation(len(names))[recording]
    sizes = np.bincount(rank)
    # Add recordings until there are enough scenarios.
    return np.flatnonzero((np.cumsum(sizes) - sizes < count)[rank])


def train_ensemble(
    config: EnsembleConfig, data: ScenarioSet, log: Progress | None = None, egos: Egos = "recorded"
) -> Ensemble:
    """Train an ensemble on the logs of ``egos``; ``log`` is called with (iterations done, iterations).

    Raises:
        UsageError: There are fewer recordings than folds, or the scenarios do not fit on the device.
        DataError: No step is usable for training.
        DivergenceError: A loss or a parameter is not finite.
    """
    environment = Driving(Simulator(config.task), egos=egos)
    clusters = np.array(recordings_of(data.entries))
    training_scenarios = sample_recordings(clusters.tolist(), config.learn_from, config.seed)
    fold = np.full(len(data), -1)
    fold[training_scenarios] = assign_folds(clusters[training_scenarios].tolist(), config.folds, config.seed)
    _check_memory(config, data, len(training_scenarios), free_memory(jax.devices()[0]))
    bank = ScenarioBank.from_scenarios(data[index] for index in training_scenarios)
    experience, deviation = experience_of(config, environment, bank)
    learner = config.cloning.build(environment, bank, config.iterations)
    parameters = fit(config, learner, experience, fold[training_scenarios], log)
    return Ensemble(config, learner, parameters, data.hash, fold, deviation)


def _check_memory(config: EnsembleConfig, data: ScenarioSet, count: int, free: int | None) -> None:
    """Check that the scenarios fit on the device; building a bank takes twice its memory."""
    if free is None:
        return
    size = ScenarioBank.from_scenarios([data[0]], trim=Sizes.used(data)).nbytes
    if 2 * size * count > free:
        # Half of what fits, because whole recordings exceed the number, and the training needs memory.
        max_scenarios, need_gb = free // (4 * size), 2e-9 * size * count
        problem = f"{count:,} scenarios take about {need_gb:,.0f} GB, and {free / 1e9:,.0f} GB are free"
        cure = f"set learn_from to {max_scenarios} to train on fewer scenarios; all are scored"
        cure = cure if max_scenarios >= config.folds else "free memory"
        raise UsageError(problem, file=data.path, cure=cure)


def experience_of(
    config: EnsembleConfig, environment: Driving, bank: ScenarioBank
) -> tuple[Experience, Float[Numbers, " D"]]:
    """Return the experience for training the members, and the standard deviation of the expert's actions."""
    experience = ExperienceConfig(mask_clipped=config.cloning.mask_clipped).of(environment, bank)
    usable = np.asarray(experience.usable)
    action = np.asarray(experience.expert.action, np.float64)
    if config.weighted == "rarity":
        weights = rarity_steps(KernelRarity(temper=1.0), action, usable)
        experience = replace(experience, critic=sampler(np.where(usable, weights, 0.0)))
    return experience, np.maximum(action[usable].std(axis=0), 1e-6)


def _check_finite(step: int, state: Any, logs: dict[str, Array], finite: Bool[Array, " K"]) -> None:
    """Raise DivergenceError if a loss or (by ``finite``) a trained leaf of a member is not finite."""
    losses, is_finite = jax.device_get((logs, finite))
    for number in range(len(is_finite)):
        problem = nonfinite_log({name: float(values[number]) for name, values in losses.items()})
        if problem is None and not is_finite[number]:
            problem = nonfinite_leaf(jax.tree.map(lambda leaf, number=number: leaf[number], state))
        if problem is not None:
            text = f"training of the ensemble diverged at step {step:,}: {problem} in member {number}"
            raise DivergenceError(text, cure="lower cloning.learning_rate")


def fit(
    config: EnsembleConfig, learner: Bc, experience: Experience, fold: Int[Numbers, " N"],
    log: Progress | None = None, batched: bool | None = None,
) -> Any:  # fmt: skip
    """Return the trained parameters of all members, along a leading axis.

    With ``batched``, all members are updated in one batched computation instead of one after another, with the same
    results up to rounding. The default is True except on CPUs, where batched products of small matrices are slower.

    Raises:
        DivergenceError: A loss or a parameter is not finite.
    """
    environment, cloning = require_log(learner.environment), config.cloning
    fold = np.repeat(fold, experience.expert.egos)
    if batched is None:
        batched = jax.default_backend() != "cpu"
    steps_per_member = math.ceil(cloning.batch * (1.0 - 1.0 / config.folds))

    def update(experience: Experience, fold: Array, states: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        indices = sample_steps(experience.critic, key, (cloning.batch,))
        observation, action, _ = expert_actions(environment, experience, indices)

        def update_member(member: tuple[Array, tuple[Any, Any]]) -> tuple[Any, dict[str, Array]]:
            own_fold, member_state = member
            is_other_fold = fold[indices[0]] != own_fold
            # Sort steps of the own fold last. Draws are independent, so the cut removes random steps of other folds.
            order = jnp.argsort(~is_other_fold, stable=True)[:steps_per_member]
            batch = jax.tree.map(lambda leaf: leaf[order], observation)

            def loss(parameters: Any) -> tuple[Array, dict[str, Array]]:
                distribution = learner.distribution(parameters, batch)
                return cloning.imitation_loss(distribution, action[order], is_other_fold[order])

            return imitation_update(member_state, learner.optimiser, loss)

        size = config.folds if batched else None
        return jax.lax.map(update_member, (jnp.arange(config.folds), states), batch_size=size)

    @partial(jax.jit, donate_argnums=2)
    def iterate(
        experience: Experience, fold: Array, states: Any, key: Array
    ) -> tuple[Any, dict[str, Array], Bool[Array, " K"]]:
        keys = jax.random.split(key, cloning.updates)
        states, logs = jax.lax.scan(partial(update, experience, fold), states, keys)
        means = {f"loss/{name}": values.mean(axis=0) for name, values in logs.items()}
        return states, means, jax.vmap(all_finite)(isolated_leaves(states))

    network_key, key = jax.random.split(jax.random.key(config.seed))
    keys = jax.random.split(network_key, config.folds)
    state = jax.jit(jax.vmap(learner.init, (None, 0)))(experience.data, keys)
    states = (state.parameters, state.optimiser)
    for iteration in range(config.iterations):
        states, *values = iterate(experience, jnp.asarray(fold), states, jax.random.fold_in(key, iteration))
        state = replace(state, parameters=states[0], optimiser=states[1])
        _check_finite((iteration + 1) * cloning.steps_per_iteration, state, *values)
        if log is not None:
            log(iteration + 1, config.iterations)
    return states[0]
