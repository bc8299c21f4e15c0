"""``drivax train``: train a planner from a configuration file."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from drivax import settings
from drivax.curation.scores import ScoreTable, read_scores
from drivax.curation.weights import WeightConfig, sampling_weights
from drivax.errors import UsageError
from drivax.escaping import show
from drivax.files import parse_bytes
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Egos
from drivax.learning.loop import train, usable_steps
from drivax.learning.program import use_all_cores, widen_pool
from drivax.learning.recorded_episodes import minari_folder
from drivax.learning.training_set import TrainingSet, read_episodes
from drivax.scenario.store import ScenarioSet

if TYPE_CHECKING:
    from drivax.studies.definition import Arm

    ArmName = str
else:
    # Read without `load_study`, which imports all of curation.
    _LONGTAIL = settings.parse_yaml(settings.preset("studies/longtail").read_text("utf-8"))
    ArmName = tyro.extras.literal_type_from_choices(_LONGTAIL["arms"])


@dataclass(frozen=True)
class Train:
    """Train a policy: online, by imitation, or offline from logged steps.

    SIGTERM writes a checkpoint and ends the run; --resume continues it.

    CONFIG is the name of a preset or a YAML file; override its settings with --section.key VALUE.

    Example: drivax train demo --data sets/train --out runs/ppo --algorithm.learning_rate 1e-3

    Example: drivax train ppo --data sets/egos --out runs/all --egos moving

    Example: drivax train ppo --data sets/womd --memory 2GB --out runs/ppo

    Example: drivax train offline/cql --data sets/train --arm heuristic --out runs/cql-heuristic

    Example: drivax train ppo --data sets/train --scores scores.npz --scale scenario --out runs/ppo-critical

    Example: drivax train offline/iql --data sets/train --episodes episodes/mixed --out runs/iql-mixed
    """

    config: tyro.conf.Positional[str]
    """Name of a preset (demo), or a YAML file: FILE.yaml or ./FILE."""
    data: Path
    """Scenario set to train on."""
    out: Path
    """Run folder to write."""
    validation: Annotated[str, tyro.conf.arg(metavar="SET|none")] = "held_out"
    """Scenario set for the choice of the best checkpoint. By default, whole recordings of DATA are held out: at most a
    tenth of its scenarios and 256, or the smallest of several recordings if none fits; `none` trains on all."""
    episodes: tuple[Path, ...] = ()
    """Episodes to learn from instead of the logs, by bc and offline algorithms: folders of drivax record or runs of
    drivax evaluate, on DATA, or a Minari data set."""
    scores: Path | None = None
    """Scores of DATA by drivax curate. bc, offline algorithms and sac with demonstrations draw logged steps by them,
    others the scenarios in which episodes begin."""
    scale: Literal["step", "scenario"] | None = None
    """Weigh single steps (the default) or whole scenarios; with --scores."""
    arm: Annotated[ArmName | None, tyro.conf.arg(aliases=["--agent"])] = None
    """Curate like this arm of the long-tail study: scores DATA first, unless --scores is given."""
    weighting: WeightConfig = field(default_factory=WeightConfig)
    """Conversion of scores to weights; with --scores or --arm."""
    seeds: int = 1
    """Number of consecutive seeds to train in one program; each of several seeds has a folder in OUT."""
    filters: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="filter", metavar="NAME=VALUE")
    ] = ()
    """Only scenarios of DATA with this property (NAME=A|B, NAME!=A, NAME>=N); can be repeated."""
    memory: str | None = None
    """Memory of a device for scenarios, like 2GB: a part of DATA is resident, and exchanged while training goes on. By
    default, all of DATA is."""
    begin_from: Annotated[str | None, tyro.conf.arg(name="from", metavar="RUN[@STEP]")] = None
    """Start from the networks of another run, with a new replay buffer, optimisers and environments."""
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    """Run code of this module of yours that the run to resume, or a policy in the traffic, names; repeat it to trust
    several."""
    resume: bool = False
    """Continue the run in OUT from its newest checkpoint."""
    overwrite: bool = False
    """Replace OUT if it is a run folder."""


def run(args: Train, overrides: Sequence[str] = ()) -> int:
    """Train, then print the run folder."""
    flags = [*overrides, *([] if args.begin_from is None else ["--from", args.begin_from])]
    flags += [word for text in args.filters for word in ("--filter", text)]
    if args.memory is not None:
        flags += ["--memory", args.memory]
    if args.resume and flags:
        raise UsageError("a resumed run keeps its configuration", cure="leave out " + " ".join(flags))
    if args.seeds > 1 or args.resume:
        widen_pool()
    use_all_cores()
    config = settings.load(TrainConfig, args.config, list(overrides))
    if args.begin_from is not None:
        config = replace(config, begin_from=args.begin_from)
    if args.filters:
        config = replace(config, filters=(*config.filters, *args.filters))
    memory = None if args.memory is None else parse_bytes(args.memory)
    folder = train(
        config,
        _data(args, config),
        args.out,
        validation=_validation(args.validation),
        resume=args.resume,
        overwrite=args.overwrite,
        seeds=args.seeds,
        memory=memory,
        log=lambda line: show(line, sys.stderr),
        trust=args.trust_code,
    )
    show(f"wrote {folder.path}")
    return 0


def _validation(name: str) -> ScenarioSet | Literal["held_out"] | None:
    """Return the validation data that a name stands for: ``held_out``, None, or a scenario set."""
    if name == "held_out":
        return name
    return None if name == "none" else ScenarioSet.open(name)


def _data(args: Train, config: TrainConfig) -> TrainingSet:
    """Return the training set, with recorded episodes if given, weighted if scores or an arm are given."""
    data = ScenarioSet.open(args.data)
    traffic = config.traffic if isinstance(config.traffic, str) else "mixed"
    stored = [path for path in args.episodes if minari_folder(path) is not None]
    if len(stored) and len(args.episodes) > 1:
        raise UsageError("a Minari data set cannot be combined", file=stored[0], cure="pass it alone")
    if stored:
        from drivax.adapters.minari import read_minari

        training = TrainingSet(data, episodes=read_minari(stored[0]))
    else:
        training = TrainingSet(data, episodes=read_episodes(args.episodes, data, config.task, traffic))
    if args.arm is not None:
        return _arm_data(args, args.arm, config, training)
    if args.scores is not None:
        table = read_scores(args.scores, data)
        usable = usable_steps(config, training, args.trust_code)
        return replace(
            training, weights=sampling_weights(table, args.weighting, args.scale or "step", usable)
        )
    if args.weighting != WeightConfig():
        raise UsageError("--weighting without scores to weight", cure="pass --scores or --arm")
    if args.scale is not None:
        raise UsageError("--scale without scores to weight", cure="pass --scores")
    return training


def _arm_data(args: Train, name: str, config: TrainConfig, training: TrainingSet) -> TrainingSet:
    """Return the training set with the weights of an arm of the long-tail study."""
    from drivax.studies.definition import load_study

    arm = load_study("longtail").arms[name]
    _check_arm(args, arm, config)
    usable, data = usable_steps(config, training, args.trust_code), training.scenarios
    weights = arm.weigh(data, partial(_table, args, config.egos, data), args.weighting, usable, config.seed)
    return replace(training, weights=weights)


def _check_arm(args: Train, arm: Arm, config: TrainConfig) -> None:
    """Refuse an algorithm other than the arm's, and flags that the arm ignores."""
    algorithm, arm_algorithm = _algorithm(config), _algorithm(settings.load(TrainConfig, arm.preset))
    if algorithm != arm_algorithm:
        problem = f"arm {args.arm} is trained by {arm_algorithm}, not {algorithm}"
        raise UsageError(problem, cure=f"use {arm.preset}")
    if args.scale is not None:
        raise UsageError(
            f"arm {args.arm} has its own scale", cure="leave out --scale, or choose another --arm"
        )
    if arm.weights is not None and args.weighting != WeightConfig():
        raise UsageError(f"arm {args.arm} has its own weights", cure="leave out --weighting")
    if arm.permuted and args.seeds > 1:
        raise UsageError(
            f"{args.seeds} seeds of {args.arm} in one program would share one permutation",
            cure="train each seed separately: --seeds 1 --seed NUMBER",
        )


def _algorithm(config: TrainConfig) -> str:
    """Return the name of the algorithm, ``with imitation`` if it has an imitation loss."""
    imitates = getattr(config.algorithm, "imitation", 0.0) > 0.0
    return settings.kind_of(type(config.algorithm)) + (" with imitation" if imitates else "")


def _table(args: Train, egos: Egos, data: ScenarioSet, method: str) -> ScoreTable:
    """Return the scores of an arm's method, read from --scores if given."""
    from drivax.cli.curate import score_with_progress
    from drivax.curation.methods import Request, check_current

    if args.scores is None:
        return score_with_progress(method, Request(data, egos=egos))
    table = read_scores(args.scores, data)
    # `Arm.weigh` refuses scores of another method.
    if table.method == method:
        check_current(table, file=args.scores)
    return table
