"""Scouts: an ensemble of cloned drivers that have seen different recordings. Where they disagree, data are scarce.

Each scout leaves one fold of the recordings out; all are trained side by side in one program, and differ in their first
parameters, too. They look at the same steps, drawn and observed once for all; each leaves those of its own fold out of
its loss, so that what it learns from is drawn as it would be for it alone. Deep ensembles: Lakshminarayanan et al.
2017, arXiv 1612.01474.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.curation.rarity import KernelRarity, rarity_steps
from drivax.curation.scoring import Progress, each_batch
from drivax.errors import UsageError
from drivax.evaluation.memory import free_memory
from drivax.learning.algorithms.behaviour_cloning import Bc, BcConfig, imitation_update
from drivax.learning.driving import Driving
from drivax.learning.experience import Experience, ExperienceConfig, draw, expert_actions, recorded, sampler
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.distributions import Distribution
from drivax.networks.entity import EntityConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank, Sizes
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.stats.clusters import recordings_of
from drivax.tasks.features import Features
from drivax.tasks.observations import PRESETS
from drivax.tasks.task import Task

#: Logs whose steps are observed at once.
_AT_ONCE = 8
#: Scenarios whose opinions are computed with at once.
_BLOCK = 4096
#: Actions that are drawn from every scout to measure how much their distributions differ.
_DRAWN = 16

#: Nothing that a driver could copy instead of looking: no past steps, no last action.
_SEEN = replace(PRESETS["minimal"], agents=16, features=Features(ego_static=("length", "width")))

Numbers = np.ndarray[Any, Any]


@dataclass(frozen=True)
class ScoutsConfig:
    """An ensemble of scouts.

    Attributes:
        folds: How many scouts; each leaves out every so manieth recording, chosen by lot.
        cloning: How each is trained; of every ``batch`` each scout takes the share of the other folds, steps of its own
            being left out. With ``loss: mse`` scouts disagree by the variance of what they would do; with
            ``likelihood`` by how much their distributions differ, so that ``network.distribution: mixture`` can
            disagree about modes.
        learn_from: About so many scenarios are learned from, whole recordings chosen by lot; null: all, which have to
            fit on the device. All are scored.
        total_steps: Recorded steps that are drawn for all of them, rounded up to whole iterations of ``cloning``.
        weighted: ``plain``: all steps alike; ``rarity``: drawn by inverse density of the expert's action, clipped
            (:class:`~drivax.curation.rarity.KernelRarity` with its exponent at 1).
        task: What scouts see, and what actions are.
        seed: Of folds, networks and draws.
    """

    folds: int = 5
    cloning: BcConfig = field(
        default_factory=lambda: BcConfig(
            batch=128, network=NetworkConfig(encoder=EntityConfig(), activation="relu")
        )
    )
    learn_from: int | None = None
    total_steps: int = 384_000
    weighted: Literal["plain", "rarity"] = "plain"
    task: Task = field(default_factory=lambda: Task(observation=_SEEN, metrics="none"))
    seed: int = 0

    def __post_init__(self) -> None:
        if self.folds < 2:
            raise UsageError(
                f"{self.folds} folds", cure="use 2 or more: one scout has nobody to disagree with"
            )
        if self.learn_from is not None and self.learn_from < 1:
            raise UsageError(f"learn_from is {self.learn_from}", cure="use 1 or more, or leave it out")

    @property
    def iterations(self) -> int:
        """Iterations of the training."""
        return -(-self.total_steps // self.cloning.steps_per_iteration)


@dataclass(frozen=True)
class Opinions:
    """What scouts make of every step of a set.

    Attributes:
        action: What each would do, by the mode, in units of the action space.
        expert: What the expert did.
        known: Where what the expert did is known, and an action does it.
        information: Mutual information of action and scout, nats, if they were trained by likelihood.
    """

    action: Float[Numbers, "N T K D"]
    expert: Float[Numbers, "N T D"]
    known: Bool[Numbers, "N T"]
    information: Float[Numbers, "N T"] | None

    def disagreement(self, deviation: Float[Numbers, " D"]) -> Float[Numbers, "N T D"]:
        """Variance among the scouts (unbiased), in units of the variance of what experts do."""
        variance = [self.action[rows].astype(np.float64).var(axis=2, ddof=1) for rows in self._blocks()]
        return np.concatenate(variance) / deviation**2

    def error(
        self, deviation: Float[Numbers, " D"], fold: Int[Numbers, " N"] | None
    ) -> Float[Numbers, "N T"]:
        """Squared error over the expert's variance, summed over the action.

        Args:
            deviation: Standard deviation of what experts do.
            fold: Of each scenario, whose scout is judged since it has not seen it; -1, or None for all: nobody has
                seen it, and their mean is judged.
        """
        judged = np.full(len(self.action), -1) if fold is None else fold
        found = []
        for rows in self._blocks():
            action, place = self.action[rows].astype(np.float64), judged[rows, None, None]
            own = np.take_along_axis(action, place[..., None], axis=2)[:, :, 0]
            one = np.where(place < 0, action.mean(axis=2), own)
            found.append((((one - self.expert[rows]) / deviation) ** 2).sum(axis=-1))
        return np.concatenate(found)

    def _blocks(self) -> list[slice]:
        """Rows that are computed with at once: in double precision all of a large set take several times its memory."""
        return [slice(first, first + _BLOCK) for first in range(0, len(self.action), _BLOCK)]


@dataclass(frozen=True)
class Scouts:
    """A trained ensemble.

    Attributes:
        config: What it is.
        learner: What one scout is.
        parameters: Of all, along a leading axis.
        set_hash: ``ScenarioSet.hash`` of what it was trained on.
        fold: Of every scenario of that; -1 of those that no scout has seen.
        deviation: Standard deviation of what the experts of those did, in units of the action space.
    """

    config: ScoutsConfig
    learner: Bc
    parameters: Any
    set_hash: str
    fold: Int[Numbers, " N"]
    deviation: Float[Numbers, " D"]

    def opinions(self, data: ScenarioSet, progress: Progress | None = None) -> Opinions:
        """What they make of a set, which need not be the one that they were trained on."""
        found = each_batch(data, lambda bank: self._of_bank(self.parameters, bank), progress)
        return Opinions(**{"information": None, **found})

    @partial(jax.jit, static_argnums=0)
    def _of_bank(self, parameters: Any, bank: ScenarioBank) -> dict[str, Array]:
        environment = recorded(self.learner.environment)
        steps = jnp.arange(bank.steps)

        def one(index: Array) -> dict[str, Array]:
            seen = environment.observe_recorded(bank, (jnp.full_like(steps, index), steps))
            act = partial(self.learner.distribution, observation=seen)
            found = {"action": jnp.moveaxis(jax.vmap(lambda own: act(own).mode())(parameters), 0, 1)}
            if self.config.cloning.loss == "likelihood":
                found["information"] = mutual_information(jax.vmap(act)(parameters), jax.random.key(0))
            return found

        expert = environment.expert_steps(bank)
        found = jax.lax.map(one, jnp.arange(len(bank)), batch_size=_AT_ONCE)
        return {**found, "expert": expert.action, "known": expert.usable & ~expert.clipped}

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


def mutual_information(scouts: Distribution, key: Array) -> Float[Array, "*batch"]:
    """How much an action tells of whose it is, nats: from 0, where all distributions are the same, to ``ln K``.

    The mean of ``ln p_k(a) - ln (1/K sum_j p_j(a))`` over scouts k and actions that they draw (Jensen-Shannon
    divergence; Lin 1991), estimated from 16 of each.

    Args:
        scouts: Distributions along a leading axis of K.
        key: Of the draws.
    """
    count = jax.tree.leaves(scouts)[0].shape[0]
    density = jax.vmap(lambda one, choice: one.log_prob(choice), (0, None))

    def of_draw(key: Array) -> Array:
        choice = jax.vmap(lambda one, key: one.sample(key))(scouts, jax.random.split(key, count))
        log_prob = jax.vmap(density, (None, 0))(scouts, choice)  # [whose action, whose density, ...]
        own = jnp.moveaxis(jnp.diagonal(log_prob), -1, 0)
        return jnp.mean(own - jax.nn.logsumexp(log_prob, axis=1) + math.log(count), axis=0)

    found = jnp.mean(jax.lax.map(of_draw, jax.random.split(key, _DRAWN)), axis=0)
    return jnp.clip(found, 0.0, math.log(count))


def folds_of(clusters: Sequence[str], folds: int, seed: int) -> Int[Numbers, " N"]:
    """A fold of every scenario: recordings, shuffled, are dealt out one by one, so that none is cut apart.

    Raises:
        UsageError: There are fewer recordings than folds.
    """
    names, number = np.unique(clusters, return_inverse=True)
    if len(names) < folds:
        raise UsageError(
            f"{len(names)} recordings for {folds} folds",
            cure=f"use {folds} recordings or more, or fewer folds",
        )
    return np.random.default_rng(seed).permutation(len(names))[number] % folds


def some_of(clusters: Sequence[str], count: int | None, seed: int) -> Int[Numbers, " n"]:
    """Rows of whole recordings, chosen by lot until there are ``count`` or more, in order; None: all."""
    names, number = np.unique(clusters, return_inverse=True)
    if count is None:
        return np.arange(len(number))
    place = np.random.default_rng(seed).permutation(len(names))
    sizes = np.bincount(place[number])
    # A recording is taken as long as those before it are too few.
    return np.flatnonzero((np.cumsum(sizes) - sizes < count)[place[number]])


def train_scouts(
    config: ScoutsConfig, data: ScenarioSet, say: Callable[[int, int], None] | None = None
) -> Scouts:
    """Trains an ensemble.

    Args:
        config: What it is.
        data: Scenarios; those that are learned from are held on the device.
        say: Called with (iterations done, iterations).

    Raises:
        UsageError: There are fewer recordings than folds, or the scenarios do not fit on the device.
        DataError: No step can be learned from.
    """
    environment = Driving(Simulator(config.task))
    clusters = np.array(recordings_of(data.entries))
    rows = some_of(clusters.tolist(), config.learn_from, config.seed)
    fold = np.full(len(data), -1)
    fold[rows] = folds_of(clusters[rows].tolist(), config.folds, config.seed)
    _refuse_too_many(config, data, len(rows), free_memory(jax.devices()[0]))
    bank = ScenarioBank.from_scenarios(data[row] for row in rows)
    experience, deviation = experience_of(config, environment, bank)
    learner = config.cloning.build(environment, bank, config.iterations)
    parameters = fit(config, learner, experience, fold[rows], say)
    return Scouts(config, learner, parameters, data.hash, fold, deviation)


def _refuse_too_many(config: ScoutsConfig, data: ScenarioSet, count: int, free: int | None) -> None:
    """Refuses more scenarios than the device holds."""
    if free is None:
        return
    one = ScenarioBank.from_scenarios([data[0]], trim=Sizes.used(data)).nbytes
    # Each is there twice while a bank is made.
    if 2 * one * count > free:
        fits = free // (4 * one)
        raise UsageError(
            f"{count:,} scenarios take some {2e-9 * one * count:,.0f} GB, and {free / 1e9:,.0f} GB are free",
            file=data.path,
            cure=f"pass --learn_from {fits}: scouts learn from so many, and score all"
            if fits >= config.folds
            else "free memory",
        )


def experience_of(
    config: ScoutsConfig, environment: Driving, bank: ScenarioBank
) -> tuple[Experience, Float[Numbers, " D"]]:
    """What scouts learn from and how it is drawn, and the deviation of what experts do."""
    made = ExperienceConfig(mask_clipped=config.cloning.mask_clipped).of(environment, bank)
    usable = np.asarray(made.usable)
    action = np.asarray(made.expert.action, np.float64)
    if config.weighted == "rarity":
        weights = rarity_steps(KernelRarity(temper=1.0), action, usable)
        made = replace(made, critic=sampler(np.where(usable, weights, 0.0)))
    return made, np.maximum(action[usable].std(axis=0), 1e-6)


def fit(
    config: ScoutsConfig,
    learner: Bc,
    experience: Experience,
    fold: Int[Numbers, " N"],
    say: Callable[[int, int], None] | None = None,
    together: bool | None = None,
) -> Any:
    """Parameters of all scouts, along a leading axis.

    Args:
        config: What they are.
        learner: What one is.
        experience: What they learn from.
        fold: Of every scenario.
        say: Called with (iterations done, iterations).
        together: Whether an update of all is stacked, or done one after the other; the same either way. By default it
            is stacked but on CPUs, where products of stacked small matrices take thrice as long.
    """
    environment, cloning = recorded(learner.environment), config.cloning
    if together is None:
        together = jax.default_backend() != "cpu"
    used = math.ceil(cloning.batch * (1.0 - 1.0 / config.folds))

    def update(experience: Experience, fold: Array, trained: Any, key: Array) -> tuple[tuple[Any, Any], None]:
        places = draw(experience.critic, key, (cloning.batch,))
        observation, action, _ = expert_actions(environment, experience, places)

        def one(each: tuple[Array, tuple[Any, Any]]) -> tuple[Any, Any]:
            others = fold[places[0]] != each[0]
            # Those of its fold last; steps are drawn independently, so that which others are too many is chance.
            rows = jnp.argsort(~others, stable=True)[:used]
            seen = jax.tree.map(lambda leaf: leaf[rows], observation)

            def loss(parameters: Any) -> tuple[Array, dict[str, Array]]:
                return cloning.imitation_loss(
                    learner.distribution(parameters, seen), action[rows], others[rows]
                )

            return imitation_update(each[1], learner.optimiser, loss)[0]

        size = config.folds if together else None
        return jax.lax.map(one, (jnp.arange(config.folds), trained), batch_size=size), None

    @partial(jax.jit, donate_argnums=2)
    def iterate(experience: Experience, fold: Array, trained: Any, key: Array) -> Any:
        keys = jax.random.split(key, cloning.updates)
        return jax.lax.scan(partial(update, experience, fold), trained, keys)[0]

    network_key, key = jax.random.split(jax.random.key(config.seed))
    keys = jax.random.split(network_key, config.folds)
    state = jax.jit(jax.vmap(learner.init, (None, 0)))(experience.data, keys)
    trained = (state.parameters, state.optimiser)
    for done in range(config.iterations):
        trained = iterate(experience, jnp.asarray(fold), trained, jax.random.fold_in(key, done))
        jax.block_until_ready(trained)
        if say is not None:
            say(done + 1, config.iterations)
    return trained[0]
