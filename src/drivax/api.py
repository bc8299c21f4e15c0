"""What users call from Python: load a set, make a simulator, drive a planner, in one line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.results import Results
from drivax.evaluation.run_evaluation import with_metrics
from drivax.evaluation.runner import evaluate_scenarios
from drivax.learning.policies import load_policy
from drivax.learning.policy_traffic import find_traffic
from drivax.planners.catalogue import PLANNERS, as_planner, make_planner
from drivax.planners.planner import Planner
from drivax.plugins import is_dotted
from drivax.scenario.bank.scenario_bank import ScenarioBank, Sizes
from drivax.scenario.schema import Scenario
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.run_folder import run_and_step
from drivax.tracking.zoo import is_policy, zoo


@dataclass(frozen=True)
class Loaded:
    """Scenarios in both forms: as they are stored, and on the device.

    Attributes:
        scenarios: The stored scenarios.
        bank: The same, stacked on the device; an argument of everything that simulates.
        names: ``dataset``, ``scenario_id`` and ``segment`` of each.
        sizes: Of banks in which they are evaluated: those of the whole set, so that a part of it is driven alike.
    """

    scenarios: Sequence[Scenario]
    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]
    sizes: Sizes

    def __len__(self) -> int:
        return len(self.names)


def load(
    data: str | Path | Sequence[Scenario],
    limit: int | None = None,
    *,
    filters: Sequence[str] = (),
    scenarios: Sequence[str | Path] = (),
) -> Loaded:
    """Scenarios of a set, or of your own making, ready to simulate.

    Args:
        data: Folder of a scenario set, or scenarios.
        limit: Only the first so many of those that the others leave.
        filters: Only those of a set for which all of this holds, as ``type=turn_left`` (``scenario.select.selection``).
        scenarios: Only those of a set that are named by their ids, or in files with one id per line.

    Raises:
        DataError: The set is damaged, a name is not in it, or nothing is left.
        UsageError: A filter or the limit cannot be meant.
    """
    if isinstance(data, str | Path):
        stored = ScenarioSet.open(data)
        kept = [stored[row] for row in select_scenarios(stored, filters, scenarios, limit)]
        # Checksums are tested where a scenario is loaded; this only looks at what each record uses.
        sizes = Sizes.used(ScenarioSet.open(data, verify=False))
    elif filters or scenarios:
        raise UsageError("only a scenario set can be filtered", cure="leave out what is not wanted")
    else:
        kept, sizes = list(data[:limit]), Sizes.used(data)
    return Loaded(kept, ScenarioBank.from_scenarios(kept), scenario_names(kept), sizes)


def make_simulator(task: Task | None = None, traffic: str | Traffic = "log") -> Simulator:
    """A simulator of a task (the default one otherwise).

    Args:
        task: Action space, observation, reward and ends.
        traffic: How the others move: ``log``, ``idm``, ``package.module:name``, a trained policy (its run folder or
            ``zoo:NAME``), or a traffic. All but ``log`` may need their bank prepare_bank:
            ``bank = simulator.traffic.bank_data.prepare_bank(simulator.traffic, bank)``.
    """
    return Simulator(task or Task(), _traffic(traffic))


def _traffic(given: str | Traffic) -> Traffic:
    return find_traffic(given) if isinstance(given, str) else given


def evaluate(
    planner: str | Path | Planner | Callable[..., Any], data: str | Path | Loaded, *, task: Task | None = None,
    traffic: str | Traffic = "log", start: Start | None = None, sample: bool = False,
    metrics: Sequence[str] = (), **options: Any,
) -> Results:  # fmt: skip
    """Drives every scenario to the end of its log and measures it; writes nothing.

    Args:
        planner: Name, run folder of a training run (``RUN`` or ``RUN@STEP``), ``zoo:NAME``, or a planner or its class.
        data: Folder of a scenario set, or what :func:`load` returned (a part of a set, scenarios of your own).
        task: Action space and observation of a planner of your own.
        traffic: As of :func:`make_simulator`; it is prepare_bank here.
        start: How episodes begin: as logged by default, or ``simulator.starts.NoisyStart()``.
        sample: Whether a policy, named by its folder, samples its actions rather than acting by the mode.
        metrics: Metrics of your own as ``module:name``, beside all of ours.
        options: ``start_step``, ``seed``, ``batch`` and ``progress`` of ``evaluation.runner.evaluate_scenarios``.
    """
    loaded = data if isinstance(data, Loaded) else load(data, 1)
    if isinstance(planner, str | Path):
        if task is not None:
            raise UsageError("a planner by name brings its own task", cure="leave out task=")
        planner, task = find_planner(str(planner), loaded.bank, sample)
    elif sample:
        raise UsageError("only a policy by name can sample", cure="leave out sample=")
    driver = as_planner(planner, getattr(planner, "__name__", "planner"))
    task = with_metrics(task or Task(), tuple(metrics))
    simulator = Simulator(task, _traffic(traffic), start or LogStart())
    scenarios = data.scenarios if isinstance(data, Loaded) else ScenarioSet.open(data)
    return evaluate_scenarios(simulator, driver, scenarios, sizes=loaded.sizes, **options)


def find_planner(name: str, bank: ScenarioBank, sample: bool = False) -> tuple[Planner, Task]:
    """The planner of a name, run folder or policy of the zoo, and the task that it was made for.

    Raises:
        UsageError: If there is no such planner, folder or policy.
    """
    if name in PLANNERS or (is_dotted(name) and not is_policy(name)):
        return make_planner(name), Task()
    folder, step = run_and_step(name)
    if not is_policy(folder):
        kinds = [*PLANNERS, "package.module:name", "the folder of a training run", *zoo()]
        raise UsageError(f"there is no planner {name!r}", cure=f"use {', '.join(kinds)}")
    return load_policy(folder, bank, step=step, samples=sample)
