"""Audit scenarios: replay the logged ego and evaluate the episode.

A violation by the logged ego points to a defect of the map or the converter. Steps without a logged ego only count for
``ignored_overlaps``. :data:`~drivax.scenario.select.selection.FINDINGS` explains the findings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from drivax.planners.simple import expert_action, logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP, DT_S, LEAST_STEPS, AgentKind, Flag, Scenario
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import AgentContext, Facts, Frame, SimState, Situation, Surroundings
from drivax.tasks.actions import PHYSICAL, PUBLISHED, execute

Findings = dict[str, float | int | bool | str | None]

#: Logs per batch.
BATCH = 64
#: An agent's heading counts as wrong by pi if it reverses more than 20 m, or more than 5 m and 90 % of its distance.
REVERSE_M, MOSTLY_REVERSE_M, MOSTLY_REVERSE_SHARE = 20.0, 5.0, 0.9
#: Slower motion counts as jitter of the positions.
CREEP_MPS = 0.5
_DRIVERS = (AgentKind.VEHICLE, AgentKind.CYCLIST)
#: Largest distance between the goal of a route and the end of the log that it leads to, m (as for ``reached_goal``).
GOAL_M = 3.0
_FACTS = (
    "collision", "offroad", "left_map", "red_light", "ignored", "moved_m", "route_deviation_m", "goal_distance_m",
    "logged", "log_divergence_m",
)  # fmt: skip
#: Action space by finding; the finding is the share of logged actions outside the bounds of the space.
_ACTION_SPACES = {"clipped_physical": PHYSICAL, "clipped_published": PUBLISHED}


def scenario_names(scenarios: Sequence[Scenario]) -> list[dict[str, str]]:
    """Return ``dataset``, ``scenario_id`` and ``segment`` of each scenario."""
    return [{name: s.text(name) for name in ("dataset", "scenario_id", "segment")} for s in scenarios]


def audit(scenarios: Sequence[Scenario]) -> list[Findings]:
    """Replay the logs of scenarios of one capacity, from the current step to the end.

    Returns:
        Findings of each scenario by name. A finding that does not apply is None (a route deviation without a route).
        Logs that are too short to evaluate only have the findings that need no replay.
    """
    long_enough = [scenario for scenario in scenarios if scenario.steps >= LEAST_STEPS]
    batches = (long_enough[first : first + BATCH] for first in range(0, len(long_enough), BATCH))
    replay_findings = iter([findings for batch in batches for findings in _replay_batch(batch)])
    return [
        (next(replay_findings) if scenario.steps >= LEAST_STEPS else {}) | _static_findings(scenario)
        for scenario in scenarios
    ]


def _static_findings(scenario: Scenario) -> Findings:
    """Return the findings that need no replay."""
    flags = scenario.has
    return {
        "lights_seen": int((scenario.light_state >= 0).any(axis=0).sum()),
        "default_sizes": Flag.DEFAULT_SIZES in flags,
        "velocity": "differentiated" if Flag.DIFFERENTIATED_VELOCITY in flags else "measured",
        "dt_jitter": Flag.JITTERED_TIME in flags,
    }


class _EmptyTask:
    """A task without observations, reward, metrics or termination, which keeps the compiled program small."""

    reads = frozenset(_FACTS)

    def motion(self, motion: Array, action: Array, length: Any) -> Array:
        return PHYSICAL.move(motion, action, length)

    def actuate(self, bank: ScenarioBank, context: AgentContext, action: Array) -> Array:
        return execute(PHYSICAL, bank, context, action)

    def coast(self, bank: ScenarioBank, context: AgentContext) -> Array:
        return jnp.zeros(2)

    def first_action(self, history: Array, length: Any) -> Array:
        return PHYSICAL.first(history, length)

    def draw_conditions(self, slot: Any, key: Any) -> tuple[()]:
        return ()

    def observe(
        self, bank: ScenarioBank, context: AgentContext, frames: Any, frame: Frame
    ) -> Mapping[str, Any]:
        return {}

    def reward(
        self, before: Facts, now: Facts, around: Surroundings, conditions: Any = ()
    ) -> dict[str, Array]:
        return {}

    def check_end(self, bank: ScenarioBank, context: AgentContext, facts: Facts) -> tuple[Array, Array]:
        return jnp.zeros((), bool), jnp.zeros((), bool)

    def episode_start(self) -> None:
        pass

    def episode_add(self, episode: Any, situation: Situation, start: Array, final: Array) -> None:
        pass


@partial(jax.jit, static_argnames="use_dynamics")
def replay(bank: ScenarioBank, index: Int[Array, " B"], use_dynamics: bool = False) -> dict[str, Array]:
    """Return facts of scenarios ``index`` from the current step on, ``[B, T - 10]`` each.

    Keys are names of ``simulator.types.Facts``, and ``clipped_<space>``: whether the logged action that leads to the
    step exceeds the bounds of an action space. Ego is placed at its logged poses; with ``use_dynamics`` it follows the
    log by the dynamics of the action space ``physical``.
    """
    simulator = Simulator(_EmptyTask())

    def step(state: SimState, _: None) -> tuple[SimState, dict[str, Array]]:
        action = jnp.clip(expert_action(bank, state.context, PHYSICAL), -1.0, 1.0)
        if use_dynamics:
            next_state, _transition = simulator.step(bank, state, action)
        else:
            logged_pose = logged_motion(bank, state.context, 1)
            next_state, _transition = simulator.replay(bank, state, logged_pose, action)
        exceeds_bounds = {
            name: space.exceeds_bounds(expert_action(bank, state.context, space))
            for name, space in _ACTION_SPACES.items()
        }
        return next_state, _select_facts(next_state.facts) | exceeds_bounds

    def replay_scenario(scenario: Array) -> dict[str, Array]:
        state = simulator.reset(bank, scenario)
        initial = _select_facts(state.facts) | dict.fromkeys(_ACTION_SPACES, jnp.zeros((), bool))
        _, later = jax.lax.scan(step, state, None, length=bank.steps - 1 - CURRENT_STEP)
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), initial, later)

    return jax.vmap(replay_scenario)(index)


def _select_facts(facts: Facts) -> dict[str, Array]:
    return {name: getattr(facts, name) for name in _FACTS}


def _replay_batch(scenarios: Sequence[Scenario]) -> list[Findings]:
    """Return findings of one batch, padded to ``BATCH`` and not trimmed, so that all batches share one program."""
    batch = [*scenarios, *[scenarios[-1]] * (BATCH - len(scenarios))]
    bank = ScenarioBank.from_scenarios(batch, trim=False)
    series = jax.tree.map(np.asarray, replay(bank, jnp.arange(BATCH)))
    return [
        _replay_findings(scenario, {name: values[index] for name, values in series.items()})
        for index, scenario in enumerate(scenarios)
    ]


def _replay_findings(scenario: Scenario, series: Mapping[str, np.ndarray[Any, Any]]) -> Findings:
    """Return findings of one replay; entry 0, the current step, only counts for ``first_onroad_step`` and overlaps."""
    flags, in_log = scenario.has, series["logged"]
    evaluated = in_log.copy()
    evaluated[0] = False
    has_map = int(scenario.segment_blocks[2]) > 0  # edges and lanes, which come first
    collides, offroad, runs_red = (series[name] & evaluated for name in ("collision", "offroad", "red_light"))
    on_road = in_log & ~series["offroad"] & ~series["left_map"]
    deviation = series["route_deviation_m"][evaluated] if Flag.ROUTE in flags else np.zeros(0)
    log_runs_red = bool(runs_red.any()) if Flag.LIGHTS in flags else None
    reaches_goal = bool((series["goal_distance_m"][evaluated][-1:] <= GOAL_M).all())
    reverse_m, forward_m = _reverse_and_forward_m(scenario)
    mostly_reverses = reverse_m > np.maximum(MOSTLY_REVERSE_M, MOSTLY_REVERSE_SHARE * (reverse_m + forward_m))
    reverses = (reverse_m > REVERSE_M) | mostly_reverses
    violates = collides.any() or offroad.any() or bool(log_runs_red) or reverses[0]
    return {
        "log_collides": bool(collides.any()),
        "first_collision_step": _first_step(collides),
        "log_offroad_fraction": _round(offroad[evaluated].mean(), 4) if has_map and evaluated.any() else None,
        "first_offroad_step": _first_step(offroad) if has_map else None,
        "first_onroad_step": _first_step(on_road) if has_map else None,
        "log_left_map": bool((series["left_map"] & evaluated).any()) if has_map else None,
        "log_runs_red": log_runs_red,
        "distance_m": _round(series["moved_m"][evaluated].sum()),
        "reverse_m": _round(reverse_m[0]),
        "log_reverses": bool(reverses[0]),
        "agents_reversing": int(reverses[1:].sum()),
        "route_deviation_mean_m": _round(deviation.mean()) if len(deviation) else None,
        "route_deviation_max_m": _round(deviation.max()) if len(deviation) else None,
        "route_reaches_goal": reaches_goal if len(deviation) else None,
        "ignored_overlaps": int(series["ignored"].max()),
        **{name: _clipped_share(series[name], evaluated) for name in _ACTION_SPACES},
        "clean": not violates if has_map else None,
    }


def _reverse_and_forward_m(scenario: Scenario) -> Float[np.ndarray, "2 agent"]:
    """Return the distances (m) that vehicles and cyclists drive backwards and forwards after the current step."""
    future = slice(CURRENT_STEP, int(scenario.steps))
    valid, heading = scenario.agent_valid[future], scenario.agent_heading[future][:-1]
    displacement = np.diff(scenario.agent_xy[future].astype(np.float64), axis=0)
    forward_m = displacement[..., 0] * np.cos(heading) + displacement[..., 1] * np.sin(heading)
    included = valid[1:] & valid[:-1] & np.isin(scenario.agent_kind, _DRIVERS)
    distances = (np.where(included, sign * forward_m, 0.0) for sign in (-1, 1))
    return np.stack([np.where(step_m > CREEP_MPS * DT_S, step_m, 0.0).sum(axis=0) for step_m in distances])


def _clipped_share(is_clipped: np.ndarray[Any, Any], evaluated: np.ndarray[Any, Any]) -> float | None:
    """Return the share of clipped actions; only actions between evaluated steps, or from the current step, count."""
    included = evaluated.copy()
    included[2:] &= evaluated[1:-1]
    return _round(is_clipped[included].mean(), 4) if included.any() else None


def _first_step(condition: np.ndarray[Any, Any]) -> int | None:
    """Return the first step of the log at which a condition holds."""
    return CURRENT_STEP + int(condition.argmax()) if condition.any() else None


def _round(value: Any, digits: int = 3) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
