"""What users call from Python: load a set, make a simulator, drive a planner, in one line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.results import Results
from drivax.evaluation.runner import evaluate_in
from drivax.learning.policies import load_policy
from drivax.learning.policy_traffic import find_traffic
from drivax.learning.zoo import is_policy, zoo
from drivax.named import is_dotted
from drivax.planners.catalogue import PLANNERS, make_planner
from drivax.planners.planner import Planner
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task


@dataclass(frozen=True)
class Loaded:
    """Scenarios in both forms: as they are stored, and on the device.

    Attributes:
        scenarios: The stored scenarios.
        bank: The same, stacked on the device; an argument of everything that simulates.
        names: ``dataset``, ``scenario_id`` and ``segment`` of each.
    """

    scenarios: Sequence[Scenario]
    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]

    def __len__(self) -> int:
        return len(self.names)


def load(data: str | Path | Sequence[Scenario], limit: int | None = None) -> Loaded:
    """Scenarios of a set, or of your own making, ready to simulate.

    Args:
        data: Folder of a scenario set, or scenarios.
        limit: Only the first so many.
    """
    stored = ScenarioSet.open(data) if isinstance(data, str | Path) else data
    scenarios = [stored[row] for row in range(len(stored) if limit is None else min(limit, len(stored)))]
    return Loaded(scenarios, ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios))


def make_simulator(task: Task | None = None, traffic: str | Traffic = "log") -> Simulator:
    """A simulator of a task (the default one otherwise).

    Args:
        task: Action space, observation, reward and ends.
        traffic: How the others move: ``log``, ``idm``, ``package.module:name``, a trained policy (its run folder or
            ``zoo:NAME``), or a traffic. All but ``log`` may need their bank prepared:
            ``bank = simulator.catalogue.prepared(simulator.traffic, bank)``.
    """
    return Simulator(task or Task(), _traffic(traffic))


def _traffic(given: str | Traffic) -> Traffic:
    return find_traffic(given) if isinstance(given, str) else given


def evaluate(
    planner: str | Path | Planner, data: str | Path | Loaded, *, task: Task | None = None,
    traffic: str | Traffic = "log", start: Start | None = None, **options: Any,
) -> Results:  # fmt: skip
    """Drives every scenario to the end of its log and measures it; writes nothing.

    Args:
        planner: Name, run folder of a training run (``RUN`` or ``RUN@STEP``), ``zoo:NAME``, or a planner.
        data: Folder of a scenario set, or what :func:`load` returned.
        task: Action space and observation of a planner of your own.
        traffic: As of :func:`make_simulator`; it is prepared here.
        start: How episodes begin: as logged by default, or ``simulator.starts.NoisyStart()``.
        options: ``start_step``, ``seed``, ``progress`` of ``evaluation.runner.evaluate``.
    """
    loaded = data if isinstance(data, Loaded) else load(data)
    if isinstance(planner, str | Path):
        if task is not None:
            raise UsageError("a planner by name brings its own task", cure="leave out task=")
        planner, task = find_planner(str(planner), loaded.bank)
    simulator = Simulator(task or Task(), _traffic(traffic), start or LogStart())
    return evaluate_in(simulator, planner, loaded.bank, loaded.names, **options)


def find_planner(name: str, bank: ScenarioBank, sample: bool = False) -> tuple[Planner, Task]:
    """The planner of a name, run folder or policy of the zoo, and the task that it was made for.

    Raises:
        UsageError: If there is no such planner, folder or policy.
    """
    if name in PLANNERS or (is_dotted(name) and not is_policy(name)):
        return make_planner(name), Task()
    folder, _, step = name.partition("@")
    if not is_policy(folder):
        kinds = [*PLANNERS, "package.module:name", "the folder of a training run", *zoo()]
        raise UsageError(f"there is no planner {name!r}", cure=f"use {', '.join(kinds)}")
    if step and not step.isdecimal():
        raise UsageError(f"{step!r} is no step of a checkpoint", cure="write RUN@STEP, as runs/a@100000")
    return load_policy(folder, bank, step=int(step) if step else None, samples=sample)
