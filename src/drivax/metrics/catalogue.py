"""Specification of the episode metrics (unit, direction, operator, definition, requirements), and the scores.

:func:`select_metrics` selects metrics by name, with the step values and facts that they need.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from types import MappingProxyType
from typing import Any, Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from drivax.errors import UsageError, did_you_mean
from drivax.metrics.steps import STEP_VALUES, StepValue, Value
from drivax.plugins import find_named, is_dotted
from drivax.scenario.bank.queries import is_mapped
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, Flag
from drivax.simulator.contact import TTC_HORIZON_S
from drivax.simulator.types import FACTS

#: How the step values of an episode are reduced: ``any`` and ``first`` look for values above 0, ``worst_second`` is the
#: largest sum over ten consecutive steps.
Operator = Literal["any", "sum", "mean", "min", "max", "last", "first", "worst_second"]
#: Operators for which the step of a value matters; delayed values arrive several at once.
_ORDERED = ("last", "first", "worst_second")
#: ``rate``: 0 or 1 per episode (Wilson's interval); ``score``: its interval is kept within 0 and 1; ``code``: no mean.
Kind = Literal["rate", "score", "quantity", "code"]
Direction = Literal["low", "high", "-"]
#: Selection in a configuration: the name of a set, or names of sets, metrics and user-defined metrics.
MetricNames = str | tuple[str, ...]


@dataclass(frozen=True)
class Column:
    """Description of a column of ``episodes.csv`` for tables and reports.

    Attributes:
        unit: Unit, ``-`` for shares and booleans.
        better: ``low``, ``high``, or ``-`` for neither.
        definition: One line for tables and reports.
        label: Heading; by default the name of the metric with spaces for underscores.
        kind: Scale of the values.
        headline: Position in printed summaries and the first table of a report; None if it is in neither.
        summarised: Whether the mean over episodes is reported.
        fails_on_crash: Whether the value is 0 if the planner crashed.

    Of user-defined metrics, evaluations store unit, direction and definition, and ignore the other attributes.
    """

    unit: str
    better: Direction
    definition: str
    label: str | None = None
    kind: Kind = "quantity"
    headline: int | None = None
    summarised: bool = True
    fails_on_crash: bool = False


@dataclass(frozen=True)
class Metric(Column):
    """A metric of an episode: a step value reduced by an operator, a function of other metrics, or both.

    Attributes:
        needs: Scenario flags without which the metric is undefined.
        step_value: The accumulated step value.
        operator: Operator that reduces the step values.
        inputs: Metrics that ``compute`` reads.
        compute: ``(episode end, accumulated value, inputs) -> Value``; the accumulated value is undefined without
            ``step_value``.
    """

    needs: Flag = Flag.NONE
    step_value: StepValue | None = None
    operator: Operator | None = None
    inputs: tuple[str, ...] = ()
    compute: Callable[[Any, Value, Any], Value] | None = None

    def __post_init__(self) -> None:
        if (self.step_value is None) != (self.operator is None):
            raise ValueError("a metric needs step_value and operator together")
        if self.step_value is None and self.compute is None:
            raise ValueError("a metric needs step_value or compute")
        if self.better not in get_args(Direction):
            raise ValueError(f"better is {self.better!r}; use one of {', '.join(get_args(Direction))}")
        if self.operator not in (None, *get_args(Operator)):
            raise ValueError(f"operator is {self.operator!r}; use one of {', '.join(get_args(Operator))}")
        if self.step_value is not None and self.step_value.delayed and self.operator in _ORDERED:
            problem = f"operator {self.operator!r} does not fit {self.step_value.name!r}, which is delayed"
            raise ValueError(f"{problem}; use any, sum, mean, min or max")


@record
class EpisodeEnd:
    """End of an episode: its scenario, start step, number of steps, and row of its route in the bank."""

    bank: ScenarioBank
    index: Int[Array, ""]
    start: Int[Array, ""]
    steps: Int[Array, ""]
    row: Int[Array, ""]


#: Values of a metric's inputs by name.
Inputs = Mapping[str, Value]
#: Weights and gates of the two scores.
NUPLAN_WEIGHTS = {"ttc_ok": 5.0, "progress_ratio": 5.0, "speed_compliance": 4.0, "comfortable": 2.0}
VMAX_WEIGHTS = {**NUPLAN_WEIGHTS, "lane_keeping": 3.0}
NUPLAN_GATES = ("at_fault_collision", "offroad")
VMAX_GATES = (*NUPLAN_GATES, "red_light")
_MULTIPLIERS = ("making_progress", "direction")
NUPLAN_INPUTS = (*NUPLAN_WEIGHTS, *NUPLAN_GATES, *_MULTIPLIERS)
VMAX_INPUTS = (*VMAX_WEIGHTS, *VMAX_GATES, *_MULTIPLIERS)
#: Smallest safe time to collision, and mean speeding at which compliance is 0 (nuPlan).
_SAFE_TTC_S, _SPEEDING_MPS = 0.95, 2.23
#: A log stands if it gains less than the first distance, and moves if it drives more than the second, m.
_STANDS_M, _MOVES_M = 0.5, 5.0
#: The goal is reached within this distance, m, or from this progress ratio on.
_GOAL_M, _GOAL_RATIO = 3.0, 0.95


def _boolean(value: Bool[Array, ""], defined: Any = True) -> Value:
    return Value(value.astype(jnp.float32), jnp.asarray(defined))


def _grade(name: str, good: float, fair: float, end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    """Return 1 for an input ``name`` up to ``good``, 0.5 up to ``fair``, else 0."""
    grade = jnp.where(inputs[name].value <= good, 1.0, jnp.where(inputs[name].value <= fair, 0.5, 0.0))
    return Value(grade, inputs[name].defined)


def _at_least(name: str, threshold: float, end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    return _boolean(inputs[name].value >= threshold, inputs[name].defined)


def _if_mapped(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    return Value(value.value, value.defined & is_mapped(end.bank, end.index))


def _steps(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    return Value(end.steps.astype(jnp.float32), jnp.ones((), bool))


def _last_step(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    return Value(end.bank.last_step[end.row].astype(jnp.float32), jnp.ones((), bool))


def _progress(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    start = end.bank.log_progress[end.row, end.start]
    return Value(jnp.where(end.steps > 0, value.value - start, 0.0), value.defined)


def _progress_ratio(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    log_progress = end.bank.log_progress[end.row]
    log_gain = log_progress[end.bank.last_step[end.row]] - log_progress[end.start]
    gain = inputs["progress"]
    ratio = jnp.where(
        log_gain < _STANDS_M, 1.0, jnp.clip(gain.value / jnp.maximum(log_gain, _STANDS_M), 0.0, 1.0)
    )
    return Value(ratio, gain.defined)


def _log_lead(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    """Return the area between the progress of ego and of the log over time, per metre that the log gains."""
    log_progress = end.bank.log_progress[end.row]
    step = jnp.arange(log_progress.shape[0]) - end.start
    log_sum = jnp.sum(jnp.where((step > 0) & (step <= end.steps), log_progress, 0.0))
    gain = log_progress[end.start + end.steps] - log_progress[end.start]
    area = (value.value * end.steps - log_sum) * DT_S
    return Value(area / jnp.maximum(gain, _STANDS_M), value.defined & (gain >= _STANDS_M))


def _reached_goal(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    is_near = inputs["goal_distance"].value <= _GOAL_M
    return _boolean(
        is_near | (inputs["progress_ratio"].value >= _GOAL_RATIO), inputs["progress_ratio"].defined
    )


def _ttc_ok(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    # A car that never moves is safe; its time to collision is undefined.
    min_ttc = inputs["min_ttc"]
    safe = jnp.where(min_ttc.defined, min_ttc.value, TTC_HORIZON_S) >= _SAFE_TTC_S
    return _boolean(safe, end.steps > 0)


def _speed_compliance(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    mean = inputs["speeding_mean"]
    return Value(jnp.maximum(0.0, 1.0 - mean.value / _SPEEDING_MPS), mean.defined)


def _accuracy(collision: str, end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    """Return whether there is no ``collision`` (name of a metric), off-road step or known red light."""
    runs_red = inputs["red_light"].defined & (inputs["red_light"].value > 0)
    clean = ~(inputs[collision].value > 0) & ~(inputs["offroad"].value > 0) & ~runs_red
    return _boolean(clean, inputs[collision].defined & inputs["offroad"].defined)


def _success(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    clean, reaches_goal = inputs["accuracy"], inputs["reached_goal"]
    return _boolean((clean.value > 0) & (reaches_goal.value > 0), clean.defined & reaches_goal.defined)


def _success_moving(end: EpisodeEnd, value: Value, inputs: Inputs) -> Value:
    moves = end.bank.log_ahead[end.row, end.start] > _MOVES_M
    return Value(inputs["success"].value, inputs["success"].defined & moves)


def score(metrics: Inputs, weights: Mapping[str, float], gates: tuple[str, ...]) -> tuple[Value, Value]:
    """Return a full and a partial score: a weighted mean of metrics, times the gates.

    Gates multiply the mean by 1 minus their value; progress and direction multiply it by their value. The full score
    is defined if all inputs are. The partial score is defined if some input is not and some term of the mean is:
    undefined terms are removed from the mean, and undefined factors count as 1.
    """
    terms = jnp.stack([jnp.clip(metrics[name].value, 0.0, 1.0) for name in weights])
    term_defined = jnp.stack([metrics[name].defined for name in weights])
    weight = jnp.asarray(list(weights.values()))[(...,) + (None,) * (terms.ndim - 1)] * term_defined
    total = weight.sum(axis=0)
    mean = (weight * terms).sum(axis=0) / jnp.maximum(total, 1e-9)
    complete = term_defined.all(axis=0)
    factors = {name: 1.0 - metrics[name].value for name in gates}
    factors |= {name: metrics[name].value for name in _MULTIPLIERS}
    for name, factor in factors.items():
        mean = mean * jnp.where(metrics[name].defined, factor, 1.0)
        complete = complete & metrics[name].defined
    return Value(mean, complete), Value(mean, ~complete & (total > 0))


def nuplan_score(metrics: Inputs) -> tuple[Value, Value]:
    """Return nuPlan's closed-loop score, full and partial."""
    return score(metrics, NUPLAN_WEIGHTS, NUPLAN_GATES)


def vmax_score(metrics: Inputs) -> tuple[Value, Value]:
    """Return the V-Max score, full and partial: nuPlan's terms and lane keeping, with red lights as another gate."""
    return score(metrics, VMAX_WEIGHTS, VMAX_GATES)


def _score(function: Callable[[Inputs], tuple[Value, Value]], index: int) -> Callable[..., Value]:
    """Return ``Metric.compute`` for the full (0) or partial (1) value of a score."""
    return lambda end, value, inputs: function(inputs)[index]


def _step_metric(
    step_value: str, operator: Operator, unit: str, better: Direction, definition: str, **options: Any
) -> Metric:
    return Metric(unit, better, definition, step_value=STEP_VALUES[step_value], operator=operator, **options)


def _derived_metric(
    compute: Callable[..., Value], inputs: tuple[str, ...], better: Direction, definition: str, **options: Any
) -> Metric:
    return Metric("-", better, definition, inputs=inputs, compute=compute, **options)


_LANES, _ROUTE = Flag.LANE_GRAPH, Flag.ROUTE
_RATE = {"kind": "rate"}
_OUTCOME = {"kind": "rate", "fails_on_crash": True}
_SCORE = {"kind": "score", "fails_on_crash": True}

# fmt: off
METRICS: dict[str, Metric] = {
    "accuracy": _derived_metric(
        partial(_accuracy, "collision"), ("collision", "offroad", "red_light"), "high",
        "no collision, not off the road, no red light run", headline=3, **_OUTCOME),
    "accuracy_at_fault": _derived_metric(
        partial(_accuracy, "at_fault_collision"), ("at_fault_collision", "offroad", "red_light"), "high",
        "no at-fault collision, not off the road, no red light run", label="accuracy, at-fault only", **_OUTCOME),
    "success": _derived_metric(
        _success, ("accuracy", "reached_goal"), "high", "accuracy and the goal reached", headline=1, **_OUTCOME),
    "success_moving": _derived_metric(
        _success_moving, ("success",), "high", "success where the log drives more than 5 m",
        label="success, moving", headline=2, **_OUTCOME),
    "vmax_score": _derived_metric(
        _score(vmax_score, 0), VMAX_INPUTS, "high", "safety gates times ttc, progress, speed, lanes and comfort",
        label="V-Max score", headline=11, **_SCORE),
    "nuplan_score": _derived_metric(
        _score(nuplan_score, 0), NUPLAN_INPUTS, "high", "nuPlan's closed-loop score by our definitions",
        label="nuPlan-style score", headline=12, **_SCORE),
    "vmax_score_partial": _derived_metric(
        _score(vmax_score, 1), VMAX_INPUTS, "high", "vmax_score where an input is undefined",
        label="partial V-Max score", **_SCORE),
    "nuplan_score_partial": _derived_metric(
        _score(nuplan_score, 1), NUPLAN_INPUTS, "high", "nuplan_score where an input is undefined",
        label="partial nuPlan-style score", **_SCORE),
    "collision": _step_metric("collision", "any", "-", "low", "boxes overlap", headline=4, **_RATE),
    "at_fault_collision": _step_metric(
        "at_fault_collision", "any", "-", "low", "a collision that is ego's fault by nuPlan's rules",
        label="at-fault collision", headline=5, **_RATE),
    "collision_type": _step_metric(
        "collision_type", "first", "-", "-", "kind of the first collision", kind="code", summarised=False),
    "offroad": _step_metric(
        "offroad", "any", "-", "low", "a corner more than 0.3 m off the road",
        label="off-road", headline=6, compute=_if_mapped, **_RATE),
    "left_map": _step_metric(
        "left_map", "any", "-", "low", "left the mapped area", label="left the map", compute=_if_mapped, **_RATE),
    "red_light": _step_metric(
        "red_light", "any", "-", "low", "ran a red light", needs=Flag.LIGHTS, headline=7, **_RATE),
    "min_ttc": _step_metric("ttc", "min", "s", "high", "smallest time to collision, at most 5", label="minimum TTC"),
    "average_ttc": _step_metric("ttc", "mean", "s", "high", "mean time to collision", label="mean TTC"),
    "ttc_ok": _derived_metric(
        _ttc_ok, ("min_ttc",), "high", "time to collision always at least 0.95 s", label="TTC ok", headline=9, **_RATE),
    "comfort": _step_metric("comfort", "mean", "-", "high", "share of steps within nuPlan's limits"),
    "comfortable": _derived_metric(
        partial(_at_least, "comfort", 1.0 - 1e-6), ("comfort",), "high", "every step within nuPlan's limits",
        headline=10, **_RATE),
    "max_jerk": _step_metric("jerk", "max", "m/s3", "low", "largest jerk magnitude"),
    "max_lateral_acceleration": _step_metric(
        "lateral_acceleration", "max", "m/s2", "low", "largest lateral acceleration"),
    "speeding_mean": _step_metric("speeding", "mean", "m/s", "low", "mean speed above the limit"),
    "speeding_max": _step_metric("speeding", "max", "m/s", "low", "largest speed above the limit"),
    "speed_compliance": _derived_metric(
        _speed_compliance, ("speeding_mean",), "high", "1 - mean speeding / 2.23 m/s, at least 0"),
    "wrong_way": _step_metric("wrong_way", "sum", "m", "low", "distance driven against traffic", needs=_LANES),
    "wrong_way_worst": _step_metric(
        "wrong_way", "worst_second", "m", "low", "most distance against traffic within 1 s",
        label="wrong way within 1 s", needs=_LANES),
    "direction": _derived_metric(
        partial(_grade, "wrong_way_worst", 2.0, 6.0), ("wrong_way_worst",), "high",
        "1 up to 2 m against traffic within 1 s, 0.5 up to 6 m, else 0"),
    "lane_straddle": _step_metric(
        "lane_straddle", "sum", "s", "low", "time across the border of ego's lanes", needs=_LANES),
    # A margin of 1 ms absorbs the rounding of sums of 0.1 s in float32.
    "lane_keeping": _derived_metric(
        partial(_grade, "lane_straddle", 3.401, 5.701), ("lane_straddle",), "high",
        "1 up to 3.4 s of straddling, 0.5 up to 5.7 s, else 0"),
    "progress": _step_metric(
        "progress", "last", "m", "high", "distance gained along the route",
        label="progress along the route", needs=_ROUTE, compute=_progress),
    "progress_ratio": _derived_metric(
        _progress_ratio, ("progress",), "high", "progress as a share of the log's", label="progress", headline=8),
    "making_progress": _derived_metric(
        partial(_at_least, "progress_ratio", 0.2), ("progress_ratio",), "high", "progress ratio at least 0.2", **_RATE),
    "route_deviation_mean": _step_metric(
        "route_deviation", "mean", "m", "low", "mean distance to the route", needs=_ROUTE),
    "route_deviation_max": _step_metric(
        "route_deviation", "max", "m", "low", "largest distance to the route", needs=_ROUTE),
    "off_route": _step_metric(
        "off_route", "any", "-", "low", "left the lanes of the route", needs=_ROUTE | _LANES, **_RATE),
    "ade": _step_metric("log_divergence", "mean", "m", "-", "mean distance to the logged position", label="ADE"),
    "fde": _step_metric(
        "log_divergence", "last", "m", "-", "distance to the logged position at the end", label="FDE"),
    "goal_distance": _step_metric(
        "goal_distance", "last", "m", "low", "distance to the goal at the end", needs=_ROUTE),
    "reached_goal": _derived_metric(
        _reached_goal, ("goal_distance", "progress_ratio"), "high",
        "within 3 m of the goal, or progress ratio at least 0.95", label="goal reached", **_RATE),
    "distance": _step_metric("distance", "sum", "m", "-", "distance driven"),
    "ignored_overlaps": _step_metric(
        "ignored", "max", "-", "-", "most agents at a step that have overlapped ego since they appeared"),
    "steps": _derived_metric(_steps, (), "-", "steps driven", summarised=False),
    "last_step": _derived_metric(_last_step, (), "-", "last step of the log", summarised=False),
    "log_lead": _step_metric(
        "progress", "mean", "s", "-", "mean time ahead of the log, over the metres that it drives",
        label="mean lead on the log", needs=_ROUTE, compute=_log_lead),
}
# fmt: on
#: Metrics whose values are codes.
CODES = ("collision_type",)
#: Metrics whose first step is stored.
EVENTS = ("collision", "offroad", "red_light")
#: Metrics of training logs; they need no fault classification, time to collision, comfort or speed limits.
TRAINING = (
    "success", "success_moving", "accuracy", "collision", "offroad", "left_map", "red_light", "off_route",
    "progress", "progress_ratio", "making_progress", "reached_goal", "goal_distance", "distance", "steps",
)  # fmt: skip
#: Metric sets by name.
SETS: dict[str, tuple[str, ...]] = {"none": (), "training": TRAINING, "full": tuple(METRICS)}


def headline(columns: Mapping[str, Column]) -> tuple[str, ...]:
    """Return the names of the headline columns in the order of the first table."""
    ranks = {name: column.headline for name, column in columns.items() if column.headline is not None}
    return tuple(sorted(ranks, key=ranks.__getitem__))


def names_of(columns: Mapping[str, Column], *kinds: Kind) -> tuple[str, ...]:
    """Return the names of the columns of the given kinds."""
    return tuple(name for name, column in columns.items() if column.kind in kinds)


@dataclass(frozen=True, eq=False)
class MetricSelection:
    """Metrics of a task, cached by :func:`select_metrics`, since compiled programs compare selections by identity.

    Attributes:
        names: The requested metrics.
        metrics: The requested metrics and their inputs, inputs first.
        reads: Facts that their step values read; for the full set all of ``FACTS``, so that planners can read them.
    """

    names: tuple[str, ...]
    metrics: tuple[tuple[str, Metric], ...]
    reads: frozenset[str]

    def step_values(self, *operators: Operator) -> tuple[StepValue, ...]:
        """Return the step values that the operators (all by default) accumulate, without duplicates."""
        metrics = [metric for _, metric in self.metrics if not operators or metric.operator in operators]
        return tuple(dict.fromkeys(metric.step_value for metric in metrics if metric.step_value is not None))

    @property
    def events(self) -> tuple[str, ...]:
        """Events whose first step is stored."""
        return tuple(name for name in EVENTS if name in dict(self.metrics))


@cache
def select_metrics(names: MetricNames) -> MetricSelection:
    """Return the metrics that a configuration names: a set, or a tuple of sets, metrics and dotted names.

    The last word of a dotted name (``package.module:name``) is the name of a user-defined metric. Its inputs are
    catalogue metrics, or user-defined metrics before it in the tuple.

    Raises:
        UsageError: A set, metric or input is unknown, a dotted name is not that of a metric, or a name occurs twice.
    """
    requested_names: list[str] = []
    user_metrics: dict[str, Metric] = {}
    for entry in (names,) if isinstance(names, str) else dict.fromkeys(names):
        if is_dotted(entry):
            name = entry.rpartition(":")[2].rpartition(".")[2]
            user_metrics[name] = _user_metric(entry, name, user_metrics)
            requested_names.append(name)
        elif entry in SETS:
            requested_names += SETS[entry]
        elif entry in METRICS:
            requested_names.append(entry)
        else:
            raise UsageError(f"unknown metric {entry!r}", cure=did_you_mean(entry, [*SETS, *METRICS]))
    requested_names = list(dict.fromkeys(requested_names))
    metrics: dict[str, Metric] = {}
    for name in requested_names:
        _add_with_inputs(name, METRICS | user_metrics, metrics)
    values = [metric.step_value for metric in metrics.values() if metric.step_value is not None]
    reads = frozenset[str]().union(*(value.reads for value in values))
    if set(METRICS) <= set(requested_names):
        reads |= FACTS
    return MetricSelection(tuple(requested_names), tuple(metrics.items()), reads)


def metric_specs(names: MetricNames) -> Mapping[str, Metric]:
    """Return the specification of each requested metric by name."""
    selection = select_metrics(names)
    specs = dict(selection.metrics)
    return MappingProxyType({name: specs[name] for name in selection.names})


def _user_metric(entry: str, name: str, others: Mapping[str, Metric]) -> Metric:
    metric = find_named(entry)
    if not isinstance(metric, Metric):
        raise UsageError(f"{entry!r} is not a metric", cure="make it a drivax.metrics.Metric")
    if name in METRICS or name in others:
        raise UsageError(f"{entry!r}: the metric {name!r} already exists", cure="choose another name")
    for input_name in metric.inputs:
        if input_name not in METRICS and input_name not in others:
            problem = f"{entry!r}: unknown input {input_name!r}"
            raise UsageError(problem, cure=did_you_mean(input_name, [*METRICS, *others]))
    return metric


def _add_with_inputs(name: str, specs: Mapping[str, Metric], metrics: dict[str, Metric]) -> None:
    """Add a metric to ``metrics`` after its inputs."""
    if name not in metrics:
        for input_name in specs[name].inputs:
            _add_with_inputs(input_name, specs, metrics)
        metrics[name] = specs[name]
