"""The training loop: iterate on the device, log, validate, write checkpoints, stop, resume, fine-tune."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.memory import report_out_of_memory
from drivax.files import explain_full_disk, inside
from drivax.learning.algorithm import Agent, HasCritics, HeldOutMetrics, LearnerState, training_data
from drivax.learning.config import TrainConfig
from drivax.learning.curriculum import mean_rollout
from drivax.learning.driving import Driving, count_egos
from drivax.learning.experience import check_weights
from drivax.learning.mixture import Mixture, training_environment
from drivax.learning.policies import PretrainedRun, find_traffic, initial_state, pretrained_networks
from drivax.learning.program import Program, Seeds, former_devices, warn_of_other_bits
from drivax.learning.recorded_episodes import RecordedDriving, StoredEpisodes
from drivax.learning.residency import Residents
from drivax.learning.training_log import (
    DivergenceError,
    Preempted,
    StopSignal,
    TrainingLog,
    Validation,
    nonfinite_leaf,
    nonfinite_log,
    validate,
)
from drivax.learning.training_set import Source, TrainingSet, episodes_digest, prepare_episodes
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import Scenario
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.select.splits import HoldOut, hold_out
from drivax.scenario.store import ScenarioSet, Subset, check_lengths
from drivax.seal import note_edits
from drivax.settings import modules_of
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.progress import Progress
from drivax.tracking.run_folder import RUN_FILE, RunFolder

#: Problem and option to report if an input of the resumed run differs.
_RESUMED_WITH_OTHER = {
    "validation": ("was validated on other scenarios or none", "--validation"),
    "weights": ("was trained with other weights or none", "weights"),
    "recorded_episodes": ("was trained on other episodes or none", "--episodes"),
    "data": ("was trained on other scenarios", "--data"),
}

#: Entries of ``run.json`` that the folders of several seeds share.
_INHERITED_NOTES = ("validation", "weights", "recorded_episodes", "networks_from", "devices")


def make_agent(config: TrainConfig, bank: ScenarioBank, *, trust: Sequence[str] = ()) -> Any:
    """Return the :class:`Agent` that ``drivax train`` trains, in parts for a training loop of your own.

    Only shapes of the bank are read; ``agent.environment.prepare`` adds what the traffic needs. ``trust`` is that of
    :func:`~drivax.learning.policies.load_policy`, for policies in the traffic.

    Raises:
        UsageError: The algorithm has no parts: bc, cql, iql, awac, td3_bc, and the warm starts bc_ppo and bc_sac.
    """
    environment = training_environment(config, trust)
    learner = config.algorithm.build(environment, bank, config.iterations)
    if not isinstance(learner, Agent):
        problem = f"{type(config.algorithm).__name__} has no parts for a loop of your own"
        raise UsageError(problem, cure="use ppo or sac, or drivax.train")
    return learner


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of :func:`train`. Unlike the settings in :class:`TrainConfig`, they are not saved in the run.

    Attributes:
        resume: Continue the run in ``out`` from its newest healthy checkpoint, with its own configuration and seeds.
        overwrite: Replace an existing run folder; no effect with ``resume``.
        seeds: Number of seeds to train in one program, from ``config.seed`` on; several write ``out/seed-<seed>``.
        memory: Bytes of scenarios that are resident at a time (``config.residency`` is chosen by it); None: all are, or
            as many as configured.
        log: Called with lines about held-out scenarios, memory, pretrained networks and early stops, and with warnings.
        trust: Modules, besides drivax and those that the configuration names, whose code the run to resume and policies
            in the traffic may name.
    """

    resume: bool = False
    overwrite: bool = False
    seeds: int = 1
    memory: int | None = None
    log: Callable[[str], None] = lambda line: None
    trust: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UsageError(f"{self.seeds} seeds", cure="use 1 or more")


@note_edits()
def train(
    config: TrainConfig, data: ScenarioSet | TrainingSet, out: str | Path, *,
    validation: ScenarioSet | Literal["held_out"] | None = "held_out", **options: Any,
) -> RunFolder:  # fmt: skip
    """Train a policy and write the run folder: configuration, metrics, checkpoints of the full state.

    Args:
        config: Settings of the training run.
        data: Scenarios to train on. Weights are those of logged steps, or (ppo, sac) of the scenarios in which episodes
            begin: the sum over their steps. Episodes are for ``bc`` and offline algorithms.
        out: Run folder.
        validation: Scenarios that rank checkpoints. By default, whole recordings of ``data`` are held out: at most a
            tenth of its scenarios and at most 256, or the smallest recording if none fits; nothing if there is only one
            recording. None trains on all scenarios without validation.
        options: ``resume``, ``overwrite``, ``seeds``, ``memory``, ``log`` and ``trust`` of :class:`TrainOptions`.

    Raises:
        UsageError: ``out`` exists, inputs of a resumed run differ, weights do not fit, or memory is too small.
        DataError: No logged step is usable, the run to fine-tune is not a training run, its networks do not fit, or no
            checkpoint can be read.
        DivergenceError: Rewards, losses, parameters or actions of a seed are not finite; other seeds were trained.
        DrivaxError: Memory ran out.
        Preempted: SIGTERM stopped it, after a checkpoint.
    """
    opts, out, folders = TrainOptions(**options), Path(out), list[RunFolder]()
    trust = (*opts.trust, *modules_of(config))
    training = data if isinstance(data, TrainingSet) else TrainingSet(data)
    data, episodes = training.scenarios, training.episodes
    validation_set = _validation_set(data, validation, out, opts.resume)
    notes = hashes(validation_set, training.weights) | {"recorded_episodes": episodes_digest(episodes)}
    if opts.resume:
        config, folders = _resumed_folders(data, notes, out, opts.seeds, trust)
    else:
        RunFolder.check(out, opts.overwrite, "training")
        if config.begin_from is not None:  # with its step, so that resuming finds the same checkpoint
            config = replace(config, begin_from=str(PretrainedRun.of(config.begin_from)))
    scenarios, weights, validation_scenarios = _divide(config, data, training.weights, validation_set)
    source = Source.of(config, scenarios, weights, episodes, trust)
    residents = Residents.of(source, opts.memory)
    config = residents.config
    seeds = range(config.seed, config.seed + (len(folders) or opts.seeds))
    program = _program(residents, tuple(seeds))
    held_out = _held_out(config, source.environment, program.seeds.learner, validation_scenarios, episodes)
    warn_of_other_bits([folder.info for folder in folders], len(program.devices), opts.log)
    (memory := program.account(None if held_out is None else held_out.bank)).check()
    divided = len(scenarios), len(validation_scenarios or ())
    held_out_notice = [validation_set.text(*divided)] if isinstance(validation_set, HoldOut) else []
    for line in (*held_out_notice, *residents.notices(program.data), memory.text()):
        opts.log(line)
    # Read before folders are created, because an error must leave none.
    networks = {} if opts.resume else pretrained_networks(config.begin_from, program, opts.log)
    rules = (config.checkpoint_rule, config.keep, config.patience)
    use = f"in training; {memory.text()}"
    with contextlib.ExitStack() as stack, explain_full_disk(out), report_out_of_memory(use, memory.cure):
        notes["devices"] = len(program.devices)
        folders = folders or _create_folders(config, data, notes, out, seeds, opts.overwrite)
        logs = [stack.enter_context(TrainingLog(folder, *rules)) for folder in folders]
        stack.callback(residents.close)
        _Training(config, program, logs, held_out, networks, opts.log, trust, residents).run()
    return RunFolder.open(out)


def _program(residents: Residents, seeds: tuple[int, ...]) -> Program:
    """Return the program of a run, which alone keeps its data in memory."""
    config, source, data = residents.config, residents.source, residents.load()
    learner = config.algorithm.build(source.environment, data, config.iterations)
    return Program(Seeds(learner, seeds), residents.complete(data), config.devices)


def _validation_set(
    data: ScenarioSet, validation: ScenarioSet | Literal["held_out"] | None, out: Path, resume: bool
) -> ScenarioSet | HoldOut | None:
    """Return the validation set, or the recordings that a new run holds out or the run to resume held out."""
    if not isinstance(validation, str):
        return validation
    if not resume:
        return hold_out(data.entries)
    note = RunFolder.open(out).info.get("validation")
    return hold_out(data.entries, note["recordings"]) if isinstance(note, dict) else None


def _divide(
    config: TrainConfig,
    data: ScenarioSet,
    weights: np.ndarray | None,
    validation: ScenarioSet | HoldOut | None,
) -> tuple[ScenarioSet | Subset, np.ndarray | None, Sequence[Scenario] | None]:
    """Return the scenarios to train on, their weights, and the scenarios to validate on (None: no validation).

    Raises:
        UsageError: Validation scenarios have another length, ``patience`` is set without any, or weights do not fit.
        DataError: No scenario meets the filters.
    """
    training: Sequence[int] = select_scenarios(data, config.filters) if config.filters else range(len(data))
    scenarios: Sequence[Scenario] | None = None
    if isinstance(validation, HoldOut) and validation.recordings:
        selected = set(training)
        training, held_out = (
            [row for row in rows if row in selected] for rows in (validation.training, validation.validation)
        )
        if not training or not held_out:
            use = "validate on" if training else "train on"
            problem = f"no scenario to {use} meets {' and '.join(config.filters)}"
            raise DataError(problem, file=data.path, cure="use weaker filters, or pass --validation SET")
        scenarios = data.take(held_out)
    elif isinstance(validation, ScenarioSet):
        check_lengths(data, validation)
        scenarios = validation
    elif config.patience:
        raise UsageError("patience needs scenarios to validate on", cure="pass --validation SET")
    if weights is not None:
        egos = count_egos(config.egos, data.capacity.egos)
        weights = check_weights(weights, len(data), data.capacity.steps, egos)[list(training)]
        weights = weights.reshape(-1, data.capacity.steps)
    return data if len(training) == len(data) else Subset(data, training), weights, scenarios


def usable_steps(
    config: TrainConfig, data: ScenarioSet | TrainingSet, trust: Sequence[str] = ()
) -> np.ndarray:
    """Return the mask ``[M, T]`` of the logged steps that training with weights can draw, for each ego it drives.

    With episodes, the mask is ``[N, T]`` and holds where any episode of the scenario has such a step. All steps count
    for algorithms that draw scenarios instead. ``trust`` is as for :func:`train`.
    """
    training = data if isinstance(data, TrainingSet) else TrainingSet(data)
    scenarios, steps = training.scenarios, training.scenarios.capacity.steps
    uniform = np.ones((len(scenarios), steps))
    source = Source.of(config, scenarios, uniform, training.episodes, trust)
    if not source.draws_steps():
        return uniform > 0
    experience = source.complete(source.load())
    usable, scenario = np.asarray(experience.usable), experience.expert.scenario
    if scenario is None:
        return usable
    mask = np.zeros((len(scenarios), steps), bool)
    np.logical_or.at(mask, np.asarray(scenario), usable)
    return mask


def hashes(validation: ScenarioSet | HoldOut | None, weights: np.ndarray | None) -> dict[str, Any]:
    """Return the hash of the validation set, or the held-out recordings, and that of weights, for ``run.json``."""
    notes: dict[str, Any] = {"validation": None, "weights": None}
    if validation is not None:
        notes["validation"] = validation.note() if isinstance(validation, HoldOut) else validation.hash
    if weights is not None:
        notes["weights"] = hashlib.sha256(np.asarray(weights, "<f8").tobytes()).hexdigest()
    return notes


def mean_logs(raw: Mapping[str, Any]) -> dict[str, float]:
    """Return the means to log, given the values of an iteration.

    A name with a count ``<name>/n`` is a sum: its mean is logged, or nothing if the count is 0. Sums of
    ``rollout/reward/*`` are divided by ``rollout/steps``, and logged as ``reward/*``. These counts are not logged; all
    other values are logged unchanged.
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


def _held_out(
    config: TrainConfig,
    environment: Driving | Mixture,
    learner: Any,
    scenarios: Sequence[Scenario] | None,
    episodes: Sequence[EpisodeTable] | StoredEpisodes,
) -> Validation | None:
    """Return the validation on scenarios, with the data of a learner's held-out metrics; None without scenarios.

    Without recorded episodes in these scenarios, there are no such data, and no such metrics.
    """
    if scenarios is None:
        return None
    held_out = Validation.of(scenarios)
    if isinstance(episodes, StoredEpisodes) or not isinstance(learner, HeldOutMetrics):
        return held_out
    data: Any = environment.prepare(held_out.bank)
    if isinstance(environment, RecordedDriving):
        data = prepare_episodes(environment, data, scenarios, episodes)
        if data is None:
            return held_out
    return replace(held_out, data=training_data(config.algorithm, environment, data))


def _create_folders(
    config: TrainConfig, data: ScenarioSet, notes: dict[str, Any], out: Path, seeds: range, overwrite: bool
) -> list[RunFolder]:
    """Create the run folder of each seed: ``out``, or for several ``out/seed-<seed>``."""
    if config.begin_from is not None:
        notes = {**notes, "networks_from": PretrainedRun.of(config.begin_from).notes()}
    if len(seeds) == 1:
        return [RunFolder.create(out, config, [data], overwrite, kind="training", **notes)]
    RunFolder.create(out, config, [data], overwrite, kind="seeds", seeds=len(seeds), **notes)
    return [_seed_folder(config, data, notes, out, seed) for seed in seeds]


def _seed_folder(
    config: TrainConfig, data: ScenarioSet, notes: Mapping[str, Any], out: Path, seed: int
) -> RunFolder:
    """Open the folder of one of several seeds, or create it."""
    path = inside(out, f"seed-{seed}")
    if (path / RUN_FILE).is_file():
        return RunFolder.open(path)
    return RunFolder.create(path, replace(config, seed=seed), [data], kind="training", **notes)


def _resumed_folders(
    data: ScenarioSet, notes: Mapping[str, Any], out: Path, seeds: int, trust: Sequence[str]
) -> tuple[TrainConfig, list[RunFolder]]:
    """Return the configuration of a run with its number of devices, and the folder of each of its seeds.

    Raises:
        UsageError: Data or options differ from those of the run, or it names code that is not trusted.
    """
    folder = RunFolder.open(out)
    previous = {"data": [entry.get("hash") for entry in folder.info.get("data") or ()]}
    previous |= {name: folder.info.get(name) for name in notes}
    for name, value in {"data": [data.hash], **notes}.items():
        if previous[name] != value:
            problem, option = _RESUMED_WITH_OTHER[name]
            raise UsageError(problem, file=out, cure=f"resume with the same {option}")
    config, count = folder.config(TrainConfig, trust=trust), folder.info.get("seeds") or 1
    if seeds not in (1, count):
        raise UsageError(f"contains {count} seeds, not {seeds}", file=out, cure="resume without --seeds")
    devices = former_devices(folder.info)
    resumed = replace(config, devices=devices) if devices <= jax.local_device_count() else config
    if folder.kind != "seeds":
        return resumed, [folder]
    # A process that was killed at its start may not have created all folders.
    notes = {name: folder.info[name] for name in _INHERITED_NOTES if name in folder.info}
    numbers = range(config.seed, config.seed + count)
    return resumed, [_seed_folder(config, data, notes, out, number) for number in numbers]


@dataclass(frozen=True)
class _Training:
    """The iterations of a training run, and the log of each seed; ``networks`` are the pretrained ones of a new run."""

    config: TrainConfig
    program: Program
    logs: Sequence[TrainingLog]
    validation: Validation | None
    networks: Mapping[str, Any]
    log: Callable[[str], None]
    trust: Sequence[str]
    residents: Residents

    def run(self) -> None:
        """Run the remaining iterations.

        Raises:
            DivergenceError: A seed diverged; the others ran to the end.
            Preempted: SIGTERM stopped the run.
        """
        config, program = self.config, self.program
        done, state = self._start()
        state = self.residents.resume(program, state, done, self._logged(done) if config.curriculum else ())
        exchanged: dict[str, float] = {}
        total_steps, done_steps = self._steps(config.iterations), self._steps(done)
        with Progress("training", "steps", total_steps, done=done_steps) as progress, StopSignal() as stop:
            for iteration in range(done + 1, config.iterations + 1):
                if all(log.stopped for log in self.logs):
                    break
                started = time.perf_counter()
                state, values, finite = program.step(state)
                values, finite = jax.device_get((values, finite))
                rate = config.algorithm.steps_per_iteration / (time.perf_counter() - started)
                # Read once, so that all seeds write a checkpoint of the same iteration.
                preempted = stop.received and iteration < config.iterations
                means = (mean_logs(program.seeds.member(values, number)) for number in range(len(self.logs)))
                stage = self.residents.note()
                rows = [row | exchanged | stage | {"steps_per_second": rate} for row in means]
                # Seeds that log this iteration: a resumed run reads the same rows.
                driven = [row for row, log in zip(rows, self.logs, strict=True) if not log.stopped]
                self._check(iteration, state, rows, np.atleast_1d(finite))
                if line := self.residents.follow(program, mean_rollout(driven)):
                    self.log(f"{line}, from step {self._steps(iteration):,}")
                self._record(iteration, state, rows, preempted)
                success = [row["rollout/success"] for row in rows if "rollout/success" in row]
                note = f"success {sum(success) / len(success):.2f}" if success else ""
                progress.update(self._steps(iteration), note)
                if preempted:
                    problem = f"SIGTERM stopped the training after {self._steps(iteration):,} steps"
                    raise Preempted(problem, cure="continue it with --resume")
                # After the iteration is recorded, because a file may be damaged. Its times are logged with the next.
                if iteration < config.iterations:
                    state, exchanged = self.residents.exchange(program, state, iteration)
        self._check_critics()
        for log in self.logs:
            if log.divergence is not None:
                raise log.divergence

    def _check_critics(self) -> None:
        """Note what is wrong with the critics of each finished seed."""
        seeds = self.program.seeds
        if not isinstance(seeds.learner, HasCritics):
            return
        for seed, log in zip(seeds.seeds, self.logs, strict=True):
            if log.divergence is not None:
                continue
            # Later rows say nothing about the policy that is loaded.
            step = log.checkpoints.best_or_newest()
            rows = [row for row in log.folder.metric_rows() if step is None or row["step"] <= step]
            problems = seeds.learner.critic_problems(rows)
            log.folder = log.folder.note(critics=problems)
            for problem in problems or ():
                self.log(f"warning: seed {seed}: unhealthy critics: {problem}")

    def _logged(self, done: int) -> list[dict[str, float]]:
        """Return the mean over seeds of what each finished iteration logged about rollouts."""
        tables = [{row["step"]: row for row in log.folder.metric_rows()} for log in self.logs]
        steps = map(self._steps, range(1, done + 1))
        return [mean_rollout([table[step] for table in tables if step in table]) for step in steps]

    def _steps(self, iteration: int) -> int:
        """Return the environment steps of each seed after an iteration."""
        return iteration * self.config.algorithm.steps_per_iteration

    def _start(self) -> tuple[int, Any]:
        """Return the number of finished iterations and the state: of the newest common checkpoint, or initial.

        If every seed has stopped, all iterations count as finished, and the state is None.
        """
        unfinished = [log for log in self.logs if not log.out_of_patience]
        if all(log.divergence is not None for log in unfinished):
            # The user may have corrected a reward term.
            for log in unfinished:
                log.retry()
        active = [number for number, log in enumerate(self.logs) if not log.stopped]
        if not active:
            return self.config.iterations, None
        logs = [self.logs[number] for number in active]
        step, states = self._restore(logs)
        for log in logs:
            log.start(step)
        if step is None:
            networks = self.networks or pretrained_networks(self.config.begin_from, self.program, self.log)
            return 0, initial_state(self.program, networks)
        # Stopped seeds write nothing more, so they take the state of any other seed.
        restored = dict(zip(active, states, strict=True))
        states = [restored.get(number, states[0]) for number in range(len(self.logs))]
        return step // self.config.algorithm.steps_per_iteration, self.program.state_of(states)

    def _restore(self, logs: Sequence[TrainingLog]) -> tuple[int | None, list[Any]]:
        """Return the newest step at which all seeds have a healthy checkpoint, and their states; None if there is none.

        Raises:
            DataError: All checkpoints are damaged, or seeds have none of the same step.
        """
        template = self.program.seeds.member_shapes(self.program.shapes)
        steps = [set(log.checkpoints.steps()) for log in logs]
        errors: list[DataError] = []
        for step in sorted(set.intersection(*steps), reverse=True):
            try:
                states = [_healthy_state(log.checkpoints, template, step) for log in logs]
            except DataError as error:
                errors.append(error)
                continue
            for error in errors:
                self.log(f"warning: {error.file}: {error.problem}; resumes from step {step:,}")
            return step, states
        if errors:
            raise errors[0]
        # A process that was killed at the first checkpoint may have written it for some seeds only.
        if all(steps) or max(map(len, steps)) > 1:
            problem = "the seeds have no checkpoint of the same step"
            raise DataError(problem, file=logs[0].folder.path.parent, cure="start again with --overwrite")
        return None, []

    def _check(
        self, iteration: int, state: LearnerState, rows: list[dict[str, float]], finite: np.ndarray
    ) -> None:
        """Stop each seed whose actions, rewards, losses or trained leaves are not finite; warn of large values."""
        seeds, steps = self.program.seeds, self._steps(iteration)
        for number, log in enumerate(self.logs):
            if log.stopped:
                continue
            problem = nonfinite_log(rows[number])
            if problem is None and not finite[number]:
                problem = nonfinite_leaf(seeds.member(state, number))
            if problem is not None:
                log.write(steps, rows[number])
                self._stop_diverged(number, steps, problem)
                continue
            for warning in log.new_warnings(rows[number]):
                text = f"seed {seeds.seeds[number]}: {warning} at {steps:,} steps"
                self.log(f"warning: {text}: training may diverge")

    def _stop_diverged(self, number: int, steps: int, problem: str) -> None:
        self.logs[number].diverge(steps, problem)
        if len(self.logs) > 1:
            self.log(f"seed {self.program.seeds.seeds[number]}: diverged at {steps:,} steps: {problem}")

    def _record(
        self, iteration: int, state: LearnerState, rows: list[dict[str, float]], preempted: bool
    ) -> None:
        """Log, validate and save one iteration of every seed that has not stopped."""
        config, seeds, steps = self.config, self.program.seeds, self._steps(iteration)
        is_last = iteration == config.iterations
        validates = is_last or (config.evaluate_every > 0 and iteration % config.evaluate_every == 0)
        saves = is_last or validates or preempted or iteration % config.checkpoint_every == 0
        logs = [(number, log) for number, log in enumerate(self.logs) if not log.stopped]
        for number, log in logs:
            row = rows[number]
            if validates and self.validation is not None:
                try:
                    row |= self._validate(self.validation, state, number)
                except DivergenceError as error:
                    self._stop_diverged(number, steps, error.problem)
            rank = log.write(steps, row)
            if saves and log.divergence is None:
                log.save(steps, seeds.member(state, number), rank)
            if log.out_of_patience and not is_last:
                problem = f"no better for {config.patience} validations, stopped at {steps:,} steps"
                self.log(f"seed {seeds.seeds[number]}: {problem}")
        # Not before all seeds have a checkpoint of this step, so that a killed run can resume.
        for _, log in logs if saves else ():
            log.checkpoints.delete_superseded()

    def _validate(self, validation: Validation, state: LearnerState, number: int) -> dict[str, float]:
        """Validate one seed, on the first device."""
        seeds, device = self.program.seeds, self.program.devices[0]
        parameters = jax.device_put(seeds.member(state.parameters, number), device)
        planner = seeds.learner.planner(parameters, "policy", samples=False)
        traffic = find_traffic(self.config.validation_traffic, self.trust)
        row = validate(planner, validation, self.config.task, traffic)
        if isinstance(seeds.learner, HeldOutMetrics) and validation.data is not None:
            member = jax.device_put(seeds.member(state, number), device)
            metrics = seeds.learner.held_out_metrics(validation.data, member)
            row |= {f"validation/{name}": value for name, value in metrics.items()}
        return row


def _healthy_state(checkpoints: Checkpoints, template: Any, step: int) -> Any:
    """Restore the state of a step.

    Raises:
        DataError: The checkpoint is damaged, does not match, or contains a number that is not finite.
    """
    state = checkpoints.restore(template, step)
    if problem := nonfinite_leaf(state):
        cure = "start again with --overwrite and a lower learning rate"
        raise DataError(f"checkpoint of step {step}: {problem}", file=checkpoints.folder, cure=cure)
    return state
