"""``drivax curate``: criticality scores of a scenario set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from drivax.errors import UsageError

if TYPE_CHECKING:
    from drivax.curation.methods import Wanted
    from drivax.curation.scores import ScoreTable
    from drivax.scenario.store import ScenarioSet

#: So many of the most critical scenarios are told.
_TOLD = 10


@dataclass(frozen=True)
class Curate:
    """Score how critical every scenario and step of a set is.

    kinematic: how soon and how hard the recorded driver had to act, and how it drove.

    published: the published heuristic, faults included, to compare with.

    ensemble: how much cloned drivers that have seen different recordings disagree; trains them first.

    action_rarity: how seldom the recorded driver does what it does (action_rarity_published: by the published bins).

    uniform, random_matched, oracle: all alike; the scores of --like, dealt out by lot; the built-in world's labels.

    Example: drivax curate kinematic --data sets/world --out scores.npz --export sets/critical 500

    Example: drivax curate ensemble --data sets/world --out scores.npz --cloning.loss likelihood

    Example: drivax curate kinematic --data sets/world --out sooner.npz --urgent_s 2

    Example: drivax curate kinematic --data sets/world --out near.npz --again scores.npz --weights urgency 1 braking 0.5
    """

    method: Annotated[
        Literal[
            "kinematic",
            "published",
            "ensemble",
            "action_rarity",
            "action_rarity_published",
            "uniform",
            "random_matched",
            "oracle",
        ],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="METHOD"),
    ]
    """How to score."""
    data: Path
    """Scenario set."""
    out: Path
    """Table of scores to write."""
    export: Annotated[tuple[Path, int] | None, tyro.conf.arg(metavar="TOP N")] = None
    """Write the N most critical scenarios, at most one of each recording, as a set with its scores, TOP/scores.npz."""
    all_windows: bool = False
    """Let TOP hold several scenarios of one recording; with --export."""
    weights: dict[str, float] | None = None
    """Weights of the components in place of the method's own: --weights urgency 0.5 braking 0.5."""
    scenario: Annotated[
        str | dict[str, str] | None, tyro.conf.arg(metavar="HOW | NAME HOW [NAME HOW ...]")
    ] = None
    """How steps make a scenario's score: max, mean, std, p99, top10, ...; or by component: urgency max braking p95."""
    again: Path | None = None
    """Table of METHOD for the same set, whose components are taken instead of scoring again."""
    like: Path | None = None
    """Table of the same set whose scores random_matched deals out."""
    seed: int | None = None
    """Of the lot of random_matched, and of an ensemble (default: 0)."""
    config: Path | None = None
    """YAML file with settings of METHOD; any of them can be given behind as --key VALUE or --section.key VALUE."""
    overwrite: bool = False
    """Replace OUT if it is a file, and TOP if it is a scenario set."""


def run(args: Curate, overrides: Sequence[str] = ()) -> int:
    """Score, write the table and the subset, and say how scores and weights lie."""
    from drivax import settings
    from drivax.curation.methods import METHODS, Wanted, check_combination
    from drivax.curation.scores import read_scores, refuse_existing, write_scores
    from drivax.curation.subset import check_top
    from drivax.scenario.store import ScenarioSet

    config = METHODS[args.method].config
    _refuse_idle(args, overrides, config is not None)
    if config is not None:
        seed = [] if args.method != "ensemble" or args.seed is None else ["--seed", str(args.seed)]
        config = settings.load(type(config), args.config or {}, [*overrides, *seed])
    changes = {"weights": args.weights, "scenario": args.scenario}
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.again is None:
        # Before anything is scored: scouts take a while to train.
        check_combination(args.method, config, changes)
    refuse_existing(args.out, args.overwrite)
    data = ScenarioSet.open(args.data)
    if args.export is not None:
        if args.out.resolve().is_relative_to(args.export[0].resolve()):
            raise UsageError("lies where --export writes", file=args.out, cure="choose another --out")
        check_top(data, *args.export, args.overwrite, args.all_windows)
    if args.again is None:
        table = scored(args.method, Wanted(data, args.like, args.seed or 0, config))
    else:
        table = read_scores(args.again, data)
        if table.method != args.method:
            raise UsageError(f"{args.again} is a table of {table.method}", cure=f"say curate {table.method}")
    if changes:
        table = table.combined(replace(table.combination, **changes))
    write_scores(table, args.out, args.overwrite)
    _tell(table, args.out)
    if args.export is not None:
        _export(table, data, *args.export, args.overwrite, args.all_windows)
    return 0


def scored(method: str, wanted: Wanted) -> ScoreTable:
    """Scores a set (:func:`~drivax.curation.methods.curate`), and shows how far that is."""
    from drivax.curation.methods import curate
    from drivax.tracking.progress import Progress

    with Progress("scoring", "scenarios", len(wanted.data)) as bar:

        def training(done: int, total: int) -> None:
            bar.update(0, f"training scouts, {done} of {total} iterations")

        return curate(method, replace(wanted, progress=lambda done, _: bar.update(done), training=training))


def _refuse_idle(args: Curate, overrides: Sequence[str], settable: bool) -> None:
    """Refuses flags that the method, or a table that is taken again, would ignore."""
    again, scored = args.again is not None, args.method
    idle: dict[str, object] = {}
    if again:
        scored = f"{args.again}, which is not scored again,"
        idle["--like"] = args.like
    if again or not settable:
        idle["--config"] = args.config
    if again or args.method not in ("ensemble", "random_matched"):
        idle["--seed"] = args.seed
    if args.all_windows and args.export is None:
        raise UsageError("--all-windows without a subset to choose", cure="pass --export TOP N")
    given = [flag for flag, value in idle.items() if value is not None]
    if again or not settable:
        given += overrides
    if given:
        raise UsageError(f"{scored} has no such setting", cure="leave out " + " ".join(given))
    if args.method == "random_matched" and (args.weights is not None or args.scenario is not None):
        raise UsageError(
            "random_matched deals out finished scores, which have no components",
            cure="give --weights and --scenario to the method that it is to be like",
        )


def _export(
    table: ScoreTable, data: ScenarioSet, top: Path, count: int, overwrite: bool, all_windows: bool
) -> None:
    """Writes the subset, and says where it is and which scenarios it begins with."""
    from drivax.curation.scores import OWN_SCORES, read_scores
    from drivax.curation.subset import write_top
    from drivax.scenario.store import ScenarioSet
    from drivax.tracking.progress import Progress

    with Progress("exporting", "scenarios", count) as bar:
        write_top(table, data, count, top, overwrite, lambda done, _: bar.update(done), all_windows)
    file = top / OWN_SCORES
    own = read_scores(file, ScenarioSet.open(top))
    each = "" if all_windows else ", one of each recording at most"
    print(f"{top}: the {count:,} most critical{each}")
    print(f"{file}: their scores")
    print("  rank  score  scenario")
    for rank, row in enumerate(own.order[:_TOLD], start=1):
        print(f"  {rank:>4}  {own.scenarios[row]:.3f}  {own.scenario_ids[row]}")


def _tell(table: ScoreTable, out: Path) -> None:
    import numpy as np

    from drivax.curation.weights import WeightConfig, draws_of, weights_of

    low, middle, high, most = np.quantile(table.scenarios, (0.05, 0.5, 0.95, 1.0))
    first = table.scenario_ids[table.order[0]]
    print(f"{out}: {len(table.scenario_ids):,} scenarios, {table.method}")
    if "error_rank_correlation" in table.config:
        print(
            f"  scores of steps and errors of the scouts: rank correlation {table.config['error_rank_correlation']:.2f}"
        )
    print(f"  scores: 5 % {low:.3f}, median {middle:.3f}, 95 % {high:.3f}, largest {most:.3f} ({first})")
    for scale in ("step", "scenario"):
        drawn = draws_of(weights_of(table, WeightConfig(), scale), table.drawn)
        print(
            f"  weights by {scale}: effective sample {drawn.effective:.0%} of the steps, "
            f"{drawn.effective_scenarios:.0%} of the scenarios"
        )
        print(
            f"    tilt {drawn.tilt:.2f} (99 % over mean), largest {drawn.largest:.2f}, "
            f"{drawn.concentration:.0%} of draws from 5 % of the steps"
        )
