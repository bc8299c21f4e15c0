"""``drivax train``: train a planner from a configuration file."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax import settings
from drivax.cli.curate import scored
from drivax.curation.arms import AGENTS, Agent, weighted
from drivax.curation.methods import Wanted, refuse_stale
from drivax.curation.scores import ScoreTable, read_scores
from drivax.curation.weights import WeightConfig, weights_of
from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.experience import WeightedSet
from drivax.learning.loop import train, usable_steps
from drivax.learning.program import widen_pool
from drivax.scenario.store import ScenarioSet


@dataclass(frozen=True)
class Train:
    """Train a policy: online, by imitation, or offline from recorded steps.

    SIGTERM writes a checkpoint and ends the run; --resume goes on from there.

    CONFIG is a YAML file or the name of a preset; any of its settings can be given behind as --section.key VALUE.

    Example: drivax train demo --data sets/train --validation sets/test --out runs/ppo --algorithm.learning_rate 1e-3

    Example: drivax train offline/cql --data sets/train --agent heuristic --out runs/cql-heuristic

    Example: drivax train offline/iql --data sets/train --scores scores.npz --out runs/iql-critical
    """

    config: tyro.conf.Positional[str]
    """YAML file, or name of a preset (demo)."""
    data: Path
    """Scenario set to train on."""
    out: Path
    """Run folder to write."""
    validation: Path | None = None
    """Scenario set that chooses the best checkpoint."""
    scores: Path | None = None
    """Scores of DATA by drivax curate: bc and offline algorithms draw each recorded step by its weight."""
    scale: Literal["step", "scenario"] | None = None
    """Whether steps are weighted one by one (the default), or as their scenarios are; with --scores."""
    agent: (
        Literal[
            "bc", "baseline", "cql_bc", "heuristic", "heuristic_scenario", "ensemble", "ensemble_scenario",
            "action_rarity", "action_rarity_scenario", "random_matched", "random_matched_ensemble",
            "random_matched_action_rarity", "random_matched_scenario", "oracle", "oracle_strong",
            "random_matched_oracle",
        ]
        | None
    ) = None  # fmt: skip
    """Curation of the agent of that name in the long-tail study: scores DATA first, or takes --scores."""
    weighting: WeightConfig = field(default_factory=WeightConfig)
    """How scores become weights; with --scores or --agent."""
    seeds: int = 1
    """Agents to train in one program, with the configured seed and the following ones; each has a folder in OUT."""
    begin_from: Annotated[str | None, tyro.conf.arg(name="from", metavar="RUN[@STEP]")] = None
    """Begin with the networks of another run; replay, optimisers and environments are fresh, settings free."""
    resume: bool = False
    """Continue the run in OUT from its newest checkpoint."""
    overwrite: bool = False
    """Replace OUT if it is a run folder."""


def run(args: Train, overrides: Sequence[str] = ()) -> int:
    """Train, then say where the run is."""
    given = [*overrides, *([] if args.begin_from is None else ["--from", args.begin_from])]
    if args.resume and given:
        raise UsageError("a resumed run keeps its configuration", cure="leave out " + " ".join(given))
    if args.seeds > 1 or args.resume:
        widen_pool()
    config = settings.load(TrainConfig, args.config, list(overrides))
    if args.begin_from is not None:
        config = replace(config, begin_from=args.begin_from)
    validation = None if args.validation is None else ScenarioSet.open(args.validation)
    folder = train(
        config,
        _data(args, config),
        args.out,
        validation=validation,
        resume=args.resume,
        overwrite=args.overwrite,
        seeds=args.seeds,
        log=lambda line: print(line, file=sys.stderr),
    )
    print(f"wrote {folder.path}")
    return 0


def _data(args: Train, config: TrainConfig) -> ScenarioSet | WeightedSet:
    """The set, with weights if scores or an agent are asked for."""
    data, weighting = ScenarioSet.open(args.data), args.weighting
    if args.agent is None:
        if args.scores is None:
            if weighting != WeightConfig():
                raise UsageError("--weighting without scores to weight", cure="pass --scores or --agent")
            if args.scale is not None:
                raise UsageError("--scale without scores to weight", cure="pass --scores")
            return data
        table = read_scores(args.scores, data)
        return WeightedSet(
            data, weights_of(table, weighting, args.scale or "step", usable_steps(config, data))
        )
    agent = AGENTS[args.agent]
    _refuse_other(args, agent, config)
    return weighted(
        agent, data, partial(_table, args, data), weighting, usable_steps(config, data), config.seed
    )


def _refuse_other(args: Train, agent: Agent, config: TrainConfig) -> None:
    """Refuses a training that is not that of the agent, and flags that the agent would ignore."""
    own, wanted = (_trained_by(one) for one in (config, settings.load(TrainConfig, agent.preset)))
    if own != wanted:
        raise UsageError(
            f"the agent {args.agent} is trained by {wanted}, not {own}", cure=f"use {agent.preset}"
        )
    if args.scale is not None:
        raise UsageError(
            f"the agent {args.agent} has its own scale", cure="leave out --scale, or choose another --agent"
        )
    if agent.weights is not None and args.weighting != WeightConfig():
        raise UsageError(f"the agent {args.agent} has its own weights", cure="leave out --weighting")
    if agent.by_lot and args.seeds > 1:
        raise UsageError(
            f"{args.seeds} agents {args.agent} in one program would share one lot",
            cure="train each by itself: --seeds 1 --seed NUMBER",
        )


def _trained_by(config: TrainConfig) -> str:
    """The algorithm, and whether it imitates beside."""
    imitates = getattr(config.algorithm, "imitation", 0.0) > 0.0
    return settings.kind_of(type(config.algorithm)) + (" with imitation" if imitates else "")


def _table(args: Train, data: ScenarioSet, method: str) -> ScoreTable:
    """Scores by a method of an agent of the study."""
    if args.scores is None:
        return scored(method, Wanted(data))
    table = read_scores(args.scores, data)
    # Scores of another method have no settings to compare; who weights refuses them.
    if table.method == method:
        refuse_stale(table, file=args.scores)
    return table
