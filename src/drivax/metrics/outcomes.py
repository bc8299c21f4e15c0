"""Metrics that are computed from other metrics when an episode is over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from drivax.metrics.scores import Value, nuplan_score, vmax_score
from drivax.scenario.bank.queries import is_mapped
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.contact import TTC_HORIZON_S

#: Shares of the scores at which time to collision and speeding count (semantics, Metrics).
TTC_OK_S, SPEEDING_MPS = 0.95, 2.23
Known = Mapping[str, Value]


@record
class Ending:
    """The episode that is over: where it was driven, from which step on, and how many steps."""

    bank: ScenarioBank
    index: Int[Array, ""]
    start: Int[Array, ""]
    steps: Int[Array, ""]


def _yes(flag: Bool[Array, ""], defined: Any = True) -> Value:
    return Value(flag.astype(jnp.float32), jnp.asarray(defined))


def _graded(value: Value, good: float, fair: float) -> Value:
    """1 up to ``good``, 0.5 up to ``fair``, else 0."""
    grade = jnp.where(value.value <= good, 1.0, jnp.where(value.value <= fair, 0.5, 0.0))
    return Value(grade, value.defined)


def on_a_map(ending: Ending, own: Value, known: Known) -> Value:
    """Undefined where the scenario has neither edge nor lane."""
    return Value(own.value, own.defined & is_mapped(ending.bank, ending.index))


def steps(ending: Ending, own: Value, known: Known) -> Value:
    """Steps driven."""
    return Value(ending.steps.astype(jnp.float32), jnp.ones((), bool))


def gained(ending: Ending, own: Value, known: Known) -> Value:
    """Progress since the start of the episode; ``own`` is the place along the route at its end."""
    begin = ending.bank.log_progress[ending.index, ending.start]
    return Value(jnp.where(ending.steps > 0, own.value - begin, 0.0), own.defined)


def progress_ratio(ending: Ending, own: Value, known: Known) -> Value:
    """Progress as a share of the log's own over the whole log, in [0, 1]; 1 where the log gained less than 0.5 m."""
    log = ending.bank.log_progress[ending.index]
    logged = log[-1] - log[ending.start]
    gain = known["progress"]
    ratio = jnp.where(logged < 0.5, 1.0, jnp.clip(gain.value / jnp.maximum(logged, 0.5), 0.0, 1.0))
    return Value(ratio, gain.defined)


def making_progress(ending: Ending, own: Value, known: Known) -> Value:
    """Whether the ratio is at least 0.2."""
    return _yes(known["progress_ratio"].value >= 0.2, known["progress_ratio"].defined)


def reached_goal(ending: Ending, own: Value, known: Known) -> Value:
    """Within 3 m of the goal at the end, or a progress ratio of at least 0.95."""
    near = known["goal_distance"].value <= 3.0
    return _yes(near | (known["progress_ratio"].value >= 0.95), known["progress_ratio"].defined)


def ttc_ok(ending: Ending, own: Value, known: Known) -> Value:
    """Whether it was always at least 0.95 s. A car that never moved endangered nobody: an empty "always" is true."""
    least = known["min_ttc"]
    always = jnp.where(least.defined, least.value, TTC_HORIZON_S) >= TTC_OK_S
    return _yes(always, ending.steps > 0)


def comfortable(ending: Ending, own: Value, known: Known) -> Value:
    """Whether every step was comfortable."""
    return _yes(known["comfort"].value >= 1.0 - 1e-6, known["comfort"].defined)


def speed_compliance(ending: Ending, own: Value, known: Known) -> Value:
    """1 - mean speeding / 2.23 m/s, at least 0 (nuPlan)."""
    mean = known["speeding_mean"]
    return Value(jnp.maximum(0.0, 1.0 - mean.value / SPEEDING_MPS), mean.defined)


def direction(ending: Ending, own: Value, known: Known) -> Value:
    """Graded at 2 and 6 m against traffic within one second."""
    return _graded(known["wrong_way_worst"], 2.0, 6.0)


def lane_keeping(ending: Ending, own: Value, known: Known) -> Value:
    """Graded at 3.4 and 5.7 s."""
    # Sums of 0.1 s in float32: a hundredth of a step keeps 3.4 s on the right side.
    return _graded(known["lane_straddle"], 3.401, 5.701)


def _unbroken(known: Known, crash: str) -> Bool[Array, ""]:
    """No crash, not off the road, no red light run; a red light counts where lights are known."""
    ran_red = known["red_light"].defined & (known["red_light"].value > 0)
    return ~(known[crash].value > 0) & ~(known["offroad"].value > 0) & ~ran_red


def accuracy(ending: Ending, own: Value, known: Known) -> Value:
    """No collision, off-road or red light."""
    return _yes(_unbroken(known, "collision"), known["collision"].defined & known["offroad"].defined)


def accuracy_at_fault(ending: Ending, own: Value, known: Known) -> Value:
    """The same, counting only own faults."""
    defined = known["at_fault_collision"].defined & known["offroad"].defined
    return _yes(_unbroken(known, "at_fault_collision"), defined)


def success(ending: Ending, own: Value, known: Known) -> Value:
    """Accuracy, and the goal reached."""
    clean, reached = known["accuracy"], known["reached_goal"]
    return _yes((clean.value > 0) & (reached.value > 0), clean.defined & reached.defined)


def success_moving(ending: Ending, own: Value, known: Known) -> Value:
    """Success where the log drives more than 5 m, so that standing still never succeeds."""
    moves = ending.bank.log_ahead[ending.index, ending.start] > 5.0
    return Value(known["success"].value, known["success"].defined & moves)


def full_vmax_score(ending: Ending, own: Value, known: Known) -> Value:
    """The V-Max aggregate where every input is defined."""
    return vmax_score(known)[0]


def partial_vmax_score(ending: Ending, own: Value, known: Known) -> Value:
    """The V-Max aggregate of what is defined, where some input is not."""
    return vmax_score(known)[1]


def full_nuplan_score(ending: Ending, own: Value, known: Known) -> Value:
    """NuPlan's score where every input is defined."""
    return nuplan_score(known)[0]


def partial_nuplan_score(ending: Ending, own: Value, known: Known) -> Value:
    """NuPlan's score of what is defined, where some input is not."""
    return nuplan_score(known)[1]
