"""The methods of curation by name: from a set to its table of scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from drivax.curation.combining import Combination
from drivax.curation.controls import event_steps, matched
from drivax.curation.kinematic import KinematicConfig
from drivax.curation.published import PublishedConfig
from drivax.curation.ranking import rank_correlation
from drivax.curation.rarity import ExpertActions, KernelRarity, PublishedRarity, rarity_steps
from drivax.curation.scores import ScoreTable, read_scores
from drivax.curation.scoring import Progress, score_steps, valid_steps
from drivax.curation.scouts import Scouts, ScoutsConfig, train_scouts
from drivax.errors import UsageError
from drivax.named import nearest
from drivax.scenario.store import ScenarioSet
from drivax.settings import plain

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
#: A scenario is as uncertain as its most uncertain second.
ENSEMBLE_SCENARIO = "top10"
#: Disagreement above this percentile of a set scores 1.
_MOST = 99.0
_ALL = Combination({"all": 1.0})


@dataclass(frozen=True)
class Wanted:
    """What is asked of a method.

    Attributes:
        data: The set.
        like: Table to match (``random_matched`` only).
        seed: Of what is drawn by lot.
        scouts: The ensemble (``ensemble`` only).
        progress: Called with (scenarios done, scenarios).
        training: Called with (iterations done, iterations) while scouts are trained.
    """

    data: ScenarioSet
    like: Path | None = None
    seed: int = 0
    scouts: ScoutsConfig = field(default_factory=ScoutsConfig)
    progress: Progress | None = None
    training: Progress | None = None


#: A method: from what is asked to the table.
Method = Callable[[Wanted], ScoreTable]


def curate(name: str, wanted: Wanted) -> ScoreTable:
    """Scores a set.

    Raises:
        UsageError: There is no such method, or it lacks what it asks for.
        DataError: It cannot score this set.
    """
    if name not in METHODS:
        raise UsageError(f"there is no method {name!r}", cure=nearest(name, sorted(METHODS)))
    if (wanted.like is not None) != (name == "random_matched"):
        raise UsageError(
            "random_matched needs --like, a table of the same set, and no other method takes it",
            cure="drivax curate random_matched --like SCORES ...",
        )
    table = METHODS[name](wanted)
    if wanted.progress is not None:
        wanted.progress(len(wanted.data), len(wanted.data))
    return table


def _heuristic(name: str, config: Any, combination: Combination) -> Method:
    def score(wanted: Wanted) -> ScoreTable:
        components = score_steps(wanted.data, config, wanted.progress)
        return table_of(name, asdict(config), wanted.data, components, combination)

    return score


def _rarity(name: str, config: KernelRarity | PublishedRarity) -> Method:
    def score(wanted: Wanted) -> ScoreTable:
        expert = ExpertActions()
        found = score_steps(wanted.data, expert, wanted.progress)
        components = {"rarity": rarity_steps(config, found["action"], found["known"])}
        return table_of(name, {**asdict(config), **asdict(expert)}, wanted.data, components, RARITY)

    return score


def _ensemble(wanted: Wanted) -> ScoreTable:
    return ensemble_table(
        train_scouts(wanted.scouts, wanted.data, wanted.training), wanted.data, wanted.progress
    )


def ensemble_table(
    scouts: Scouts, data: ScenarioSet, progress: Progress | None = None, scale: float | None = None
) -> ScoreTable:
    """Scores by the disagreement of an ensemble, which may have been trained on another set.

    Components are the disagreement about each number of the action, over the percentile 99 of their sum in the set; of
    scouts trained by likelihood there is one, the mutual information over its largest possible value. The table's
    configuration says how scores and errors of the scouts correlate by rank, over all steps: on the set that they were
    trained on, errors of the one that has not seen the scenario.

    Args:
        scouts: The ensemble.
        data: The set.
        progress: Called with (scenarios done, scenarios).
        scale: Disagreement that scores 1; by default the percentile 99 of the set.
    """
    opinions = scouts.opinions(data, progress)
    valid = valid_steps(data)
    if opinions.information is None:
        disagreement = opinions.disagreement(scouts.deviation)
        if scale is None:
            scale = float(np.percentile(disagreement.sum(axis=-1)[valid], _MOST))
        parts = np.clip(disagreement / max(scale, np.finfo(np.float64).tiny), 0.0, 1.0)
        components = {f"action_{number}": part for number, part in enumerate(np.moveaxis(parts, -1, 0))}
    else:
        components = {"information": opinions.information / math.log(scouts.config.folds)}
    combination = Combination(dict.fromkeys(components, 1.0), ENSEMBLE_SCENARIO)
    own = data.hash == scouts.set_hash
    error = opinions.error(scouts.deviation, scouts.fold if own else None)
    about = {
        **plain(scouts.config),
        "trained_on": scouts.set_hash,
        "scale": scale,
        "error_rank_correlation": None,
    }
    table = table_of("ensemble", about, data, components, combination)
    known = opinions.known
    about["error_rank_correlation"] = rank_correlation(table.steps[known], error[known])
    return replace(table, config=about | {"combination": asdict(combination)})


def _uniform(wanted: Wanted) -> ScoreTable:
    return table_of("uniform", {}, wanted.data, {"all": np.ones(_shape(wanted.data))}, _ALL)


def _oracle(wanted: Wanted) -> ScoreTable:
    components = {"all": event_steps(wanted.data).astype(np.float64)}
    return table_of("oracle", {}, wanted.data, components, _ALL)


def _random_matched(wanted: Wanted) -> ScoreTable:
    assert wanted.like is not None
    return matched(read_scores(wanted.like, wanted.data), wanted.seed)


def _shape(data: ScenarioSet) -> tuple[int, int]:
    return len(data), data.capacity.steps


def table_of(
    name: str,
    config: Mapping[str, Any],
    data: ScenarioSet,
    components: Mapping[str, np.ndarray[Any, Any]],
    combination: Combination,
) -> ScoreTable:
    """The table of a set, from what a method says of every step.

    Args:
        name: Of the method.
        config: Its configuration, as plain values.
        data: The set.
        components: By name, of every step and in [0, 1].
        combination: How they become scores.
    """
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    valid = valid_steps(data)
    blank = np.zeros(valid.shape)
    return ScoreTable(name, config, data.hash, ids, valid, blank, blank[:, 0], components).combined(
        combination
    )


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "kinematic": _heuristic("kinematic", KinematicConfig(), KINEMATIC),
        "published": _heuristic("published", PublishedConfig(), PUBLISHED),
        "action_rarity": _rarity("action_rarity", KernelRarity()),
        "ensemble": _ensemble,
        "action_rarity_published": _rarity("action_rarity_published", PublishedRarity()),
        "uniform": _uniform,
        "random_matched": _random_matched,
        "oracle": _oracle,
    }
)
