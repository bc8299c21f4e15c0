"""The agents of the long-tail study: what each is trained with, and by which scores its recorded steps are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from drivax.curation.controls import matched
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import Scale, WeightConfig, weights_of
from drivax.errors import UsageError
from drivax.learning.experience import WeightedSet
from drivax.scenario.store import ScenarioSet

#: From the name of a method to its table of a set.
Tables = Callable[[str], ScoreTable]


@dataclass(frozen=True)
class Agent:
    """An agent of the study.

    Attributes:
        preset: Its training configuration.
        method: What its steps are drawn by (:data:`~drivax.curation.methods.METHODS`).
        scale: Whether steps are weighted one by one, or as their scenarios are.
        by_lot: Whether the scores are dealt out anew by lot: the control of ``method``.
        weights: How scores become weights, in place of what is asked for.
    """

    preset: str = "offline/cql"
    method: str = "uniform"
    scale: Scale = "step"
    by_lot: bool = False
    weights: WeightConfig | None = None


#: Of labels, which are 0 or 1: such a share of the draws goes to steps of an event, beside what uniform draws find. On
#: the benchmark's training set, where every fortieth step is of an event, 0.115 makes the effective sample that scores
#: make by their ranks, 0.66.
_LABELS, _STRONG_LABELS = (
    WeightConfig(normalise="none", temperature=1.0, most=math.inf, uniform=1.0 - share)
    for share in (0.115, 0.3)
)
#: By default weights go by the ranks of scores, so that those of all methods have one distribution at either scale. By
#: step each method has a lot of its own, since its scores spread over scenarios in their own way.
AGENTS: Mapping[str, Agent] = MappingProxyType(
    {
        "bc": Agent("offline/bc"),
        "baseline": Agent(),
        "cql_bc": Agent("offline/cql_bc"),
        "heuristic": Agent(method="kinematic"),
        "heuristic_scenario": Agent(method="kinematic", scale="scenario"),
        "ensemble": Agent(method="ensemble"),
        "ensemble_scenario": Agent(method="ensemble", scale="scenario"),
        "action_rarity": Agent(method="action_rarity"),
        "action_rarity_scenario": Agent(method="action_rarity", scale="scenario"),
        "random_matched": Agent(method="kinematic", by_lot=True),
        "random_matched_ensemble": Agent(method="ensemble", by_lot=True),
        "random_matched_action_rarity": Agent(method="action_rarity", by_lot=True),
        "random_matched_scenario": Agent(method="kinematic", scale="scenario", by_lot=True),
        "oracle": Agent(method="oracle", weights=_LABELS),
        "oracle_strong": Agent(method="oracle", weights=_STRONG_LABELS),
        "random_matched_oracle": Agent(method="oracle", by_lot=True, weights=_LABELS),
    }
)
#: Agents that are curated, whose scores are not those of a control.
CURATED = tuple(name for name in AGENTS if name.startswith(("heuristic", "ensemble", "action_rarity")))


def control_of(name: str) -> str:
    """The agent whose weights are those of another one, dealt out by lot.

    Raises:
        StopIteration: It has none.
    """
    one = AGENTS[name]
    return next(
        other
        for other, lot in AGENTS.items()
        if lot.by_lot
        and (lot.scale, lot.weights) == (one.scale, one.weights)
        and (one.scale == "scenario" or lot.method == one.method)
    )


def weighted(
    agent: Agent,
    data: ScenarioSet,
    tables: Tables,
    config: WeightConfig,
    usable: np.ndarray | None = None,
    seed: int = 0,
) -> WeightedSet:
    """A set with the weights of an agent.

    Args:
        agent: The agent.
        data: The set.
        tables: Scores of the set.
        config: How scores become weights, unless the agent has its own way.
        usable: Which steps its training learns from (:func:`~drivax.curation.weights.weights_of`).
        seed: Of the lot, for agents ``by_lot``.

    Raises:
        UsageError: The table is of another method, or nothing has a weight or a label.
    """
    table = tables(agent.method)
    if table.method != agent.method:
        raise UsageError(
            f"scores of {table.method!r} for an agent that is curated by {agent.method!r}",
            cure=f"drivax curate {agent.method} --data {data.path} --out SCORES",
        )
    if agent.method == "oracle" and not table.steps.any():
        raise UsageError(
            "no scenario has a labelled event", file=data.path, cure="use an agent that needs no labels"
        )
    if agent.by_lot:
        table = matched(table, seed, usable)
    return WeightedSet(data, weights_of(table, agent.weights or config, agent.scale, usable))
