"""Registered curation methods, which score the scenarios of a set."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax import settings
from drivax.curation.ensemble import (
    Ensemble,
    EnsembleConfig,
    load_ensemble,
    save_ensemble,
    train_ensemble,
)
from drivax.curation.failures import FailureConfig, failure_components
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import LoggedScenario, Progress, score_steps, valid_steps
from drivax.curation.novelty import Embedding, NoveltyConfig, novelty
from drivax.curation.query import Quantities, QueryConfig
from drivax.curation.rarity import (
    ExpertActions,
    KernelRarity,
    PublishedRarity,
    known_actions,
    rarity_steps,
    read_actions,
    write_actions,
)
from drivax.curation.scores import Combination, ScoreTable, read_scores
from drivax.curation.weights import permute_scores
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.evaluation.episode_table import EpisodeTable
from drivax.learning.driving import Egos, count_egos
from drivax.plugins import check_arguments, find_named, is_dotted
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.settings import plain
from drivax.stats.ranking import rank_correlation
from drivax.synthetic.events import EventKind

#: Weights of the kinematic heuristic, chosen on the validation set of the built-in world's benchmark, that of
#: encroachment on another set (docs/results/curation.md). A scenario is scored by its ten most critical steps.
KINEMATIC = Combination(
    {
        "urgency": 0.19, "encroachment": 0.45, "braking": 0.11, "volatility": 0.17, "lane_deviation": 0.05,
        "off_road": 0.03,
    },
    "top10",
)  # fmt: skip
#: Weights and aggregators of the published heuristic.
PUBLISHED = Combination(
    {"volatility": 0.40, "interaction": 0.05, "off_road": 0.05, "lane_deviation": 0.47, "density": 0.03},
    {"volatility": "p99", "interaction": "p99", "off_road": "p99", "lane_deviation": "std", "density": "mean"},
)  # fmt: skip
#: Action rarity; a scenario is scored by its 95th percentile, because the rarest steps may be noise.
RARITY = Combination({"rarity": 1.0}, "p95")
#: Novelty; a scenario is scored by its ten most novel steps.
NOVELTY = Combination({"novelty": 1.0}, "top10")
#: Failures and near misses of planners.
FAILURES = Combination({"failure": 0.7, "near_miss": 0.3}, "max")
_ALL = Combination({"all": 1.0})
#: Labels of the built-in world: steps of an event, or also every step of a recording that begins with a conflict.
ORACLES = ("oracle", "oracle_critical")
#: Argument of a request that a method needs, with its flag.
_ARGUMENTS = {
    "random_matched": ("like", "--like SCORES"), "mixture": ("tables", "--tables SCORES SCORES"),
    "failures": ("runs", "--runs RUN"),
}  # fmt: skip
#: Aggregator of methods without a combination: users' methods and ``mixture``.
_DEFAULT_AGGREGATOR = "top10"
#: Percentile of a set's disagreement that scores 0.5.
_SCALE_PERCENTILE = 99.0


@dataclass(frozen=True, kw_only=True)
class MethodInputs:
    """What methods read in addition to the scenario set DATA.

    Attributes:
        like: Scores of the same set, for random_matched to permute.
        tables: Scores of the same set, for mixture to combine: --weights kinematic 0.7 ensemble 0.3.
        runs: Evaluations of DATA, for failures.
        members: Folder of an ensemble: if it exists, its members score DATA; otherwise they are trained and written
            there. For novelty and --diverse, the first member embeds the steps.
        actions: File of a histogram of actions: if it exists, action_rarity scores DATA by it; otherwise that of DATA
            is written there.
        egos: Vehicles to score: the recorded ego, or all egos of a set made with --egos (moving).
    """

    like: Path | None = None
    tables: Sequence[Path] = ()
    runs: Sequence[Path] = ()
    members: Path | None = None
    actions: Path | None = None
    egos: Egos = "recorded"


@dataclass(frozen=True)
class Request(MethodInputs):
    """Arguments of a method.

    Attributes:
        data: The scenario set.
        seed: Seed of the permutation of ``random_matched``; an ensemble has its own.
        config: Settings of the method, of the type of ``Method.config``; None: the defaults.
        progress: Called with (scenarios done, scenarios).
        training: Called with (iterations done, iterations) while an ensemble is trained.
        trust: Modules outside drivax whose code the settings of a saved ensemble may name.
    """

    data: ScenarioSet
    seed: int = 0
    config: Any = None
    progress: Progress | None = None
    training: Progress | None = None
    trust: Sequence[str] = ()

    @property
    def most_egos(self) -> int:
        """Number of logs to score per scenario.

        Raises:
            UsageError: ``egos`` is moving, but the set has no further egos.
        """
        return count_egos(self.egos, self.data.capacity.egos)


@dataclass(frozen=True)
class Method:
    """A method; ``config`` are its default settings, None for a method without settings.

    ``score`` takes the name of the method and a request. ``combination`` takes settings and returns the combination of
    the components (None: their mean, aggregated by :data:`_DEFAULT_AGGREGATOR`). ``extra_components`` takes settings
    and returns the names of further components, which have no weight.
    """

    name: str
    score: Callable[[str, Request], ScoreTable]
    config: Any = None
    combination: Callable[[Any], Combination | None] = lambda _: _ALL
    extra_components: Callable[[Any], tuple[str, ...]] = lambda _: ()


def find_method(name: str) -> Method:
    """Return a method by its name, or a user's by its dotted name.

    The latter is a function ``(bank, log) -> {component: [T]}`` of a scenario bank and a
    :class:`~drivax.curation.logged.LoggedScenario`, with values in [0, 1], or a frozen dataclass with such a
    ``__call__``, whose fields are its settings. An attribute ``combination`` combines the components.

    Raises:
        UsageError: The name is unknown, or leads to neither a function nor a dataclass of this kind.
    """
    if name in METHODS:
        return METHODS[name]
    if not is_dotted(name):
        cure = did_you_mean(name, [*sorted(METHODS), "package.module:name"])
        raise UsageError(f"unknown method {name!r}", cure=cure)
    score = find_named(name)
    score = score() if isinstance(score, type) else score
    try:
        check_arguments(score, name, (ScenarioBank, LoggedScenario))
    except ValueError as error:
        raise UsageError(str(error), cure="write a function of a bank and a log") from error
    return Method(name, _components, score, lambda config: getattr(config, "combination", None))


def curate(name: str, request: Request) -> ScoreTable:
    """Score a set by a built-in method, or by a user's (:func:`find_method`).

    Raises:
        UsageError: The method is unknown, lacks an argument, or takes settings of another type.
        DataError: The method cannot score this set.
    """
    method = find_method(name)
    for owner, (argument, flag) in _ARGUMENTS.items():
        is_given = bool(getattr(request, argument))
        if is_given != (name == owner):
            problem = f"{owner} needs {flag}, and no other method takes it"
            raise UsageError(problem, cure=f"leave out --{argument}" if is_given else f"pass {flag}")
    if name == "mixture" and len(request.tables) < 2:
        raise UsageError("a single table to mix", cure="pass --tables SCORES SCORES")
    default = method.config
    config = default if request.config is None else request.config
    if type(config) is not type(default):
        cure = "remove them" if default is None else f"use {type(default).__name__}"
        raise UsageError(f"{name} has no settings of type {type(config).__name__}", cure=cure)
    table = method.score(name, replace(request, config=config))
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
    combination = method.combination(config)
    if table.components and combination is not None:
        expected_values["combination"] = asdict(combination)
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
    method = find_method(name)
    default, extra = method.combination(config), method.extra_components(config)
    if default is not None:  # otherwise the components are not known yet
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
    zeros, values = np.zeros(valid.shape), {**(plain(config) if is_dataclass(config) else {}), **details}
    table = ScoreTable(name, values, data.hash, ids, valid, zeros, np.zeros(len(ids)), components, egos)
    combination = find_method(name).combination(config)
    return table.recombine(combination or Combination(dict.fromkeys(components, 1.0), _DEFAULT_AGGREGATOR))


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


def _components(name: str, request: Request) -> ScoreTable:
    components = score_steps(request.data, request.config, request.progress, request.most_egos)
    return make_table(name, request.config, request.data, components, egos=request.most_egos)


def _rarity(name: str, request: Request) -> ScoreTable:
    config, histogram, file, counted = request.config, None, request.actions, request.data.hash
    if file is not None and file.exists():
        config, histogram, counted = read_actions(config, file)
    expert = score_steps(request.data, ExpertActions(), request.progress, request.most_egos)
    if file is not None and histogram is None:
        histogram = config.histogram(known_actions(expert["action"], expert["known"]))
        write_actions(config, histogram, counted, file)
    components = {"rarity": rarity_steps(config, expert["action"], expert["known"], histogram)}
    details = {"actions_of": counted}
    return make_table(name, config, request.data, components, details, egos=request.most_egos)


def _ensemble(_: str, request: Request) -> ScoreTable:
    if request.members is not None and request.members.exists():
        ensemble = load_ensemble(request.members, request.data, request.egos, request.trust)
    else:
        ensemble = train_ensemble(request.config, request.data, request.training, request.egos)
        if request.members is not None:
            save_ensemble(ensemble, request.members)
    return ensemble_table(ensemble, request.data, request.progress)


def _uniform(name: str, request: Request) -> ScoreTable:
    steps = np.ones((len(request.data) * request.most_egos, request.data.capacity.steps))
    return make_table(name, None, request.data, {"all": steps}, egos=request.most_egos)


def _oracle(name: str, request: Request) -> ScoreTable:
    labels = event_steps(request.data)
    if name == "oracle_critical":
        labels |= np.array([entry["tags"].get("critical") == "yes" for entry in request.data.entries])[
            :, None
        ]
    steps = np.repeat(labels.astype(np.float64), request.most_egos, axis=0)
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


def _mix(name: str, request: Request) -> ScoreTable:
    """Return a table whose components are the quantiles of the step scores of tables."""
    components, egos = dict[str, Any](), set[int]()
    for path in request.tables:
        table = read_scores(path, request.data)
        key = table.method if table.method not in components else f"{table.method}_{path.stem}"
        if key in components:
            raise UsageError(f"two tables are called {key}", file=path, cure="rename one of the files")
        components[key] = _quantiles(table.steps, table.valid)
        egos.add(table.egos)
    if len(egos) > 1:
        raise UsageError("tables have different --egos", cure="score all of them with the same")
    details = {"tables": [str(path) for path in request.tables]}
    return make_table(name, None, request.data, components, details, egos.pop())


def _query(name: str, request: Request) -> ScoreTable:
    quantities = score_steps(request.data, Quantities(), request.progress, request.most_egos)
    matches = request.config.matches(quantities, valid_steps(request.data, request.most_egos))
    components = {"match": matches.astype(np.float64)}
    return make_table(name, request.config, request.data, components, egos=request.most_egos)


def embedding_of(config: NoveltyConfig, request: Request) -> Embedding:
    """Return the embedding of a request's set, by the first member of its ensemble if it has one."""
    ensemble = None
    if request.members is not None:
        ensemble = load_ensemble(request.members, request.data, request.egos, request.trust)
    return Embedding.of(config, request.data, ensemble, request.egos)


def _novelty(name: str, request: Request) -> ScoreTable:
    distance = novelty(request.config, embedding_of(request.config, request), request.data, request.progress)
    egos = request.most_egos
    scale = float(np.percentile(distance[valid_steps(request.data, egos)], _SCALE_PERCENTILE))
    components = {"novelty": distance / (distance + max(scale, np.finfo(np.float32).tiny))}
    details = {"scale": scale, "members": None if request.members is None else str(request.members)}
    return make_table(name, request.config, request.data, components, details, egos)


def _score_failures(name: str, request: Request) -> ScoreTable:
    if request.egos != "recorded":
        raise UsageError("planners drive the recorded ego", cure="leave out --egos")
    runs = [EpisodeTable.read(path) for path in request.runs]
    components = failure_components(request.config, runs, request.data, request.progress)
    details = {"runs": [str(path) for path in request.runs], "planners": [run.name for run in runs]}
    return make_table(name, request.config, request.data, components, details)


def _quantiles(steps: Float[np.ndarray, "M T"], valid: Bool[np.ndarray, "M T"]) -> Float[np.ndarray, "M T"]:
    """Return the share of valid steps with a lower score (of equal scores, half), 0 at steps that are not valid."""
    scores = np.sort(steps[valid])
    low, high = (np.searchsorted(scores, steps, side) for side in ("left", "right"))
    return np.where(valid, (low + high) / (2.0 * max(len(scores), 1)), 0.0)


_METHODS = (
    Method("kinematic", _components, KinematicConfig(), lambda _: KINEMATIC, lambda _: ("density",)),
    Method("published", _components, PublishedConfig(), lambda _: PUBLISHED),
    Method("ensemble", _ensemble, EnsembleConfig(), _ensemble_combination, _action_components),
    Method(KernelRarity.method, _rarity, KernelRarity(), lambda _: RARITY),
    Method(PublishedRarity.method, _rarity, PublishedRarity(), lambda _: RARITY),
    Method("uniform", _uniform),
    Method("random_matched", _permute_like),
    Method("novelty", _novelty, NoveltyConfig(), lambda _: NOVELTY),
    Method("query", _query, QueryConfig(), lambda _: Combination({"match": 1.0})),
    Method("mixture", _mix, combination=lambda _: None),
    Method("failures", _score_failures, FailureConfig(), lambda _: FAILURES),
    *(Method(name, _oracle) for name in ORACLES),
)
#: All methods by name.
METHODS: Mapping[str, Method] = MappingProxyType({method.name: method for method in _METHODS})
