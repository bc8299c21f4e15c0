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


#: Of labels: three draws in ten go to steps of an event. If so much does not help, curation hardly can.
_LABELS = WeightConfig(normalise="none", temperature=1.0, most=math.inf, uniform=0.7)
#: By default weights go by the ranks of scores, so that those of all methods have one distribution at either scale and
#: one control each is matched to all of them; but for labels, which are 0 or 1.
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
        "random_matched_scenario": Agent(method="kinematic", scale="scenario", by_lot=True),
        "oracle": Agent(method="oracle", weights=_LABELS),
        "random_matched_oracle": Agent(method="oracle", by_lot=True, weights=_LABELS),
    }
)
#: Agents that are curated, whose scores are not those of a control.
CURATED = tuple(name for name in AGENTS if name.startswith(("heuristic", "ensemble", "action_rarity")))


def control_of(name: str) -> str:
    """The agent whose weights are those of another one, dealt out by lot."""
    if AGENTS[name].method == "oracle":
        return "random_matched_oracle"
    return "random_matched_scenario" if AGENTS[name].scale == "scenario" else "random_matched"


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
