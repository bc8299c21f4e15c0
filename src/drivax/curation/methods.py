"""The methods of curation by name: from a set to its table of scores."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from drivax.curation.combining import Combination
from drivax.curation.controls import event_steps, matched
from drivax.curation.ensemble import Scouts, ScoutsConfig, train_scouts
from drivax.curation.kinematic import KinematicConfig
from drivax.curation.published import PublishedConfig
from drivax.curation.rarity import ExpertActions, KernelRarity, PublishedRarity, rarity_steps
from drivax.curation.scores import ScoreTable, read_scores
from drivax.curation.scoring import Progress, score_steps, valid_steps
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.networks.distributions import Actions
from drivax.scenario.store import ScenarioSet
from drivax.settings import plain
from drivax.stats.ranking import rank_correlation

#: The kinematic heuristic. A scenario is as critical as its most critical second. Weights and the second were chosen on
#: the validation set of the built-in world's benchmark (docs/results/curation.md).
KINEMATIC = Combination(
    {"urgency": 0.35, "braking": 0.20, "volatility": 0.30, "lane_deviation": 0.10, "off_road": 0.05}, "top10"
)
#: The published heuristic: weights of steps, and of the numbers that make a scenario's score.
PUBLISHED = Combination(
    {"volatility": 0.40, "interaction": 0.05, "off_road": 0.05, "lane_deviation": 0.47, "density": 0.03},
    {
        "volatility": "p99",
        "interaction": "p99",
        "off_road": "p99",
        "lane_deviation": "std",
        "density": "mean",
    },
)
#: Rarity: a scenario is as rare as its rarest steps, of which the few very rarest may be noise.
RARITY = Combination({"rarity": 1.0}, "p95")
#: A single component.
ALL = Combination({"all": 1.0})
#: Disagreement at this percentile of a set scores a half.
_HALF = 99.0


@dataclass(frozen=True)
class Wanted:
    """What is asked of a method.

    Attributes:
        data: The set.
        like: Table to match (``random_matched`` only).
        seed: Of what is drawn by lot (``random_matched`` only; an ensemble has its own).
        config: Settings of the method, of the type of ``METHODS[name].config``; None: those.
        progress: Called with (scenarios done, scenarios).
        training: Called with (iterations done, iterations) while scouts are trained.
    """

    data: ScenarioSet
    like: Path | None = None
    seed: int = 0
    config: Any = None
    progress: Progress | None = None
    training: Progress | None = None


@dataclass(frozen=True)
class Method:
    """A method of curation.

    Attributes:
        score: From what is asked, with settings, to the table.
        config: Settings by default; None: it has none.
        combination: How its components become scores, from its settings.
        beside: Components that weigh nothing in it, from its settings.
    """

    score: Callable[[Wanted], ScoreTable]
    config: Any = None
    combination: Callable[[Any], Combination] = lambda _: ALL
    beside: Callable[[Any], tuple[str, ...]] = lambda _: ()


def curate(name: str, wanted: Wanted) -> ScoreTable:
    """Scores a set.

    Raises:
        UsageError: There is no such method, it lacks what it asks for, or has no such settings.
        DataError: It cannot score this set.
    """
    if name not in METHODS:
        raise UsageError(f"there is no method {name!r}", cure=did_you_mean(name, sorted(METHODS)))
    if (wanted.like is not None) != (name == "random_matched"):
        raise UsageError(
            "random_matched needs --like, a table of the same set, and no other method takes it",
            cure="drivax curate random_matched --like SCORES ...",
        )
    own = METHODS[name].config
    if wanted.config is not None and type(wanted.config) is not type(own):
        raise UsageError(
            f"{name} has no settings of the kind {type(wanted.config).__name__}",
            cure="leave them out" if own is None else f"use {type(own).__name__}",
        )
    table = METHODS[name].score(replace(wanted, config=own if wanted.config is None else wanted.config))
    if wanted.progress is not None:
        wanted.progress(len(wanted.data), len(wanted.data))
    return table


def refuse_stale(table: ScoreTable, config: Any = None, file: Path | None = None) -> None:
    """Refuses a table that its method would not make now, of the same set.

    Args:
        table: The table.
        config: Settings that the method would have; None: those by default.
        file: Where the table is from.

    Raises:
        DataError: It was made with other settings, or its components were weighted otherwise.
    """
    method, told = METHODS[table.method], dict(table.config)
    now: dict[str, Any] = {} if method.config is None else plain(method.config if config is None else config)
    if table.components:
        now["combination"] = asdict(method.combination(method.config if config is None else config))
    # A table that was read has lists where one that was made has tuples.
    told, now = (json.loads(json.dumps(values)) for values in (told, now))
    for name, value in now.items():
        if told.get(name) != value:
            raise DataError(
                f"scores of {table.method!r} with {name} {told.get(name)}, which is {value} here",
                file=file,
                cure="score again with `drivax curate`",
            )


def check_combination(name: str, config: Any, changes: Mapping[str, Any]) -> None:
    """Refuses other weights or another aggregator (fields of :class:`Combination`) before anything is scored.

    Raises:
        UsageError: A method with these settings has no such component, or there is no such aggregator or weight.
    """
    usual = METHODS[name].combination(config)
    replace(usual, **changes).check_components({*usual.weights, *METHODS[name].beside(config)})


def _disagreement(config: ScoutsConfig) -> Combination:
    """A scenario is as uncertain as its most uncertain second."""
    name = "information" if config.cloning.loss == "likelihood" else "disagreement"
    return Combination({name: 1.0}, "top10")


def _numbers(config: ScoutsConfig) -> tuple[str, ...]:
    return () if config.cloning.loss == "likelihood" else tuple(_number(i) for i in range(Actions().size))


def _number(place: int) -> str:
    return f"action_{place}"


def _heuristic(name: str) -> Callable[[Wanted], ScoreTable]:
    def score(wanted: Wanted) -> ScoreTable:
        components = score_steps(wanted.data, wanted.config, wanted.progress)
        return table_of(name, wanted.config, wanted.data, components)

    return score


def _rarity(name: str) -> Callable[[Wanted], ScoreTable]:
    def score(wanted: Wanted) -> ScoreTable:
        found = score_steps(wanted.data, ExpertActions(), wanted.progress)
        components = {"rarity": rarity_steps(wanted.config, found["action"], found["known"])}
        return table_of(name, wanted.config, wanted.data, components)

    return score


def _ensemble(wanted: Wanted) -> ScoreTable:
    return ensemble_table(
        train_scouts(wanted.config, wanted.data, wanted.training), wanted.data, wanted.progress
    )


def ensemble_table(
    scouts: Scouts, data: ScenarioSet, progress: Progress | None = None, scale: float | None = None
) -> ScoreTable:
    """Scores by the disagreement of an ensemble, which may have been trained on another set.

    The component is ``d / (d + scale)`` of the disagreement d, so that the order of d stays to the top; beside it is
    the same of each number of the action. Of scouts trained by likelihood there is one, the mutual information over its
    largest possible value. The table's configuration says how scores and errors of the scouts correlate by rank, over
    all steps: on the set that they were trained on, errors of the one that has not seen the scenario; where they
    learned from a part of it, errors of their mean, over the rest.

    Args:
        scouts: The ensemble.
        data: The set.
        progress: Called with (scenarios done, scenarios).
        scale: Disagreement that scores a half; by default the percentile 99 of the set; of what scouts learned from
            and of the rest, of which they know less, apart.
    """
    opinions = scouts.opinions(data, progress)
    valid, own = valid_steps(data), data.hash == scouts.set_hash
    unseen = scouts.fold < 0 if own else np.ones(len(data), bool)
    groups = [rows for rows in (~unseen, unseen) if rows.any()]
    scales: list[Any] = [scale] * len(groups)
    if opinions.information is None:
        parts = opinions.disagreement(scouts.deviation)
        whole = parts.sum(axis=-1)
        if scale is None:
            scales = [float(np.percentile(whole[rows][valid[rows]], _HALF)) for rows in groups]
        half = np.zeros((len(data), 1))
        for rows, one in zip(groups, scales, strict=True):
            half[rows] = np.maximum(one, np.finfo(np.float64).tiny)
        components = {
            _number(place): part / (part + half) for place, part in enumerate(np.moveaxis(parts, -1, 0))
        }
        components["disagreement"] = whole / (whole + half)
    else:
        components = {"information": opinions.information / math.log(scouts.config.folds)}
    error = opinions.error(scouts.deviation, scouts.fold if own else None)
    about = {"trained_on": scouts.set_hash, "scale": scales[0] if len(scales) == 1 else scales}
    table = table_of("ensemble", scouts.config, data, components, about)
    known = opinions.known & groups[-1][:, None]
    told = {"error_rank_correlation": rank_correlation(table.steps[known], error[known])}
    return replace(table, config={**table.config, **told})


def _uniform(wanted: Wanted) -> ScoreTable:
    return table_of("uniform", None, wanted.data, {"all": np.ones(_shape(wanted.data))})


def _oracle(wanted: Wanted) -> ScoreTable:
    components = {"all": event_steps(wanted.data).astype(np.float64)}
    return table_of("oracle", None, wanted.data, components)


def _random_matched(wanted: Wanted) -> ScoreTable:
    assert wanted.like is not None
    return matched(read_scores(wanted.like, wanted.data), wanted.seed)


def _shape(data: ScenarioSet) -> tuple[int, int]:
    return len(data), data.capacity.steps


def table_of(
    name: str,
    config: Any,
    data: ScenarioSet,
    components: Mapping[str, np.ndarray[Any, Any]],
    about: Mapping[str, Any] = MappingProxyType({}),
) -> ScoreTable:
    """The table of a set, from what a method says of every step.

    Args:
        name: Of the method.
        config: Its settings; None: it has none.
        data: The set.
        components: By name, of every step and in [0, 1].
        about: What else the table says of how it was made, as plain values.
    """
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    valid = valid_steps(data)
    blank = np.zeros(valid.shape)
    told = {**({} if config is None else plain(config)), **about}
    table = ScoreTable(name, told, data.hash, ids, valid, blank, blank[:, 0], components)
    return table.combined(METHODS[name].combination(config))


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "kinematic": Method(
            _heuristic("kinematic"), KinematicConfig(), lambda _: KINEMATIC, lambda _: ("density",)
        ),
        "published": Method(_heuristic("published"), PublishedConfig(), lambda _: PUBLISHED),
        "action_rarity": Method(_rarity("action_rarity"), KernelRarity(), lambda _: RARITY),
        "ensemble": Method(_ensemble, ScoutsConfig(), _disagreement, _numbers),
        "action_rarity_published": Method(
            _rarity("action_rarity_published"), PublishedRarity(), lambda _: RARITY
        ),
        "uniform": Method(_uniform),
        "random_matched": Method(_random_matched),
        "oracle": Method(_oracle),
    }
)
