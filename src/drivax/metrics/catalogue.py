"""All metrics of an episode: what each is called, means and needs, and the named sets of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from drivax.metrics import outcomes
from drivax.metrics.scores import NUPLAN_INPUTS, VMAX_INPUTS, Value
from drivax.metrics.steps import STEP_VALUES, StepValue
from drivax.scenario.schema import Flag

#: How the values of an episode's steps become one: ``worst_second`` is the largest sum over ten steps on end.
Operator = Literal["any", "sum", "mean", "min", "max", "last", "first", "worst_second"]


@dataclass(frozen=True)
class Metric:
    """A metric of an episode: a step value under an operator, something computed from other metrics, or both.

    Attributes:
        unit: Unit, ``-`` for shares and booleans.
        better: ``low``, ``high``, or ``-`` where neither is.
        text: One line for tables and reports.
        needs: Scenario flags without which it is undefined.
        of: The step value that is accumulated.
        operator: How it is.
        inputs: Metrics that ``compute`` reads.
        compute: From the ending, the accumulated value (undefined without ``of``) and the inputs to the metric.
    """

    unit: str
    better: Literal["low", "high", "-"]
    text: str
    needs: Flag = Flag.NONE
    of: StepValue | None = None
    operator: Operator | None = None
    inputs: tuple[str, ...] = ()
    compute: Callable[[Any, Value, Any], Value] | None = None

    def __post_init__(self) -> None:
        if (self.of is None) != (self.operator is None):
            raise ValueError("a step value and its operator come together")
        if self.of is None and self.compute is None:
            raise ValueError("a metric has a step value, or something that computes it")


def _over(
    operator: Operator,
    step: str,
    unit: str,
    better: Literal["low", "high", "-"],
    text: str,
    needs: Flag = Flag.NONE,
) -> Metric:
    return Metric(unit, better, text, needs, STEP_VALUES[step], operator)


_LANES, _ROUTE = Flag.LANE_GRAPH, Flag.ROUTE
_CRASH = ("offroad", "red_light")
METRICS: dict[str, Metric] = {
    "accuracy": Metric(
        "-",
        "high",
        "no collision, not off the road, no red light run",
        inputs=("collision", *_CRASH),
        compute=outcomes.accuracy,
    ),
    "accuracy_at_fault": Metric(
        "-",
        "high",
        "the same, counting only collisions that are ego's fault",
        inputs=("at_fault_collision", *_CRASH),
        compute=outcomes.accuracy_at_fault,
    ),
    "success": Metric(
        "-",
        "high",
        "accuracy and the goal reached",
        inputs=("accuracy", "reached_goal"),
        compute=outcomes.success,
    ),
    "success_moving": Metric(
        "-",
        "high",
        "success where the log drives more than 5 m",
        inputs=("success",),
        compute=outcomes.success_moving,
    ),
    "vmax_score": Metric(
        "-",
        "high",
        "safety gates times ttc, progress, speed, lanes and comfort",
        inputs=VMAX_INPUTS,
        compute=outcomes.full_vmax_score,
    ),
    "nuplan_score": Metric(
        "-",
        "high",
        "nuPlan's closed-loop score",
        inputs=NUPLAN_INPUTS,
        compute=outcomes.full_nuplan_score,
    ),
    "vmax_score_partial": Metric(
        "-",
        "high",
        "vmax_score where an input is undefined",
        inputs=VMAX_INPUTS,
        compute=outcomes.partial_vmax_score,
    ),
    "nuplan_score_partial": Metric(
        "-",
        "high",
        "nuplan_score where an input is undefined",
        inputs=NUPLAN_INPUTS,
        compute=outcomes.partial_nuplan_score,
    ),
    "collision": _over("any", "collision", "-", "low", "boxes overlap"),
    "at_fault_collision": _over(
        "any", "at_fault_collision", "-", "low", "a collision that is ego's fault by nuPlan's rules"
    ),
    "collision_type": _over("first", "collision_type", "-", "-", "kind of the first collision"),
    "offroad": Metric(
        "-",
        "low",
        "a corner more than 0.3 m off the road",
        of=STEP_VALUES["offroad"],
        operator="any",
        compute=outcomes.on_a_map,
    ),
    "left_map": Metric(
        "-",
        "low",
        "left the mapped area",
        of=STEP_VALUES["left_map"],
        operator="any",
        compute=outcomes.on_a_map,
    ),
    "red_light": _over("any", "red_light", "-", "low", "ran a red light", Flag.LIGHTS),
    "min_ttc": _over("min", "ttc", "s", "high", "smallest time to collision, at most 5"),
    "average_ttc": _over("mean", "ttc", "s", "high", "mean time to collision"),
    "ttc_ok": Metric(
        "-",
        "high",
        "time to collision always at least 0.95 s",
        inputs=("min_ttc",),
        compute=outcomes.ttc_ok,
    ),
    "comfort": _over("mean", "comfort", "-", "high", "share of steps within nuPlan's limits"),
    "comfortable": Metric(
        "-",
        "high",
        "every step within nuPlan's limits",
        inputs=("comfort",),
        compute=outcomes.comfortable,
    ),
    "max_jerk": _over("max", "jerk", "m/s3", "low", "largest jerk magnitude"),
    "max_lateral_acceleration": _over(
        "max", "lateral_acceleration", "m/s2", "low", "largest lateral acceleration"
    ),
    "speeding_mean": _over("mean", "speeding", "m/s", "low", "mean speed above the limit"),
    "speeding_max": _over("max", "speeding", "m/s", "low", "largest speed above the limit"),
    "speed_compliance": Metric(
        "-",
        "high",
        "1 - mean speeding / 2.23 m/s, at least 0",
        inputs=("speeding_mean",),
        compute=outcomes.speed_compliance,
    ),
    "wrong_way": _over("sum", "wrong_way", "m", "low", "distance driven against traffic", _LANES),
    "wrong_way_worst": _over(
        "worst_second", "wrong_way", "m", "low", "most distance against traffic within 1 s", _LANES
    ),
    "direction": Metric(
        "-",
        "high",
        "1, 0.5 or 0: at most 2 m, 6 m or more against traffic in 1 s",
        inputs=("wrong_way_worst",),
        compute=outcomes.direction,
    ),
    "lane_straddle": _over(
        "sum", "lane_straddle", "s", "low", "time across the border of ego's lanes", _LANES
    ),
    "lane_keeping": Metric(
        "-",
        "high",
        "1, 0.5 or 0: straddling at most 3.4 s, 5.7 s or longer",
        inputs=("lane_straddle",),
        compute=outcomes.lane_keeping,
    ),
    "progress": Metric(
        "m",
        "high",
        "distance gained along the route",
        _ROUTE,
        STEP_VALUES["progress"],
        "last",
        compute=outcomes.gained,
    ),
    "progress_ratio": Metric(
        "-",
        "high",
        "progress as a share of the log's",
        inputs=("progress",),
        compute=outcomes.progress_ratio,
    ),
    "making_progress": Metric(
        "-",
        "high",
        "progress ratio at least 0.2",
        inputs=("progress_ratio",),
        compute=outcomes.making_progress,
    ),
    "route_deviation_mean": _over(
        "mean", "route_deviation", "m", "low", "mean distance to the route", _ROUTE
    ),
    "route_deviation_max": _over(
        "max", "route_deviation", "m", "low", "largest distance to the route", _ROUTE
    ),
    "off_route": _over("any", "off_route", "-", "low", "left the lanes of the route", _ROUTE | _LANES),
    "ade": _over("mean", "log_divergence", "m", "-", "mean distance to the logged position"),
    "fde": _over("last", "log_divergence", "m", "-", "distance to the logged position at the end"),
    "goal_distance": _over("last", "goal_distance", "m", "low", "distance to the goal at the end", _ROUTE),
    "reached_goal": Metric(
        "-",
        "high",
        "within 3 m of the goal, or progress ratio at least 0.95",
        inputs=("goal_distance", "progress_ratio"),
        compute=outcomes.reached_goal,
    ),
    "distance": _over("sum", "distance", "m", "-", "distance driven"),
    "ignored_overlaps": _over("max", "ignored", "-", "-", "agents ignored because they overlapped at first"),
    "steps": Metric("-", "-", "steps driven", compute=outcomes.steps),
}
#: Events whose first step is kept beside the metrics.
EVENTS = ("collision", "offroad", "red_light")
#: Metrics that are no quantities, so that no mean of them says anything.
CODES = ("collision_type",)
#: What a training loop logs: needs neither contacts' faults, nor time to collision, comfort or limits.
TRAINING = (
    "success", "success_moving", "accuracy", "collision", "offroad", "left_map", "red_light", "off_route",
    "progress", "progress_ratio", "making_progress", "reached_goal", "goal_distance", "distance", "steps",
)  # fmt: skip
#: Metric sets by name.
SETS: dict[str, tuple[str, ...]] = {"none": (), "training": TRAINING, "full": tuple(METRICS)}
