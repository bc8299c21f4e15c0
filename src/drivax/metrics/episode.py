"""Metrics of an episode, accumulated in the graph: situation -> step values -> accumulators -> episode metrics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.metrics.comfort import TAIL, judge_comfort
from drivax.metrics.scores import Value, nuplan_score, vmax_score
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.queries import is_mapped
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, Flag
from drivax.simulator.contact import TTC_HORIZON_S
from drivax.simulator.types import Facts, SimState

#: A value and its weight in this step: 0 where undefined.
_Step = tuple[Float[Array, ""], Float[Array, ""]]
_Operator = Literal["any", "sum", "mean", "min", "max", "last", "first"]


def _always(value: Array) -> _Step:
    return value.astype(jnp.float32), jnp.ones(())


def _speeding(facts: Facts) -> _Step:
    over = jnp.maximum(0.0, facts.speed_mps - facts.limit_mps)
    return jnp.where(facts.limit_mps > 0, over, 0.0), (facts.limit_mps > 0).astype(jnp.float32)


#: What is read off the facts at every step.
STEP_VALUES: dict[str, Callable[[Facts], _Step]] = {
    "collision": lambda f: _always(f.collision),
    "at_fault_collision": lambda f: _always(f.at_fault),
    "collision_type": lambda f: _always(f.collision_type),
    "offroad": lambda f: _always(f.offroad),
    "left_map": lambda f: _always(f.left_map),
    "red_light": lambda f: _always(f.red_light),
    "ttc": lambda f: (f.ttc_s, f.ttc_defined.astype(jnp.float32)),
    "speeding": _speeding,
    "wrong_way": lambda f: _always(jnp.where(f.wrong_way, f.moved_m, 0.0)),
    "lane_straddle": lambda f: _always(f.straddling * DT_S),
    "route_deviation": lambda f: _always(f.route_deviation_m),
    "off_route": lambda f: _always(f.off_route),
    "log_divergence": lambda f: (f.log_divergence_m, f.logged.astype(jnp.float32)),
    "goal_distance": lambda f: _always(f.goal_distance_m),
    "progress": lambda f: _always(f.progress_m),
    "distance": lambda f: _always(f.moved_m),
    "ignored": lambda f: _always(f.ignored),
}
_COMFORT = ("comfort", "jerk", "lateral_acceleration")
_ROWS = {name: row for row, name in enumerate((*STEP_VALUES, *_COMFORT))}
_NEVER = 32767
#: Distance driven against traffic is judged within this many steps (semantics: any 1 s).
_DIRECTION_STEPS = 10


@record
class Episode:
    """Accumulators of one episode; one entry per step value.

    ``weight`` sums the weights of defined steps; ``first`` is the first value above zero and ``first_step`` its step.
    """

    total: Float[Array, "*batch M"]
    weight: Float[Array, "*batch M"]
    low: Float[Array, "*batch M"]
    high: Float[Array, "*batch M"]
    last: Float[Array, "*batch M"]
    first: Float[Array, "*batch M"]
    first_step: Int[Array, "*batch M"]
    wrong_way: Float[Array, "*batch 10"]
    wrong_way_worst: Float[Array, "*batch"]
    steps: Int[Array, "*batch"]


def episode_start() -> Episode:
    """Accumulators of an episode with no step yet."""
    zero, size = jnp.zeros(len(_ROWS)), len(_ROWS)
    return Episode(
        total=zero,
        weight=zero,
        low=jnp.full(size, jnp.inf),
        high=jnp.full(size, -jnp.inf),
        last=zero,
        first=zero,
        first_step=jnp.full(size, _NEVER, jnp.int16),
        wrong_way=jnp.zeros(_DIRECTION_STEPS),
        wrong_way_worst=jnp.zeros(()),
        steps=jnp.zeros((), jnp.int16),
    )


def episode_add(episode: Episode, state: SimState, final: Bool[Array, ""]) -> Episode:
    """Adds the step that led to ``state``; ``final`` judges the comfort of the last steps too."""
    pairs = [read(state.facts) for read in STEP_VALUES.values()]
    value, weight = jnp.stack([v for v, _ in pairs]), jnp.stack([w for _, w in pairs])
    total, high = value * weight, value
    comfort_total, comfort_weight, comfort_high = _comfort(state, final)
    total = jnp.concatenate([total, comfort_total])
    weight = jnp.concatenate([weight, jnp.broadcast_to(comfort_weight, (len(_COMFORT),))])
    high = jnp.concatenate([high, comfort_high])
    counts = weight > 0
    starts = counts & (high > 0) & (episode.first_step == _NEVER)
    wrong_way = jnp.concatenate([episode.wrong_way[1:], value[_ROWS["wrong_way"]][None]])
    return Episode(
        total=episode.total + total,
        weight=episode.weight + weight,
        low=jnp.where(counts, jnp.minimum(episode.low, high), episode.low),
        high=jnp.where(counts, jnp.maximum(episode.high, high), episode.high),
        last=jnp.where(counts, high, episode.last),
        first=jnp.where(starts, high, episode.first),
        first_step=jnp.where(starts, state.scene.step.astype(jnp.int16), episode.first_step),
        wrong_way=wrong_way,
        wrong_way_worst=jnp.maximum(episode.wrong_way_worst, wrong_way.sum()),
        steps=episode.steps + jnp.int16(1),
    )


def _comfort(
    state: SimState, final: Bool[Array, ""]
) -> tuple[Float[Array, " 3"], Float[Array, ""], Float[Array, " 3"]]:
    """Sum over the steps that are judged now, how many they are, and the largest of each comfort value."""
    judged = judge_comfort(state.scene.history)
    step = state.scene.step - (TAIL - 1) + jnp.arange(TAIL)
    counts = (step > state.start) & (final | (jnp.arange(TAIL) == 0))
    rows = jnp.stack([judged.comfortable.astype(jnp.float32), judged.jerk_mps3, judged.lateral_mps2])
    rows = jnp.where(counts, rows, 0.0)
    return rows.sum(axis=1), counts.sum().astype(jnp.float32), rows.max(axis=1)


@dataclass(frozen=True)
class Metric:
    """A column of the episode table.

    Attributes:
        unit: Unit, ``-`` for shares and booleans.
        better: ``low``, ``high``, or ``-`` where neither is.
        needs: Scenario flags without which it is undefined.
        text: One line for tables and reports.
        source, operator: The accumulated step value and how it is read; empty for derived metrics.
    """

    unit: str
    better: Literal["low", "high", "-"]
    text: str
    needs: Flag = Flag.NONE
    source: str = ""
    operator: _Operator | None = None


_LANES, _ROUTE = Flag.LANE_GRAPH, Flag.ROUTE
METRICS: dict[str, Metric] = {
    "accuracy": Metric("-", "high", "no collision, not off the road, no red light run"),
    "accuracy_at_fault": Metric("-", "high", "the same, counting only collisions that are ego's fault"),
    "success": Metric("-", "high", "accuracy and the goal reached", _ROUTE),
    "success_moving": Metric("-", "high", "success where the log drives more than 5 m", _ROUTE),
    "vmax_score": Metric("-", "high", "safety gates times ttc, progress, speed, lanes and comfort", _LANES),
    "nuplan_score": Metric("-", "high", "nuPlan's closed-loop score", _LANES),
    "vmax_score_partial": Metric("-", "high", "vmax_score where an input is undefined"),
    "nuplan_score_partial": Metric("-", "high", "nuplan_score where an input is undefined"),
    "collision": Metric("-", "low", "boxes overlap", source="collision", operator="any"),
    "at_fault_collision": Metric(
        "-",
        "low",
        "a collision that is ego's fault by nuPlan's rules",
        source="at_fault_collision",
        operator="any",
    ),
    "collision_type": Metric(
        "-", "-", "kind of the first collision", source="collision_type", operator="first"
    ),
    "offroad": Metric("-", "low", "a corner more than 0.3 m off the road", source="offroad", operator="any"),
    "left_map": Metric("-", "low", "left the mapped area", source="left_map", operator="any"),
    "red_light": Metric("-", "low", "ran a red light", Flag.LIGHTS, "red_light", "any"),
    "min_ttc": Metric("s", "high", "smallest time to collision, at most 5", source="ttc", operator="min"),
    "average_ttc": Metric("s", "high", "mean time to collision", source="ttc", operator="mean"),
    "ttc_ok": Metric("-", "high", "time to collision always at least 0.95 s"),
    "comfort": Metric(
        "-", "high", "share of steps within nuPlan's limits", source="comfort", operator="mean"
    ),
    "comfortable": Metric("-", "high", "every step within nuPlan's limits"),
    "max_jerk": Metric("m/s3", "low", "largest jerk magnitude", source="jerk", operator="max"),
    "max_lateral_acceleration": Metric(
        "m/s2", "low", "largest lateral acceleration", source="lateral_acceleration", operator="max"
    ),
    "speeding_mean": Metric("m/s", "low", "mean speed above the limit", source="speeding", operator="mean"),
    "speeding_max": Metric("m/s", "low", "largest speed above the limit", source="speeding", operator="max"),
    "speed_compliance": Metric("-", "high", "1 - mean speeding / 2.23 m/s, at least 0"),
    "wrong_way": Metric("m", "low", "distance driven against traffic", _LANES, "wrong_way", "sum"),
    "direction": Metric("-", "high", "1, 0.5 or 0: at most 2 m, 6 m or more against traffic in 1 s", _LANES),
    "lane_straddle": Metric(
        "s", "low", "time across the border of ego's lanes", _LANES, "lane_straddle", "sum"
    ),
    "lane_keeping": Metric("-", "high", "1, 0.5 or 0: straddling at most 3.4 s, 5.7 s or longer", _LANES),
    "progress": Metric("m", "high", "distance gained along the route", _ROUTE),
    "progress_ratio": Metric("-", "high", "progress as a share of the log's", _ROUTE),
    "making_progress": Metric("-", "high", "progress ratio at least 0.2", _ROUTE),
    "route_deviation_mean": Metric(
        "m", "low", "mean distance to the route", _ROUTE, "route_deviation", "mean"
    ),
    "route_deviation_max": Metric(
        "m", "low", "largest distance to the route", _ROUTE, "route_deviation", "max"
    ),
    "off_route": Metric("-", "low", "left the lanes of the route", _ROUTE | _LANES, "off_route", "any"),
    "ade": Metric("m", "-", "mean distance to the logged position", source="log_divergence", operator="mean"),
    "fde": Metric(
        "m", "-", "distance to the logged position at the end", source="log_divergence", operator="last"
    ),
    "goal_distance": Metric("m", "low", "distance to the goal at the end", _ROUTE, "goal_distance", "last"),
    "reached_goal": Metric("-", "high", "within 3 m of the goal, or progress ratio at least 0.95", _ROUTE),
    "distance": Metric("m", "-", "distance driven", source="distance", operator="sum"),
    "ignored_overlaps": Metric(
        "-", "-", "agents ignored because they overlapped at first", source="ignored", operator="max"
    ),
    "steps": Metric("-", "-", "steps driven"),
}
#: Events whose first step is kept beside the metrics.
EVENTS = ("collision", "offroad", "red_light")


def episode_metrics(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    """All metrics of the episode that ``state`` ended, by name."""
    index = state.scene.index
    episode = state.episode
    flags = bank.flags[index]

    def known(needs: Flag) -> Bool[Array, ""]:
        wanted = jnp.uint32(int(needs))
        # The route is ego's; other slots have none.
        return ((flags & wanted) == wanted) & ((Flag.ROUTE not in needs) | (state.scene.slot == 0))

    result = {
        name: Value(value := _read(episode, metric), known(metric.needs) & jnp.isfinite(value))
        for name, metric in METRICS.items()
        if metric.operator is not None
    }
    mapped = is_mapped(bank, index)
    for name in ("offroad", "left_map"):
        result[name] = Value(result[name].value, result[name].defined & mapped)
    result = {name: Value(jnp.where(v.defined, v.value, 0.0), v.defined) for name, v in result.items()}
    result |= _progress(bank, state, known(_ROUTE), result)
    result |= _compliance(episode, result, known(_LANES))
    result |= _outcome(bank, state, result)
    for name, pair in (("nuplan_score", nuplan_score(result)), ("vmax_score", vmax_score(result))):
        result[name], result[f"{name}_partial"] = pair
    result["steps"] = Value(episode.steps.astype(jnp.float32), jnp.ones((), bool))
    return {name: result[name] for name in METRICS}


def _read(episode: Episode, metric: Metric) -> Float[Array, ""]:
    """An accumulated value; not finite where no step defined it."""
    row = _ROWS[metric.source]
    none = episode.weight[row] <= 0
    total, weight = episode.total[row], jnp.maximum(episode.weight[row], 1e-9)
    values: dict[str, Array] = {
        "any": (episode.high[row] > 0).astype(jnp.float32),
        "sum": total,
        "mean": total / weight,
        "min": episode.low[row],
        "max": episode.high[row],
        "last": episode.last[row],
        "first": episode.first[row],
    }
    return jnp.where(none, jnp.inf, values[str(metric.operator)])


def _yes(flag: Bool[Array, ""], defined: Any) -> Value:
    return Value(flag.astype(jnp.float32), jnp.asarray(defined))


def _progress(
    bank: ScenarioBank, state: SimState, routed: Array, known: dict[str, Value]
) -> dict[str, Value]:
    """Progress against the log's own over the whole log."""
    index, episode = state.scene.index, state.episode
    begin = bank.log_progress[index, state.start]
    gained = jnp.where(episode.steps > 0, episode.last[_ROWS["progress"]] - begin, 0.0)
    logged = bank.log_progress[index, -1] - begin
    ratio = jnp.where(logged < 0.5, 1.0, jnp.clip(gained / jnp.maximum(logged, 0.5), 0.0, 1.0))
    reached = (known["goal_distance"].value <= 3.0) | (ratio >= 0.95)
    return {
        "progress": Value(gained, routed),
        "progress_ratio": Value(ratio, routed),
        "making_progress": _yes(ratio >= 0.2, routed),
        "reached_goal": _yes(reached, routed),
    }


def _compliance(episode: Episode, known: dict[str, Value], lanes: Array) -> dict[str, Value]:
    """Metrics in {0, 0.5, 1} or [0, 1] that the scores weigh."""
    everywhere = jnp.ones((), bool)
    straddled, worst = known["lane_straddle"].value, episode.wrong_way_worst
    ttc, comfort = known["min_ttc"], known["comfort"]
    steps = lambda value, good, fair: jnp.where(value <= good, 1.0, jnp.where(value <= fair, 0.5, 0.0))  # noqa: E731
    return {
        # A car that never moved endangered nobody: an empty "always" is true.
        "ttc_ok": _yes(jnp.where(ttc.defined, ttc.value, TTC_HORIZON_S) >= 0.95, everywhere),
        "comfortable": _yes(comfort.value >= 1.0 - 1e-6, comfort.defined),
        "speed_compliance": Value(
            jnp.maximum(0.0, 1.0 - known["speeding_mean"].value / 2.23), known["speeding_mean"].defined
        ),
        "direction": Value(steps(worst, 2.0, 6.0), lanes),
        # Sums of 0.1 s in float32: a hundredth of a step keeps 3.4 s on the right side.
        "lane_keeping": Value(steps(straddled, 3.401, 5.701), lanes),
    }


def _outcome(bank: ScenarioBank, state: SimState, known: dict[str, Value]) -> dict[str, Value]:
    """Accuracy and success. A red light counts where lights are known."""
    ran_red = known["red_light"].defined & (known["red_light"].value > 0)
    offroad = known["offroad"].value > 0
    clean = ~(known["collision"].value > 0) & ~offroad & ~ran_red
    lawful = ~(known["at_fault_collision"].value > 0) & ~offroad & ~ran_red
    success = clean & (known["reached_goal"].value > 0)
    logged = bank.log_ahead[state.scene.index, state.start]
    defined = known["collision"].defined & known["offroad"].defined
    return {
        "accuracy": _yes(clean, defined),
        "accuracy_at_fault": _yes(lawful, defined),
        "success": _yes(success, defined & known["reached_goal"].defined),
        "success_moving": _yes(success, defined & known["reached_goal"].defined & (logged > 5.0)),
    }


def first_steps(episode: Episode) -> dict[str, Int[Array, ""]]:
    """Step of the first collision, off-road step and red light; -1 where there was none."""
    return {
        name: jnp.where(episode.first_step[_ROWS[name]] == _NEVER, -1, episode.first_step[_ROWS[name]])
        for name in EVENTS
    }
