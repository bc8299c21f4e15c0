"""The training loop: iterate on the device, log, validate, checkpoint, stop, resume."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from drivax.errors import UsageError
from drivax.learning.algorithm import Judges, LearnerState, training_data
from drivax.learning.config import TrainConfig
from drivax.learning.experience import WeightedSet
from drivax.learning.first_state import first_state, inherited, with_step
from drivax.learning.folders import create_folders, facts, resumed_folders
from drivax.learning.policy_traffic import find_traffic
from drivax.learning.program import Agents, Program
from drivax.learning.training_log import Journal, Preempted, StopSignal
from drivax.learning.validation import Validation, validate
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.tracking.progress import Progress
from drivax.tracking.run_folder import RunFolder


def train(
    config: TrainConfig,
    data: ScenarioSet | WeightedSet,
    out: str | Path,
    *,
    validation: ScenarioSet | None = None,
    resume: bool = False,
    overwrite: bool = False,
    seeds: int = 1,
    say: Callable[[str], None] = lambda line: None,
) -> RunFolder:
    """Trains a policy and writes the run folder: config, metrics, checkpoints of the full state.

    Args:
        config: What to train.
        data: Scenarios to train on; all of them are held on the device. Offline algorithms draw their recorded steps
            by weight where they are a :class:`WeightedSet`, otherwise all that can be learned from alike.
        out: Run folder.
        validation: Scenarios that choose the best checkpoint.
        resume: Continue the run in ``out`` from its newest checkpoint, bit for bit on one CPU device; with the
            configuration and the seeds that it began with.
        overwrite: Replace an existing run folder.
        seeds: How many agents to train in one program, with ``config.seed`` and the following ones; of several each
            has a run folder of its own inside ``out``: ``seed-0``, ``seed-1``, ...
        say: Called with a line about memory, one about networks of another run, and one when an agent stops early.

    Raises:
        UsageError: If ``out`` exists and neither ``resume`` nor ``overwrite`` is given, a resumed run was trained on
            other data or with other weights, weights do not fit the data or the algorithm, or it does not fit the
            device's memory.
        DataError: What it is to begin from is no training run, or its networks do not fit.
        Preempted: If SIGTERM stopped it, after a checkpoint.
    """
    data, weights = (data.scenarios, data.weights) if isinstance(data, WeightedSet) else (data, None)
    out = Path(out)
    folders: list[RunFolder] = []
    if resume:
        config, folders = resumed_folders(data, validation, weights, out, seeds)
    else:
        RunFolder.check(out, overwrite, "training")
        config = with_step(config)
    _refuse(config, validation, seeds)
    numbers = tuple(config.seed + number for number in range(len(folders) or seeds))
    environment = config.environment()
    bank = prepare_bank(environment.simulator.traffic, ScenarioBank.from_scenarios(data))
    held_out = None if validation is None else Validation.of(validation)
    recorded = None if held_out is None else training_data(config.algorithm, environment, held_out.bank)
    learner = config.algorithm.build(environment, bank, config.iterations)
    experience = training_data(config.algorithm, environment, bank, weights)
    program = Program(Agents(learner, numbers), experience, config.devices)
    _account(program, held_out, say)
    # Before any folder is made: they may not fit.
    networks = None if resume else inherited(config.begin_from, program, say)
    folders = folders or create_folders(
        config, data, out, numbers, overwrite, facts(config, validation, weights)
    )
    with contextlib.ExitStack() as stack:
        journals = [stack.enter_context(Journal(folder, config)) for folder in folders]
        _learn(_Run(config, program, journals, held_out, recorded, networks, say))
    return RunFolder.open(out)


def usable_steps(config: TrainConfig, data: ScenarioSet) -> np.ndarray:
    """Which recorded steps, ``[N, T]``, a training by weight would learn from.

    Weights have to be made for these: to have a mean of 1, say, or an effective size, over what is drawn.

    Raises:
        UsageError: The algorithm learns from no recorded steps.
    """
    environment = config.environment()
    bank = prepare_bank(environment.simulator.traffic, ScenarioBank.from_scenarios(data))
    experience = training_data(config.algorithm, environment, bank, np.ones((len(data), bank.steps)))
    return np.asarray(experience.usable)


def _refuse(config: TrainConfig, validation: ScenarioSet | None, seeds: int) -> None:
    """Refuses what cannot be meant, before the long work."""
    if config.patience and validation is None:
        raise UsageError("patience needs scenarios to validate on", cure="pass --validation SET")
    if seeds < 1:
        raise UsageError(f"{seeds} seeds", cure="use 1 or more")


def _account(program: Program, held_out: Validation | None, say: Callable[[str], None]) -> None:
    memory = program.account(None if held_out is None else held_out.bank)
    memory.refuse_too_much()
    say(memory.text())


@dataclass(frozen=True)
class _Run:
    config: TrainConfig
    program: Program
    journals: Sequence[Journal]
    validation: Validation | None
    held_out: Any
    #: Of the run that it begins from; None: not looked for, since a resumed run rarely begins.
    networks: Mapping[str, Any] | None
    say: Callable[[str], None]

    def steps(self, iteration: int) -> int:
        """Environment steps of each agent after so many iterations."""
        return iteration * self.config.algorithm.steps_per_iteration


def _learn(run: _Run) -> None:
    """All iterations that are left."""
    config, program = run.config, run.program
    begin, state = _begin(run)
    with Progress("training", "steps", run.steps(config.iterations)) as progress, StopSignal() as stop:
        progress.update(run.steps(begin))
        for iteration in range(begin + 1, config.iterations + 1):
            if all(journal.over for journal in run.journals):
                break
            began = time.perf_counter()
            state, raw = program.step(state)
            logs = jax.device_get(raw)
            rate = config.algorithm.steps_per_iteration / (time.perf_counter() - began)
            # Asked once, so that every agent has a checkpoint of the same iteration.
            stops = stop.asked and iteration < config.iterations
            rows = [
                logged(program.agents.one(logs, number)) | {"steps_per_second": rate}
                for number in range(len(run.journals))
            ]
            _record(run, iteration, state, rows, stops)
            seen = [row["rollout/success"] for row in rows if "rollout/success" in row]
            progress.update(run.steps(iteration), f"success {sum(seen) / len(seen):.2f}" if seen else "")
            if stops:
                raise Preempted(
                    f"SIGTERM stopped the training after {run.steps(iteration):,} steps",
                    cure="continue it with --resume",
                )


def _begin(run: _Run) -> tuple[int, Any]:
    """Iterations done and the state after them: none, or where the newest checkpoint that all agents have is."""
    program, journals = run.program, run.journals
    learning = [set(journal.checkpoints.steps()) for journal in journals if not journal.over]
    if not learning:
        return run.config.iterations, None
    step = max(set.intersection(*learning), default=None)
    if step is None:
        for journal in journals:
            journal.begin(None)
        networks = run.networks
        if networks is None:
            networks = inherited(run.config.begin_from, program, run.say)
        return 0, first_state(program, networks)
    template = program.agents.shapes_of_one(program.shapes)
    states = []
    for journal in journals:
        # An agent that has stopped early stays where it was; its part of the program runs on for nobody.
        at = journal.newest if journal.over else step
        journal.begin(at)
        states.append(journal.checkpoints.restore(template, at))
    return step // run.config.algorithm.steps_per_iteration, program.state_of(states)


def _record(
    run: _Run, iteration: int, state: LearnerState, rows: list[dict[str, float]], stops: bool
) -> None:
    """Writes what one iteration came to of every agent that still learns."""
    config, agents, done = run.config, run.program.agents, run.steps(iteration)
    last = iteration == config.iterations
    due = last or (config.evaluate_every > 0 and iteration % config.evaluate_every == 0)
    for number, journal in enumerate(run.journals):
        if journal.over:
            continue
        row = rows[number]
        if due and run.validation is not None:
            # The other devices of a run have no part in driving.
            parameters = jax.device_put(agents.one(state.parameters, number), run.program.devices[0])
            planner = agents.learner.planner(parameters, "policy", samples=False)
            row |= validate(planner, run.validation, config.task, find_traffic(config.traffic))
            if isinstance(agents.learner, Judges):
                one = jax.device_put(agents.one(state, number), run.program.devices[0])
                judged = agents.learner.judge(run.held_out, one)
                row |= {f"validation/{name}": value for name, value in judged.items()}
        found = journal.write(done, row)
        if last or due or stops or iteration % config.checkpoint_every == 0:
            journal.save(done, agents.one(state, number), found)
        if journal.over and not last:
            run.say(
                f"seed {agents.seeds[number]}: no better for {config.patience} validations, stopped at {done:,} steps"
            )


def logged(raw: Mapping[str, Any]) -> dict[str, float]:
    """Means to log from the numbers of an iteration.

    A name with ``<name>/n`` beside it is a sum over so many (episodes that define a metric, updates): its mean is
    logged, and nothing where there were none. Sums of ``rollout/reward/*`` are over the steps. What else there is
    is logged as it is.
    """
    values = {name: float(value) for name, value in raw.items() if not name.endswith("/n")}
    steps = values.pop("rollout/steps", 0.0)
    row = {}
    for name, value in values.items():
        if name.startswith("rollout/reward/"):
            name, count = name.removeprefix("rollout/"), steps
        else:
            count = float(raw.get(f"{name}/n", 1.0))
        if count > 0:
            row[name] = value / count
    return row
