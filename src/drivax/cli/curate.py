"""``drivax curate``: criticality scores of a scenario set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from drivax.curation.methods import MethodInputs, Request, check_combination, curate, find_method
from drivax.errors import UsageError
from drivax.escaping import escape_controls, show
from drivax.files import check_output

if TYPE_CHECKING:
    from drivax.curation.scores import ScoreTable
    from drivax.scenario.store import ScenarioSet

#: Number of the most critical scenarios to print.
_PRINTED_SCENARIOS = 10


@dataclass(frozen=True, kw_only=True)
class Curate(MethodInputs):
    """Score how critical every scenario and step of a set is.

    kinematic: time to collision, post-encroachment time, required braking, volatility and position of the logged
    driver.

    published: the published kinematic heuristic, for comparison.

    ensemble: disagreement of behaviour cloning policies, trained on different recordings.

    action_rarity: inverse density of the logged driver's action (action_rarity_published: with the published bins).

    query: 1 at steps where a condition holds: --where "cut_in < 20 and speed > 10".

    novelty: distance to the nearest steps of other recordings, in an embedding.

    failures: failures and near misses of planners in evaluations of the set (--runs).

    mixture: the scores of several --tables. random_matched: those of --like, permuted. uniform: equal scores.

    oracle: labels of rare events in the built-in world; oracle_critical: also all steps of recordings that begin with a
    conflict.

    package.module:name: your own function or dataclass.

    Example: drivax curate kinematic --data sets/world --out scores.npz --export sets/critical 500

    Example: drivax curate ensemble --data sets/world --out scores.npz --cloning.loss likelihood

    Example: drivax curate kinematic --data sets/world --out sooner.npz --urgent_s 2

    Example: drivax curate kinematic --data sets/world --out near.npz --again scores.npz --weights urgency 1 braking 0.5
    """

    method: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="METHOD")]
    """Name of the method."""
    data: Path
    """Scenario set."""
    out: Path
    """Table of scores to write."""
    export: Annotated[tuple[Path, int] | None, tyro.conf.arg(metavar="TOP N")] = None
    """Write the N most critical scenarios, at most one per recording, as the set TOP with scores.npz."""
    diverse: bool = False
    """Choose for TOP those of the 4 N most critical scenarios that differ most (k-center), without duplicates."""
    all_windows: bool = False
    """Allow several scenarios of one recording in TOP; with --export."""
    weights: dict[str, float] | None = None
    """Weights of the components instead of the method's: --weights urgency 0.5 braking 0.5."""
    scenario: Annotated[
        str | dict[str, str] | None, tyro.conf.arg(metavar="HOW | NAME HOW [NAME HOW ...]")
    ] = None
    """Aggregation over steps: max, mean, std, p99, top10, ...; or one per component: urgency max braking p95."""
    again: Path | None = None
    """Scores of the same set and METHOD, to combine their components again without scoring."""
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    """Run code of this module of yours that a saved ensemble names; repeat it to trust several."""
    seed: int | None = None
    """Seed of random_matched and of an ensemble (default: 0)."""
    config: Path | None = None
    """YAML file with settings of METHOD; override them with --key VALUE or --section.key VALUE."""
    overwrite: bool = False
    """Replace OUT if it is a file, and TOP if it is a scenario set."""


def run(args: Curate, overrides: Sequence[str] = ()) -> int:
    """Score, write the table and the subset, and print statistics of scores and weights."""
    from drivax import settings
    from drivax.curation.scores import check_top, read_scores, write_scores
    from drivax.scenario.store import ScenarioSet

    config = find_method(args.method).config
    _check_flags(args, overrides, is_dataclass(config))
    if is_dataclass(config):
        seed = ["--seed", str(args.seed)] if args.method == "ensemble" and args.seed is not None else []
        config = settings.load(type(config), args.config or {}, [*overrides, *seed])
    changes = {"weights": args.weights, "scenario": args.scenario}
    changes = {name: value for name, value in changes.items() if value is not None}
    if args.again is None:
        # Check before scoring: training an ensemble takes minutes.
        check_combination(args.method, config, changes)
    check_output(args.out, args.overwrite)
    data = ScenarioSet.open(args.data)
    if args.export is not None:
        if args.out.resolve().is_relative_to(args.export[0].resolve()):
            raise UsageError(
                "output is inside the --export folder", file=args.out, cure="choose another --out"
            )
        check_top(data, *args.export, args.overwrite, args.all_windows)
    source = args.members or args.actions
    has_source = source is not None and source.exists()
    if args.again is None:
        inputs = {field.name: getattr(args, field.name) for field in fields(MethodInputs)}
        request = Request(data, args.seed or 0, config, trust=args.trust_code, **inputs)
        table = score_with_progress(args.method, request)
    else:
        table = read_scores(args.again, data)
        if table.method != args.method:
            raise UsageError(f"{args.again} is a table of {table.method}", cure=f"use curate {table.method}")
    if changes:
        table = table.recombine(replace(table.combination, **changes))
    write_scores(table, args.out, args.overwrite)
    _print_statistics(table, args.out)
    if source is not None and args.again is None:
        show(f"  {'scored by' if has_source else 'wrote'} {source}")
    if args.export is not None:
        embedding = _embedding(args, data, table) if args.diverse else None
        _export(table, data, *args.export, args.overwrite, args.all_windows, embedding)
    return 0


def score_with_progress(method: str, request: Request) -> ScoreTable:
    """Score a set (:func:`~drivax.curation.methods.curate`) with a progress bar."""
    from drivax.tracking.progress import Progress

    with Progress("scoring", "scenarios", len(request.data)) as bar:

        def training(done: int, total: int) -> None:
            """Show the training that precedes the scores of an ensemble."""
            bar.update(0, f"training the ensemble, {done} of {total} iterations")

        return curate(method, replace(request, progress=lambda done, _: bar.update(done), training=training))


def _check_flags(args: Curate, overrides: Sequence[str], has_settings: bool) -> None:
    """Refuse flags that the method or --again would ignore."""
    from drivax.curation.rarity import KernelRarity, PublishedRarity

    again, subject = args.again is not None, args.method
    ignored_values: dict[str, object] = {}
    is_rarity = args.method in (KernelRarity.method, PublishedRarity.method)
    source = args.members if args.method == "ensemble" else args.actions if is_rarity else None
    is_saved = source is not None and source.exists()
    if is_saved:
        subject, has_settings = f"{source}, which exists", False
    if again or not is_rarity:
        ignored_values["--actions"] = args.actions
    if not args.diverse and (again or args.method not in ("ensemble", "novelty")):
        ignored_values["--members"] = args.members
    if again:
        subject = f"{args.again}, which is not scored again"
        ignored_values["--like"] = args.like
        ignored_values["--tables"] = args.tables or None
        ignored_values["--runs"] = args.runs or None
    if again or not has_settings:
        ignored_values["--config"] = args.config
    if again or is_saved or args.method not in ("ensemble", "random_matched"):
        ignored_values["--seed"] = args.seed
    if again or args.method in ("random_matched", "mixture"):
        ignored_values["--egos"] = None if args.egos == "recorded" else args.egos
    for flag, is_given in (("--all-windows", args.all_windows), ("--diverse", args.diverse)):
        if is_given and args.export is None:
            raise UsageError(f"{flag} without a subset to choose", cure="pass --export TOP N")
    ignored_flags = [flag for flag, value in ignored_values.items() if value is not None]
    if again or not has_settings:
        ignored_flags += overrides
    if ignored_flags:
        raise UsageError(f"unknown setting for {subject}", cure="leave out " + " ".join(ignored_flags))
    if args.method == "random_matched" and (args.weights is not None or args.scenario is not None):
        raise UsageError(
            "random_matched permutes finished scores, which have no components",
            cure="pass --weights and --scenario to the method that it matches",
        )


def _embedding(args: Curate, data: ScenarioSet, table: ScoreTable) -> Any:
    """Return an embedding of every scenario of the set."""
    from drivax.curation.methods import embedding_of
    from drivax.curation.novelty import NoveltyConfig, scenario_embeddings

    egos = "recorded" if table.egos == 1 else "moving"
    request = Request(data, egos=egos, members=args.members, trust=args.trust_code)
    return scenario_embeddings(embedding_of(NoveltyConfig(), request), data, table.valid)


def _export(
    table: ScoreTable,
    data: ScenarioSet,
    top: Path,
    count: int,
    overwrite: bool,
    all_windows: bool,
    embedding: Any,
) -> None:
    """Write the subset, and print its path and its first scenarios."""
    from drivax.curation.scores import OWN_SCORES, read_scores, write_top
    from drivax.scenario.store import ScenarioSet
    from drivax.tracking.progress import Progress

    with Progress("exporting", "scenarios", count) as bar:
        write_top(
            table, data, count, top, overwrite, lambda done, _: bar.update(done), all_windows, embedding
        )
    file = top / OWN_SCORES
    subset_scores = read_scores(file, ScenarioSet.open(top))
    limit = "" if all_windows else ", at most one per recording"
    kind = "most critical" if embedding is None else "different critical"
    show(f"{top}: the {len(subset_scores.scenario_ids):,} {kind} scenarios{limit}")
    show(f"{file}: their scores")
    show("  rank  score  scenario")
    for rank, row in enumerate(subset_scores.order[:_PRINTED_SCENARIOS], start=1):
        name = escape_controls(subset_scores.scenario_ids[row])
        show(f"  {rank:>4}  {subset_scores.scenarios[row]:.3f}  {name}")


def _print_statistics(table: ScoreTable, out: Path) -> None:
    """Print statistics of the scores, and of the sampling weights by step and by scenario."""
    import numpy as np

    from drivax.curation.weights import WeightConfig, draw_statistics, sampling_weights

    low, median, high, maximum = np.quantile(table.scenarios, (0.05, 0.5, 0.95, 1.0))
    first = escape_controls(table.scenario_ids[table.order[0]])
    egos = "" if table.egos == 1 else f" ({int(table.valid.any(axis=1).sum()):,} egos in all)"
    show(f"{out}: {len(table.scenario_ids):,} scenarios{egos}, {table.method}")
    if "error_rank_correlation" in table.config:
        show(
            f"  rank correlation of scores and errors over steps: {table.config['error_rank_correlation']:.2f}"
        )
    show(f"  scores: 5 % {low:.3f}, median {median:.3f}, 95 % {high:.3f}, largest {maximum:.3f} ({first})")
    for scale in ("step", "scenario"):
        draws = draw_statistics(sampling_weights(table, WeightConfig(), scale), table.drawable, table.egos)
        show(
            f"  weights by {scale}: effective sample {draws.effective:.0%} of the steps, "
            f"{draws.effective_scenarios:.0%} of the scenarios"
        )
        show(
            f"    tilt {draws.tilt:.2f} (99 % over mean), largest {draws.largest:.2f}, "
            f"{draws.concentration:.0%} of draws from 5 % of the steps"
        )
