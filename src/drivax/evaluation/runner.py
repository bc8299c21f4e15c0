"""Evaluate a planner on every scenario of a set, in memory or into a run folder.

An episode depends only on planner, task, traffic, start, seed and scenario, bit for bit: not on the order of the
scenarios or the batch size. Random keys derive from the scenario's identity (``bank.identity``). Every program call
runs a fixed number of scenarios (short batches are padded) in banks of equal sizes. A subset gives the same bits as the
whole set if it is evaluated with the ``sizes`` of the whole set, as :func:`run_evaluation` does.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, UInt32

from drivax.errors import DataError, DrivaxError, UsageError
from drivax.escaping import escape_controls
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.episode_table import ADDED, KEYS, Crash, EpisodeTable, Trajectories, fail_crashed
from drivax.evaluation.memory import free_memory, report_out_of_memory, scenarios_at_a_time
from drivax.evaluation.result_tables import metric_label
from drivax.evaluation.rollout import Episodes, check_actions, drive, episode_keys, evaluation_task
from drivax.files import check_space, explain_full_disk, replace_folder
from drivax.metrics.catalogue import METRICS, Metric, headline, metric_specs, select_metrics
from drivax.planners.catalogue import PLANNERS
from drivax.planners.functions import collect_errors
from drivax.planners.planner import Planner, add_noise, hold, limit_speed
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank, identities, too_short
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import CURRENT_STEP, LEAST_STEPS, Scenario
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet
from drivax.seal import edited_files, mark_edited
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart, Start
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import Traffic
from drivax.table import Cell, Column, Table
from drivax.tasks.actions import Route
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress as ProgressBar
from drivax.tracking.run_folder import RunFolder, policy_training_sets

#: Scenarios per program call on a CPU, where larger batches exceed the caches with some planners and are faster with
#: others (docs/log/2026-11-22-evaluation.md), and on other devices.
CPU_WIDTH, ACCELERATOR_WIDTH = 16, 256
#: Approximate bytes of a step in a run folder, measured on the built-in world: of ego, and of each simulated agent.
_EGO_BYTES, _AGENT_BYTES = 22, 3
#: Maximum number of scenarios in an error message, and of crashes in a list.
_MAX_NAMED = _MAX_LISTED = 5
#: Maximum number of planners in a table of headline metrics.
_MAX_PLANNERS = 5
#: End of the name of a planner in the action space ``route``, in all tables: it plans along the route, and does not
#: steer.
ROUTE_MARK = " (route)"
Names = Sequence[Mapping[str, str]]
Progress = Callable[[int, int], None]


def program_width() -> int:
    """Return the number of scenarios per program call on this platform."""
    return CPU_WIDTH if jax.default_backend() == "cpu" else ACCELERATOR_WIDTH


@dataclass(frozen=True)
class EvaluationConfig:
    """Configuration of an evaluation, stored as ``config.yaml``.

    Attributes:
        planner: Planner to evaluate: a name, module:name of your own, the run folder of a training run (RUN or
            RUN@STEP for an earlier checkpoint), or zoo:NAME.
        traffic: Traffic model: log replays the log, idm lets vehicles react to ego, a run folder or zoo:NAME drives
            the vehicles near ego (with +idm appended the others react), or module:name of your own.
        noisy_start: Start after a second of perturbed driving, drawn per scenario from the seed
            (docs/guide/dynamics.md).
        start_step: Step of the log at which episodes start.
        filter: Only scenarios that meet this condition (NAME=A|B, NAME!=A, NAME>=N); repeat it to combine several.
        scenarios: Only scenarios with these ids, or with the ids in a file, one per line.
        limit: Only the first N scenarios that remain after filtering.
        metrics: Metrics to print in addition to the headline: a set (training, full), names, or module:name of your
            own (docs/guide/custom.md). All built-in metrics are always computed and written.
        seed: Seed of all random numbers: noisy starts and planners that sample.
        sample: Let a trained policy sample its actions instead of taking the mode.
        noise: Standard deviation of noise that is added to the actions, correlated over a second.
        limiter: Slow the planner down by a speed limiter at this share of the speed limit, as a control for policies
            that collide less because they drive less far.
        batch: Scenarios loaded at a time; as many as memory allows by default. Results do not depend on it.
        task: Action space and observation of the planner.
    """

    planner: str
    traffic: str = "log"
    noisy_start: bool = False
    start_step: int = CURRENT_STEP
    filter: tuple[str, ...] = ()
    scenarios: tuple[str, ...] = ()
    limit: int | None = None
    seed: int = 0
    metrics: tuple[str, ...] = ()
    sample: bool = False
    noise: float = 0.0
    limiter: float | None = None
    batch: int | None = None
    task: Task = field(default_factory=Task)


def run_evaluation(
    config: EvaluationConfig, planner: Planner, data: ScenarioSet, out: str | Path, *, traffic: Traffic | None = None,
    sizes: Sizes | None = None, overwrite: bool = False,
) -> EpisodeTable:  # fmt: skip
    """Evaluate a planner on the scenarios of a set that ``config`` selects, and write the run folder.

    The folder appears when all episodes are finished. ``traffic`` defaults to the built-in model ``config.traffic``,
    ``sizes`` to those of the whole set.
    """
    planner = limit_speed(add_noise(planner, config.noise), config.limiter, config.task.actions)
    scenarios = data.take(select_scenarios(data, config.filter, config.scenarios, config.limit))
    RunFolder.check(Path(out), overwrite, "evaluation")
    # Only evaluated scenarios need verification; the others only contribute their sizes.
    sizes = sizes or ScenarioSet.open(data.path, verify=False).sizes
    needed_bytes = len(scenarios) * _episode_bytes(config.traffic, sizes, data.capacity.steps)
    check_space(Path(out), needed_bytes)
    with ProgressBar(f"evaluating {planner.name}", "scenarios", len(scenarios)) as bar:
        table = evaluate(
            planner,
            scenarios,
            task=with_metrics(config.task, config.metrics),
            traffic=traffic or make_traffic(config.traffic),
            start=NoisyStart() if config.noisy_start else LogStart(),
            start_step=config.start_step,
            seed=config.seed,
            batch=config.batch,
            sizes=sizes,
            progress=lambda done, total: bar.update(done),
        )
    info: dict[str, Any] = {"kind": "evaluation", "episodes": len(table), "seed": config.seed, **table.info}
    if training_sets := policy_training_sets(config.planner, PLANNERS):
        info["trained_on"] = training_sets
    with explain_full_disk(Path(out), needed_bytes), replace_folder(Path(out)) as partial_folder:
        RunFolder.create(partial_folder, config, data=[data], overwrite=True, **info)
        table.write(partial_folder)
    return table


def _episode_bytes(traffic: str, sizes: Sizes, steps: int) -> int:
    """Return the approximate size of an episode in a run folder, bytes."""
    return steps * (_EGO_BYTES + (0 if traffic == "log" else _AGENT_BYTES * sizes.agents))


def with_metrics(task: Task, extra: tuple[str, ...]) -> Task:
    """Return the task with further metrics."""
    metrics = task.metrics if isinstance(task.metrics, tuple) else (task.metrics,)
    return replace(task, metrics=tuple(dict.fromkeys((*metrics, *extra)))) if extra else task


def format_summary(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Format headline metrics (rows) of planners (columns); undefined means are empty cells.

    Further planners follow in tables of their own, so that columns stay readable.
    """
    parts = [summaries[i : i + _MAX_PLANNERS] for i in range(0, len(summaries), _MAX_PLANNERS)]
    texts = []
    for part in parts:
        columns = (Column("metric", label=True), *(Column(summary["planner"]) for summary in part))
        rows = []
        for name in headline(METRICS):
            means = (summary["metrics"][name]["mean"] for summary in part)
            cells = (Cell("" if mean is None else f"{mean:.3f}") for mean in means)
            rows.append((Cell(metric_label(name).text), *cells))
        texts.append(Table("summary", columns, tuple(rows)).text())
    return "\n\n".join(texts)


def format_metrics(summary: Mapping[str, Any], names: tuple[str, ...]) -> str:
    """Format metrics of one planner as a table: mean, 95 % interval and n; ``names`` as in ``metrics.catalogue``.

    Codes and counts, which have no mean, are left out.
    """
    rows = []
    for name in select_metrics(names).names:
        metric = summary["metrics"].get(name)
        if metric is None:
            continue
        numbers = (metric[key] for key in ("mean", "low", "high"))
        mean, low, high = ("" if number is None else f"{number:.4g}" for number in numbers)
        interval = f"{low} to {high}" if low else ""
        rows.append((Cell(name), Cell(mean), Cell(interval), Cell(f"{metric['n']:,}")))
    columns = (Column("metric", label=True), *map(Column, ("mean", "95 % interval", "n")))
    return Table("metrics", columns, tuple(rows)).text()


def format_crashes(table: EpisodeTable) -> str:
    """Format the first crashes, one per line; empty if there are none."""
    if not table.crashes:
        return ""
    count = len(table.crashes)
    lines = [f"{table.planner} crashed in {count} of {len(table)} episodes, which count as failed:"]
    for crash in table.crashes[:_MAX_LISTED]:
        lines.append(escape_controls(f"  {crash.scenario_id}, step {crash.step}: {crash.error}"))
    if count > _MAX_LISTED:
        lines.append(f"  and {count - _MAX_LISTED} more, in crashes.json")
    return "\n".join(lines)


class Options(TypedDict, total=False):
    """Keyword options of :func:`evaluate`.

    ``start_step`` defaults to the current step, and ``seed`` to 0. ``batch`` is the number of stored scenarios loaded
    at a time, by default as many as fit in memory; results do not depend on it. ``sizes`` of the banks default to what
    the scenarios use; subsets with the sizes of the whole set share its compiled program. With a bank, ``batch`` and
    ``sizes`` have no effect. ``progress`` is called with (episodes done, episodes) after every program call.
    """

    start_step: int
    seed: int
    batch: int | None
    sizes: Sizes | None
    progress: Progress | None


def evaluate(
    planner: Planner, scenarios: ScenarioBank | Sequence[Scenario], names: Names | None = None, *,
    task: Task | None = None, traffic: Traffic | None = None, start: Start | None = None, **options: Unpack[Options],
) -> EpisodeTable:  # fmt: skip
    """Run a planner on every scenario to the end of its log, and measure the episodes.

    Args:
        planner: The planner.
        scenarios: A bank, or stored scenarios of one capacity.
        names: ``dataset``, ``scenario_id`` and ``segment`` of every scenario of a bank; stored scenarios have them.
        task: Action space and observation of the planner. All metrics are measured, and no episode ends early.
        traffic: Traffic model, log replay by default; its precomputed data is added here.
        start: Start of the episodes, as logged by default. Random starts are the same for every planner.
        options: See :class:`Options`.

    Raises:
        UsageError: ``scenarios`` is empty; or planner, task, start and scenarios are incompatible; or an option is
            invalid (``batch`` below 1, ``sizes`` too small).
        DataError: A log is too short.
        DrivaxError: Memory is insufficient, or ego's motion is not finite.
    """
    if unknown := sorted(options.keys() - Options.__annotations__.keys()):
        raise TypeError(f"evaluate() got an unexpected keyword argument {unknown[0]!r}")
    batch, sizes, progress = options.get("batch"), options.get("sizes"), options.get("progress")
    start_step, seed = options.get("start_step", CURRENT_STEP), options.get("seed", 0)
    if batch is not None and batch < 1:
        raise UsageError(f"batch of {batch} scenarios", cure="use 1 or more")
    if not len(scenarios):
        raise UsageError("no scenarios to evaluate", cure="pass at least one")
    steps = scenarios.steps if isinstance(scenarios, ScenarioBank) else scenarios[0].capacity.steps
    simulator = Simulator(task or Task(), traffic or LogTraffic(), start or LogStart())
    evaluation = _Evaluation.of(simulator, planner, start_step, seed, steps)
    prepare: Callable[[Callable[[int], Scenario]], None] | None = getattr(planner, "prepare", None)
    if isinstance(scenarios, ScenarioBank):
        if prepare is not None:
            problem = f"planner {planner.name} needs stored scenarios"
            raise UsageError(problem, cure="pass the set, or what drivax.load returns")
        names, identity = _bank_names(scenarios, names or (), start_step), np.asarray(scenarios.identity)
        size, banks = len(scenarios), iter([scenarios])
    else:
        names = _stored_names(scenarios, start_step)
        identity = identities([(row["dataset"], row["scenario_id"]) for row in names])
        if prepare is not None:
            index_by_identity = {number: index for index, number in enumerate(identity.tolist())}
            prepare(lambda number: scenarios[index_by_identity[number]])
        sizes = sizes or Sizes.used(scenarios)
        size = min(batch or _batch_size(simulator.traffic, scenarios, sizes), len(scenarios))
        banks = _banks(scenarios, identity, size, sizes)
    episodes, done = [], 0
    cure = "load fewer at a time (--batch), evaluate fewer (--limit), or free memory"
    out_of_memory = report_out_of_memory(f"with {size:,} scenarios loaded", cure)
    with collect_errors() as errors, out_of_memory:
        for bank in banks:
            for batch_episodes in evaluation.episodes(bank):
                episodes.append(batch_episodes)
                done += len(batch_episodes.crashed)
                if progress is not None:
                    progress(done, len(names))
    all_episodes = jax.tree.map(lambda *leaves: np.concatenate(leaves), *episodes)
    return evaluation.table(all_episodes, names, identity, errors)


def _bank_names(bank: ScenarioBank, names: Names, start_step: int) -> Names:
    """Return the names after checking that every scenario of a bank has one, and that its episode can start."""
    if len(names) != len(bank):
        problem = f"{len(names)} scenario names for a bank of {len(bank)}"
        raise UsageError(problem, cure="name every scenario of the bank")
    present = np.asarray(bank.agents[:, start_step, 0, AgentColumn.VALID]) > 0
    # A scenario has a row of ``last_step`` per ego; the first row is that of slot 0.
    _check_starts(names, np.asarray(bank.last_step[:: bank.most_egos]) + 1, present, start_step)
    return names


def _stored_names(scenarios: Sequence[Scenario], start_step: int) -> Names:
    """Return the names of stored scenarios after checking that their episodes can start."""
    names = scenario_names(scenarios)
    steps, present = zip(*((int(s.steps), s.agent_valid[start_step, 0]) for s in scenarios), strict=True)
    _check_starts(names, np.array(steps), np.array(present), start_step)
    return names


def _batch_size(traffic: Traffic, scenarios: Sequence[Scenario], sizes: Sizes) -> int:
    """Return the number of scenarios that fit in memory at a time."""
    bank = prepare_bank(traffic, ScenarioBank.from_scenarios(scenarios[:1], trim=sizes))
    return scenarios_at_a_time(bank.nbytes, program_width(), free_memory(jax.devices()[0]))


def _banks(
    scenarios: Sequence[Scenario], identity: UInt32[np.ndarray, " n"], size: int, sizes: Sizes
) -> Iterator[ScenarioBank]:
    """Yield banks of ``size`` scenarios (the last may have fewer); ``identity`` has the identity of every scenario."""
    for first in range(0, len(scenarios), size):
        rows = slice(first, first + size)
        bank = ScenarioBank.from_scenarios(scenarios[rows], trim=sizes)
        yield replace(bank, identity=jnp.asarray(identity[rows]))


@dataclass(frozen=True)
class _Evaluation:
    """A checked evaluation; its simulator has the task of :func:`evaluation_task`."""

    simulator: Simulator
    planner: Planner
    start_step: int
    seed: int
    metrics: Mapping[str, Metric]

    @classmethod
    def of(
        cls, simulator: Simulator, planner: Planner, start_step: int, seed: int, steps: int
    ) -> _Evaluation:
        """Return the evaluation after checking that planner, task and start are compatible."""
        task = simulator.task
        if not isinstance(task, Task):
            raise UsageError(f"{type(task).__name__} has no metrics", cure="use drivax.tasks.Task")
        if not 0 <= start_step < steps - 1:
            raise UsageError(f"no episode can start at step {start_step}", cure=f"use 0 to {steps - 2}")
        check_actions(planner, task)
        if planner.replays and simulator.start != LogStart():
            problem = f"planner {planner.name} replays the log and cannot start elsewhere"
            raise UsageError(problem, cure="use expert_actions")
        task = evaluation_task(task)
        metrics = metric_specs(task.metrics)
        if conflicts := sorted({*KEYS, *ADDED} & metrics.keys()):
            raise UsageError(f"the column {conflicts[0]!r} already exists", cure="rename your metric")
        return cls(replace(simulator, task=task), hold(planner, task.hold), start_step, seed, metrics)

    def episodes(self, bank: ScenarioBank) -> Iterator[Episodes]:
        """Run the scenarios of a bank in order, and yield their episodes in batches."""
        bank, width = prepare_bank(self.simulator.traffic, bank), program_width()
        index = jnp.arange(width, dtype=jnp.int32)
        for first in range(0, len(bank), width):
            count = min(width, len(bank) - first)
            rows = np.pad(np.arange(first, first + count), (0, width - count), mode="edge")
            batch, keys = _batch(bank, jnp.asarray(rows, jnp.int32), self.seed)
            episodes = drive(self.simulator, self.planner, batch, index, keys, self.start_step)
            yield jax.tree.map(lambda leaf, count=count: np.asarray(leaf)[:count], episodes)

    def table(
        self, episodes: Episodes, names: Names, identity: Any, errors: Mapping[tuple[int, int], str]
    ) -> EpisodeTable:
        """Tabulate episodes; ``errors`` are the planner's exceptions by identity and step."""
        _check_finite(episodes, names)
        n, traffic = len(names), self.simulator.traffic.name
        is_route = isinstance(getattr(self.simulator.task, "actions", None), Route)
        planner = self.planner.name + ROUTE_MARK * is_route
        planner = mark_edited(planner, edited_files())
        values, crash_step = episodes.metrics, np.asarray(episodes.crashed)
        actions = until_crash(np.asarray(episodes.actions), crash_step, self.start_step)
        in_log = self.start_step + np.arange(actions.shape[1]) < values["last_step"].value[:, None]
        actions = np.where(in_log[..., None], actions, np.nan)
        metrics = {"action_jerk": action_jerk(actions)} | {
            name: np.where(values[name].defined, values[name].value, np.nan) for name in self.metrics
        }
        columns = {key: tuple(row[key] for row in names) for key in ("dataset", "scenario_id", "segment")}
        columns |= {"planner": (planner,) * n, "seed": (str(self.seed),) * n, "traffic": (traffic,) * n}
        info: dict[str, Any] = {"planner": planner, "traffic": traffic}
        if user_metrics := {name: metric for name, metric in self.metrics.items() if name not in METRICS}:
            info["own_metrics"] = {
                name: {"unit": metric.unit, "better": metric.better, "text": metric.definition}
                for name, metric in user_metrics.items()
            }
        return EpisodeTable(
            folder=None,
            name=planner,
            info=info,
            keys={name: columns[name] for name in KEYS},
            metrics=fail_crashed(metrics, crash_step >= 0),
            crashes=_crashes(crash_step, names, identity, errors),
            in_memory=Trajectories(
                ego=np.asarray(episodes.motion),
                action=actions,
                start=np.full(n, self.start_step, np.int64),
                events={name: np.asarray(steps, np.int64) for name, steps in episodes.events.items()},
                others=None if episodes.others is None else np.asarray(episodes.others),
            ),
        )


def _crashes(
    crash_step: Int[np.ndarray, " episode"], names: Names, identity: Any, errors: Mapping[tuple[int, int], str]
) -> tuple[Crash, ...]:  # fmt: skip
    crashes = []
    for row in np.flatnonzero(crash_step >= 0).tolist():
        step = int(crash_step[row])
        error = errors.get((int(identity[row]), step), "action is not finite")
        crashes.append(Crash(names[row]["dataset"], names[row]["scenario_id"], step, error))
    return tuple(crashes)


def until_crash(
    actions: Float[np.ndarray, "episode step D"], crash_step: Int[np.ndarray, " episode"], start: int
) -> Float[np.ndarray, "episode step D"]:
    """Return actions with NaN from ``crash_step`` on, the step at which the planner crashed (-1: never).

    ``start`` is the step of the log of the first action.
    """
    step = start + np.arange(actions.shape[1])
    before_crash = (crash_step[:, None] < 0) | (step < crash_step[:, None])
    return np.where(before_crash[..., None], actions, np.nan)


def action_jerk(actions: Float[np.ndarray, "episode step D"]) -> Float64[np.ndarray, " episode"]:
    """Return the standard deviation of the change of the action from step to step; NaN with fewer than two actions.

    This is ``sqrt(mean_d var_t(a[t + 1, d] - a[t, d]))`` with the population variance, in units of the action space.
    NaN actions are ignored. A ramp has 0; uniform random actions in [-1, 1] have about ``sqrt(2 / 3) = 0.82``.
    """
    change = np.diff(np.asarray(actions, np.float64), axis=1)
    with warnings.catch_warnings():
        # NumPy warns about episodes with fewer than two actions.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.sqrt(np.nanvar(change, axis=1).mean(axis=-1))


@partial(jax.jit, static_argnames="seed")
def _batch(bank: ScenarioBank, rows: Int[Array, " W"], seed: int) -> tuple[ScenarioBank, Array]:
    """Return the scenarios ``rows`` of a bank as a bank, and their random keys."""
    batch = bank.part(rows)
    return batch, episode_keys(batch, jnp.arange(len(rows)), seed)


def _check_starts(
    names: Names, steps: Int[np.ndarray, " n"], present: Bool[np.ndarray, " n"], start_step: int
) -> None:
    """Check that logs are long enough, and contain ego at the start step and an action after it."""
    ids = [row["scenario_id"] for row in names]
    if (short_rows := np.flatnonzero(steps < LEAST_STEPS)).size:
        first = short_rows[0]
        problem = f"{too_short(int(steps[first]))}; {len(short_rows)} of {len(names)} scenarios are too short"
        cure = "exclude them with --filter flag!=NO_FUTURE"
        raise DataError(problem, record=ids[first], cure=cure)
    has_ended = start_step >= steps - 1
    for is_unusable, reason in (
        (has_ended, "the log has no action after"),
        (~present, "ego is not in the log at"),
    ):
        if rows := np.flatnonzero(is_unusable).tolist():
            problem = f"{reason} step {start_step} in {len(rows)} of {len(names)} scenarios"
            exclude = f", or exclude them: --filter 'scenario_id!={'|'.join(ids[row] for row in rows)}'"
            cure = "start at another step" + (exclude if len(rows) <= _MAX_NAMED else "")
            raise UsageError(problem, record=ids[rows[0]], cure=cure)


def _check_finite(episodes: Episodes, names: Names) -> None:
    """Check that ego's motion is finite.

    Raises:
        DrivaxError: It is not. All executed actions were finite, so the action space or the traffic is defective.
    """
    invalid = np.flatnonzero(~np.isfinite(episodes.motion).all(axis=(1, 2)))
    if invalid.size:
        problem, record = f"ego's motion is not finite in {invalid.size} scenarios", names[int(invalid[0])]
        cure = "check the action space and the traffic"
        raise DrivaxError(problem, record=record["scenario_id"], cure=cure)
