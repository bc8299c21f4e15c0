"""Functions of the Python interface: load, simulate, evaluate, generate, convert, compare and curate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

# Packages import their modules on first use, so that a command loads no more than it needs.
from drivax import curation, datasets, learning, synthetic
from drivax.errors import UsageError
from drivax.evaluation import runner
from drivax.evaluation.audit import audit, scenario_names
from drivax.evaluation.comparison import Comparison, ComparisonPlan
from drivax.evaluation.comparison import compare as compare_evaluations
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import with_metrics
from drivax.planners.catalogue import PLANNERS, as_planner, default_task, make_planner
from drivax.planners.planner import Planner
from drivax.plugins import is_dotted
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import Scenario
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet
from drivax.seal import note_edits
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import Start
from drivax.simulator.traffic.reactive import TRAFFIC, make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.run_folder import is_policy, run_and_step, zoo


@dataclass(frozen=True)
class Loaded:
    """Stored scenarios, and the same scenarios as a bank on the device.

    Attributes:
        scenarios: The stored scenarios.
        bank: The scenarios stacked on the device, an argument of all simulation functions.
        names: ``dataset``, ``scenario_id`` and ``segment`` of each scenario.
        sizes: Bank sizes of the whole set, so that its scenarios give the same results in any subset, bit for bit.
    """

    scenarios: Sequence[Scenario]
    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]
    sizes: Sizes

    def __len__(self) -> int:
        return len(self.names)


def load(
    data: str | Path | Sequence[Scenario], limit: int | None = None, *, filters: Sequence[str] = (),
    scenarios: Sequence[str | Path] = (),
) -> Loaded:  # fmt: skip
    """Load scenarios of a set, or your own scenarios, for simulation.

    Args:
        data: Folder of a scenario set, or scenarios.
        limit: Maximum number of scenarios, after the other options.
        filters: Conditions on scenarios of a set, for example ``type=turn_left`` (``scenario.select.selection``).
        scenarios: Ids of scenarios of a set, or files with one id per line.

    Raises:
        DataError: The set is damaged, an id is not in it, or no scenario is left.
        UsageError: A filter or the limit is invalid.
    """
    if limit is not None and limit < 1:
        raise UsageError(f"a limit of {limit} leaves no scenario", cure="use 1 or more")
    if isinstance(data, str | Path):
        scenario_set = ScenarioSet.open(data)
        selection = scenario_set.take(select_scenarios(scenario_set, filters, scenarios, limit))
        sizes = scenario_set.sizes
    elif filters or scenarios:
        raise UsageError("only a scenario set can be filtered", cure="leave out filters= and scenarios=")
    else:
        selection, sizes = list(data[:limit]), Sizes.used(data)
    return Loaded(selection, ScenarioBank.from_scenarios(selection), scenario_names(selection), sizes)


def make_simulator(
    task: Task | None = None, traffic: str | Traffic = "log", *, trust: Sequence[str] = ()
) -> Simulator:
    """Make a simulator.

    Args:
        task: Action space, observation, reward and termination; the default task if None.
        traffic: Traffic model: ``log``, ``idm``, ``package.module:name``, a trained policy (its run folder or
            ``zoo:NAME``), or a traffic object. All but ``log`` may need a bank that
            :func:`drivax.simulator.traffic.bank_data.prepare_bank` prepares for the simulator's ``traffic``.
        trust: Modules outside drivax whose code the policy may name.
    """
    return Simulator(task or Task(), as_traffic(traffic, trust))


def as_traffic(traffic: str | Traffic, trust: Sequence[str] = ()) -> Traffic:
    """Return the traffic model of a name, as in :func:`make_simulator`; a traffic object is returned unchanged."""
    if not isinstance(traffic, str):
        return traffic
    return make_traffic(traffic) if traffic in TRAFFIC else learning.find_traffic(traffic, trust)


@note_edits()
def evaluate(
    planner: str | Path | Planner | Callable[..., Any], data: str | Path | Loaded, *, task: Task | None = None,
    traffic: str | Traffic = "log", start: Start | None = None, sample: bool = False,
    metrics: Sequence[str] = (), trust: Sequence[str] = (), **options: Any,
) -> EpisodeTable:  # fmt: skip
    """Evaluate a planner, by name or as an object, on every scenario, without writing files.

    Args:
        planner: Name, run folder of a training (``RUN`` or ``RUN@STEP``), ``zoo:NAME``, or a planner or its class.
        data: Folder of a scenario set, or scenarios from :func:`load`.
        task: Action space, observation and reward; a trained policy has its own.
        traffic: As for :func:`make_simulator`; the bank is prepared for it.
        start: Start of the episodes: as logged by default, or ``simulator.starts.NoisyStart()``.
        sample: Whether a trained policy samples its actions instead of taking the mode; not for other planners.
        metrics: User-defined metrics as ``module:name``, in addition to all built-in ones.
        trust: Modules outside drivax whose code trained policies, as planner or traffic, may name.
        options: ``start_step``, ``seed``, ``batch`` and ``progress`` of :class:`drivax.evaluation.runner.Options`.
    """
    loaded = data if isinstance(data, Loaded) else load(data, 1)
    if isinstance(planner, str | Path):
        # A Path never means a built-in planner of the same name.
        name = planner if isinstance(planner, str) else str(planner.absolute())
        planner, task = find_planner(name, loaded.bank, sample, task, trust)
    elif sample:
        raise UsageError("only a trained policy by name can sample", cure="leave out sample=")
    planner = as_planner(planner, getattr(planner, "__name__", "planner"))
    return runner.evaluate(
        planner,
        data.scenarios if isinstance(data, Loaded) else ScenarioSet.open(data),
        task=with_metrics(task or default_task(planner), tuple(metrics)),
        traffic=as_traffic(traffic, trust),
        start=start,
        sizes=loaded.sizes,
        **options,
    )


def find_planner(
    name: str, bank: ScenarioBank, sample: bool = False, task: Task | None = None, trust: Sequence[str] = ()
) -> tuple[Planner, Task]:
    """Return a planner by name, run folder or zoo policy, with its task.

    Args:
        name: Name, ``module:name``, run folder (``RUN`` or ``RUN@STEP``) or ``zoo:NAME``.
        bank: Scenarios of the evaluation, which determine the shapes of a policy.
        sample: Whether a trained policy samples its actions; not for other planners.
        task: Task of a named planner; None for the default task with the planner's own action space.
        trust: Modules outside drivax whose code a trained policy may name.

    Raises:
        UsageError: Unknown planner, folder or policy, a task for a trained policy, ``sample`` for another planner, or
            code that is not trusted.
        DataError: The folder is not a run, or is damaged.
    """
    if name in PLANNERS or is_dotted(name):
        if sample:
            problem = f"{name!r} is not a trained policy, so it cannot sample"
            raise UsageError(problem, cure="leave out --sample (sample=)")
        planner = make_planner(name, task and task.actions)
        return planner, task or default_task(planner)
    folder, step = run_and_step(name)
    if not is_policy(folder, PLANNERS):
        kinds = [*PLANNERS, "package.module:name", "the folder of a training run", *zoo()]
        raise UsageError(f"unknown planner {name!r}", cure=f"use {', '.join(kinds)}")
    if task is not None:
        raise UsageError(f"trained policy {name!r} has its own task", cure="leave out --task (task=)")
    return learning.load_policy(folder, bank, step=step, samples=sample, trust=trust)


def generate(
    out: str | Path, scenarios: int = 256, seed: int = 0, *, options: synthetic.Generation | None = None
) -> ScenarioSet:
    """Generate, audit and open a scenario set of the built-in world.

    Args:
        out: Folder to write.
        scenarios: Number of scenarios.
        seed: Scenario ``i`` of a seed is the same in every set with the same options.
        options: World, workers, capacity, length, egos, and whether to overwrite ``out``.

    Raises:
        UsageError: ``out`` exists without ``options.overwrite``, or an option is invalid.
    """
    from drivax.synthetic.generate import generate as generate_set

    return ScenarioSet.open(generate_set(out, scenarios, seed, options, audit=audit).path)


def convert(src: str | Path, out: str | Path, **options: Any) -> datasets.Converted:
    """Convert recordings of a public data set to a scenario set, and audit it.

    Args:
        src: File, or folder to search to any depth.
        out: Folder to write.
        options: Fields of :class:`drivax.datasets.Conversion`.

    Raises:
        DataError: ``src`` has no file of a known format.
        UsageError: ``out`` exists, an option is invalid, or a package is missing.
    """
    return datasets.convert(src, out, datasets.Conversion(**options), audit=audit)


@note_edits()
def compare(
    a: str | Path, b: str | Path, plan: ComparisonPlan | None = None, data: Path | None = None,
    **settings: Any,
) -> Comparison:  # fmt: skip
    """Compare two planners by their evaluations.

    Args:
        a: Run folder of ``drivax evaluate``, or a folder with one such run per seed.
        b: The other run.
        plan: Metrics and decision rule; ``a`` and ``b`` replace its runs.
        data: Path of the scenario set, for a stratified split, if it has moved.
        settings: Fields of the plan to change, for example ``primary="success"``.

    Raises:
        DataError: A run folder is missing or damaged.
        UsageError: The evaluations cannot be compared, or a setting is invalid.
    """
    plan = replace(plan or ComparisonPlan(), a=Path(a), b=Path(b), **settings)
    first, second = (EpisodeTable.read_seeds(Path(run)) for run in (a, b))
    entries = first[0].open_set(data).entries if plan.split == "stratified" else ()
    return compare_evaluations(plan, first, second, entries)


@note_edits()
def curate(method: str, data: str | Path | ScenarioSet, **options: Any) -> curation.ScoreTable:
    """Score how critical each step and scenario of a set is.

    Args:
        method: Name of a method, for example ``kinematic``.
        data: The set, or its folder.
        options: Fields of :class:`drivax.curation.Request`: ``config``, ``seed``, ``like``, ``egos``,
            ``progress``, ``training``.

    Raises:
        DataError: The method cannot score this set.
        UsageError: Unknown method or invalid settings.
    """
    scenarios = data if isinstance(data, ScenarioSet) else ScenarioSet.open(data)
    return curation.curate(method, curation.Request(scenarios, **options))
