"""``drivax export``: write a scenario set, a part of it, or recorded episodes in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax.cli import record_of
from drivax.datasets.export import writer
from drivax.errors import UsageError
from drivax.escaping import show

#: Formats of episodes; the other formats are for scenario sets.
_EPISODE_FORMATS = ("npz", "minari")


@dataclass(frozen=True, kw_only=True)
class Export(writer.Export):
    """Write a scenario set, a part of it, or recorded episodes in another format.

    set: a scenario set with the selected records, bit for bit.

    tfexample: TFRecord shards of WOMD tf.Examples with path_samples, for Waymax and V-Max.

    gpudrive: one JSON file per scenario.

    npz, minari: the transitions of the episodes in a folder of drivax record or drivax evaluate, as one file with the
    names of D4RL, or as a Minari data set. --task.KEY VALUE changes observation and reward.

    Example: drivax export sets/womd sets/turns --filter type=turn_left --filter lights=yes

    Example: drivax export episodes/mixed mixed.npz --format npz --task.rewards.preset completion
    """

    set: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SET|EPISODES")]
    """Scenario set or episodes to read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder or file to write."""
    format: Literal["set", "tfexample", "gpudrive", "npz", "minari"] = "set"
    """Format to write."""
    data: Path | None = None
    """Scenario set of the episodes, if it has moved."""
    filters: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="filter", metavar="NAME=VALUE")
    ] = ()


def run(args: Export, overrides: Sequence[str] = ()) -> int:
    """Export, and print the number of elements that did not fit the format."""
    from drivax.files import count_text
    from drivax.tracking.progress import Progress

    if args.format in _EPISODE_FORMATS:
        return _export_episodes(args, overrides)
    if overrides or args.data is not None:
        option = overrides[0] if overrides else "--data"
        cure = f"leave it out, or choose one of {', '.join(_EPISODE_FORMATS)}"
        raise UsageError(f"{option} is not for the format {args.format}", cure=cure)
    options = record_of(writer.Export, args)
    with Progress("exporting", "scenarios") as bar:
        result = writer.export(args.set, args.out, options, lambda done, total: bar.update(done, "", total))
    lost = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in sorted(result.lost.items()))
    content = f"{count_text(result.scenarios, 'scenario')} in {count_text(result.files, 'file')}"
    show(f"{result.path}: {content}" + (f"; no room for {lost}" if lost else ""))
    return 0


def _export_episodes(args: Export, overrides: Sequence[str]) -> int:
    """Export recorded episodes, and print their numbers."""
    from drivax.api import as_traffic
    from drivax.evaluation.episode_table import EpisodeTable
    from drivax.evaluation.runner import EvaluationConfig
    from drivax.files import check_output, count_text
    from drivax.learning.driving import Driving
    from drivax.learning.recorded_episodes import minari_folder, observe_episodes, write_npz
    from drivax.learning.training_set import (
        episode_folders,
        prepare_episodes,
        read_episodes,
        recorded_environment,
    )
    from drivax.scenario.bank.scenario_bank import ScenarioBank
    from drivax.simulator.simulator import Simulator
    from drivax.tracking.run_folder import RunFolder

    for field in fields(writer.Export):
        if field.name not in ("format", "overwrite") and getattr(args, field.name) != field.default:
            option = "--filter" if field.name == "filters" else f"--{field.name.replace('_', '-')}"
            raise UsageError(f"{option} is for scenario sets", cure=f"leave out {option}")
    check_output(args.out, args.overwrite, folder=args.format == "minari")
    if args.out.is_dir() and minari_folder(args.out) is None:
        raise UsageError("is not a Minari data set", file=args.out, cure="choose another OUT")
    folder = episode_folders(args.set)[0]
    scenarios = EpisodeTable.read(folder).open_set(args.data)
    config = RunFolder.open(folder).config(EvaluationConfig, overrides)
    environment = Driving(Simulator(config.task, as_traffic(config.traffic)))
    tables = read_episodes([args.set], scenarios, config.task, config.traffic)
    bank = environment.prepare(ScenarioBank.from_scenarios(scenarios))
    environment = recorded_environment(environment, tables)
    recorded = prepare_episodes(environment, bank, scenarios, tables)
    if recorded is None:
        raise UsageError("contains no episodes", file=args.set, cure="record some: drivax record")
    episodes = observe_episodes(environment, recorded)
    if args.format == "npz":
        count, steps = write_npz(args.out, episodes)
    else:
        from drivax.adapters.minari import write_minari

        count, steps = write_minari(args.out, config.task, episodes)
    show(f"{args.out}: {count_text(count, 'episode')}, {count_text(steps, 'transition')}")
    return 0
