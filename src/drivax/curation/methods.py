"""Registered curation methods, which score the scenarios of a set."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax import settings
from drivax.curation.ensemble import Ensemble, EnsembleConfig, train_ensemble
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import Progress, score_steps, valid_steps
from drivax.curation.rarity import ExpertActions, KernelRarity, PublishedRarity, rarity_steps
from drivax.curation.scores import Combination, ScoreTable, read_scores
from drivax.curation.weights import permute_scores
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.learning.driving import Egos, count_egos
from drivax.scenario.store import ScenarioSet
from drivax.settings import plain
from drivax.stats.ranking import rank_correlation
from drivax.synthetic.events import EventKind

#: Weights of the kinematic heuristic, chosen on the validation set of the built-in world's benchmark
#: (docs/results/curation.md). A scenario is scored by its ten most critical steps.
KINEMATIC = Combination(
    {"urgency": 0.35, "braking": 0.20, "volatility": 0.30, "lane_deviation": 0.10, "off_road": 0.05}, "top10"
)
#: Weights and aggregators of the published heuristic.
PUBLISHED = Combination(
    {"volatility": 0.40, "interaction": 0.05, "off_road": 0.05, "lane_deviation": 0.47, "density": 0.03},
    {"volatility": "p99", "interaction": "p99", "off_road": "p99", "lane_deviation": "std", "density": "mean"},
)  # fmt: skip
#: Action rarity; a scenario is scored by its 95th percentile, because the rarest steps may be noise.
RARITY = Combination({"rarity": 1.0}, "p95")
_ALL = Combination({"all": 1.0})
#: Percentile of a set's disagreement that scores 0.5.
_SCALE_PERCENTILE = 99.0


@dataclass(frozen=True)
class Request:
    """Arguments of a method.

    Attributes:
        data: The scenario set.
        like, seed: Table to match, and seed of the permutation (only ``random_matched``; an ensemble has its own
            seed).
        config: Settings of the method, of the type of ``Method.config``; None: the defaults.
        progress: Called with (scenarios done, scenarios).
        training: Called with (iterations done, iterations) while an ensemble is trained.
        egos: Vehicles to score: the recorded ego of each scenario, or all egos of a set made with ``--egos`` (moving).
    """

    data: ScenarioSet
    like: Path | None = None
    seed: int = 0
    config: Any = None
    progress: Progress | None = None
    training: Progress | None = None
    egos: Egos = "recorded"

    @property
    def most_egos(self) -> int:
        """Number of logs to score per scenario.

        Raises:
            UsageError: ``egos`` is moving, but the set has no further egos.
        """
        return count_egos(self.egos, self.data.capacity.egos)


@dataclass(frozen=True)
class Method:
    """A registered method; ``config`` are its default settings, None for a method without settings.

    ``score`` takes the name of the method and a request. ``combination`` and ``extra_components`` take settings, and
    return the combination of the components and the names of further components, which have no weight.
    """

    name: str
    score: Callable[[str, Request], ScoreTable]
    config: Any = None
    combination: Callable[[Any], Combination] = lambda _: _ALL
    extra_components: Callable[[Any], tuple[str, ...]] = lambda _: ()


def curate(name: str, request: Request) -> ScoreTable:
    """Score a set.

    Raises:
        UsageError: The method is unknown, lacks an argument, or takes settings of another type.
        DataError: The method cannot score this set.
    """
    if name not in METHODS:
        raise UsageError(f"unknown method {name!r}", cure=did_you_mean(name, sorted(METHODS)))
    if (request.like is not None) != (name == "random_matched"):
        problem = "random_matched needs --like, a table of the same set, and no other method takes it"
        cure = "pass --like SCORES" if request.like is None else "leave out --like"
        raise UsageError(problem, cure=cure)
    default = METHODS[name].config
    config = default if request.config is None else request.config
    if type(config) is not type(default):
        cure = "remove them" if default is None else f"use {type(default).__name__}"
        raise UsageError(f"{name} has no settings of type {type(config).__name__}", cure=cure)
    table = METHODS[name].score(name, replace(request, config=config))
    if request.progress is not None:
        request.progress(len(request.data), len(request.data))
    return table


def check_current(table: ScoreTable, config: Any = None, file: Path | None = None) -> None:
    """Check that a table has the settings that its method would write now.

    ``config`` are the settings of the method (None: the defaults), ``file`` is the source of the table.

    Raises:
        DataError: Settings or combination differ.
    """
    method, config_of_table = METHODS[table.method], json.loads(json.dumps(dict(table.config)))
    config = method.config if config is None else config
    expected_values: dict[str, Any] = {} if method.config is None else plain(config)
    if method.config is not None:
        try:
            config_of_table |= _rename_fields(config_of_table, config, expected_values)
        except UsageError as error:
            raise DataError(error.problem, file=file, cure="score again with `drivax curate`") from error
    if table.components:
        expected_values["combination"] = asdict(method.combination(config))
    for name, value in expected_values.items():
        if config_of_table.get(name) != value:
            problem = f"scores of {table.method!r} have {name} {config_of_table.get(name)}, not {value}"
            raise DataError(problem, file=file, cure="score again with `drivax curate`")


def _rename_fields(stored: Mapping[str, Any], config: Any, names: Collection[str]) -> dict[str, Any]:
    """Return the stored settings ``names`` of a table, with former names of fields replaced by present ones."""
    values = {name: stored[name] for name in names if name in stored}
    renamed = plain(settings.load(type(config), values, trust=()))
    return {name: value for name, value in renamed.items() if name in stored}


def check_combination(name: str, config: Any, changes: Mapping[str, Any]) -> None:
    """Check that a method can apply weights or aggregators (fields of :class:`Combination`).

    Raises:
        UsageError: A component is unknown, or a weight or aggregator is invalid.
    """
    default, extra = METHODS[name].combination(config), METHODS[name].extra_components(config)
    replace(default, **changes).check_components({*default.weights, *extra})


def make_table(
    name: str, config: Any, data: ScenarioSet, components: Mapping[str, np.ndarray[Any, Any]],
    details: Mapping[str, Any] = MappingProxyType({}), egos: int = 1,
) -> ScoreTable:  # fmt: skip
    """Return the score table of a set from the components of every step, in [0, 1].

    ``config`` are the settings of the method ``name``; ``details`` are further plain values for the table's
    configuration. ``egos`` is the number of logs per scenario.
    """
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    valid = valid_steps(data, egos)
    zeros, values = np.zeros(valid.shape), {**({} if config is None else plain(config)), **details}
    table = ScoreTable(name, values, data.hash, ids, valid, zeros, np.zeros(len(ids)), components, egos)
    return table.recombine(METHODS[name].combination(config))


def ensemble_table(
    ensemble: Ensemble, data: ScenarioSet, progress: Progress | None = None, scale: float | None = None
) -> ScoreTable:
    """Return scores by the disagreement d of an ensemble, which may have been trained on another set.

    The component ``disagreement`` is ``d / (d + scale)``, which is monotonic in d; ``action_0``, ``action_1``, ... are
    the same for each dimension of the action. An ensemble trained by likelihood has ``information`` instead, the
    mutual information relative to its maximum. ``error_rank_correlation`` in the table's configuration is the rank
    correlation of scores and squared errors over steps. If the ensemble was trained on all scenarios of the set, errors
    are those of the member that excluded the scenario, otherwise of the members' mean on the scenarios not trained on.

    Args:
        ensemble: The ensemble.
        data: The set.
        progress: Called with (scenarios done, scenarios).
        scale: Disagreement that scores 0.5; None: the 99th percentile of the set, computed separately for training
            scenarios and others.
    """
    predictions = ensemble.predictions(data, progress)
    is_training_set = data.hash == ensemble.set_hash
    egos = len(predictions.known) // len(data)
    fold = np.repeat(ensemble.fold, egos) if is_training_set else None
    is_unseen = np.ones(len(predictions.known), bool) if fold is None else fold < 0
    groups = [group for group in (~is_unseen, is_unseen) if group.any()]
    scales: list[Any] = [scale] * len(groups)
    if predictions.information is not None:
        components = {"information": predictions.information / math.log(ensemble.config.folds)}
    else:
        disagreement = predictions.disagreement(ensemble.deviation)
        if scale is None:
            total, valid = disagreement.sum(axis=-1), valid_steps(data, egos)
            scales = [float(np.percentile(total[group][valid[group]], _SCALE_PERCENTILE)) for group in groups]
        components = _disagreement_components(disagreement, groups, scales)
    error = predictions.error(ensemble.deviation, fold)
    details = {"trained_on": ensemble.set_hash, "scale": scales[0] if len(scales) == 1 else scales}
    table = make_table("ensemble", ensemble.config, data, components, details, egos)
    is_known = predictions.known & groups[-1][:, None]
    correlation = {"error_rank_correlation": rank_correlation(table.steps[is_known], error[is_known])}
    return replace(table, config={**table.config, **correlation})


def _disagreement_components(
    disagreement: Float[np.ndarray[Any, Any], "M T D"], groups: Sequence[Bool[np.ndarray[Any, Any], " M"]],
    scales: Sequence[float],
) -> dict[str, Any]:  # fmt: skip
    """Return ``d / (d + scale)`` for each dimension of the action and for their sum, with one scale per group."""
    scale = np.zeros((len(disagreement), 1))
    for group, group_scale in zip(groups, scales, strict=True):
        scale[group] = np.maximum(group_scale, np.finfo(np.float64).tiny)
    dimensions = enumerate(np.moveaxis(disagreement, -1, 0))
    components = {f"action_{index}": values / (values + scale) for index, values in dimensions}
    total = disagreement.sum(axis=-1)
    return {**components, "disagreement": total / (total + scale)}


def _ensemble_combination(config: EnsembleConfig) -> Combination:
    """Return the combination that scores a scenario by the ten steps with the largest disagreement."""
    name = "information" if config.cloning.loss == "likelihood" else "disagreement"
    return Combination({name: 1.0}, "top10")


def _action_components(config: EnsembleConfig) -> tuple[str, ...]:
    size = 0 if config.cloning.loss == "likelihood" else config.task.actions.size
    return tuple(f"action_{index}" for index in range(size))


def _heuristic(name: str, request: Request) -> ScoreTable:
    components = score_steps(request.data, request.config, request.progress, request.most_egos)
    return make_table(name, request.config, request.data, components, egos=request.most_egos)


def _rarity(name: str, request: Request) -> ScoreTable:
    expert = score_steps(request.data, ExpertActions(), request.progress, request.most_egos)
    components = {"rarity": rarity_steps(request.config, expert["action"], expert["known"])}
    return make_table(name, request.config, request.data, components, egos=request.most_egos)


def _ensemble(_: str, request: Request) -> ScoreTable:
    ensemble = train_ensemble(request.config, request.data, request.training, request.egos)
    return ensemble_table(ensemble, request.data, request.progress)


def _uniform(name: str, request: Request) -> ScoreTable:
    steps = np.ones((len(request.data) * request.most_egos, request.data.capacity.steps))
    return make_table(name, None, request.data, {"all": steps}, egos=request.most_egos)


def _oracle(name: str, request: Request) -> ScoreTable:
    steps = np.repeat(event_steps(request.data).astype(np.float64), request.most_egos, axis=0)
    return make_table(name, None, request.data, {"all": steps}, egos=request.most_egos)


def event_steps(data: ScenarioSet) -> Bool[np.ndarray, "N T"]:
    """Return the mask of steps within a labelled event of the built-in world.

    Raises:
        DataError: The set is not from the built-in world.
    """
    datasets = {str(entry["dataset"]) for entry in data.entries}
    if datasets != {"drivax"}:
        problem = f"only the built-in world has event labels, this set is from {', '.join(sorted(datasets))}"
        cure = "use another method, or a set that `drivax generate` made"
        raise DataError(problem, file=data.path, cure=cure)
    step = np.arange(data.capacity.steps)
    events = []
    for scenario in data:
        kind, first, last = (scenario.record[f"event_{name}"][:, None] for name in ("kind", "start", "end"))
        events.append(((kind > EventKind.NONE) & (step >= first) & (step <= last)).any(axis=0))
    return np.stack(events)


def event_kinds(data: ScenarioSet) -> Int[np.ndarray, " N"]:
    """Return the :class:`~drivax.synthetic.events.EventKind` of every scenario's first event, or 0 without events."""
    return np.array([max(int(scenario.record["event_kind"][0]), 0) for scenario in data])


def _permute_like(_: str, request: Request) -> ScoreTable:
    assert request.like is not None
    return permute_scores(read_scores(request.like, request.data), request.seed)


_METHODS = (
    Method("kinematic", _heuristic, KinematicConfig(), lambda _: KINEMATIC, lambda _: ("density",)),
    Method("published", _heuristic, PublishedConfig(), lambda _: PUBLISHED),
    Method("ensemble", _ensemble, EnsembleConfig(), _ensemble_combination, _action_components),
    Method("action_rarity", _rarity, KernelRarity(), lambda _: RARITY),
    Method("action_rarity_published", _rarity, PublishedRarity(), lambda _: RARITY),
    Method("uniform", _uniform),
    Method("random_matched", _permute_like),
    Method("oracle", _oracle),
)
#: All methods by name.
METHODS: Mapping[str, Method] = MappingProxyType({method.name: method for method in _METHODS})
