"""Audit scenarios: replay each log through the metrics. Any violation of the expert is a defect of map or converter.

Steps without a logged ego are not evaluated; :data:`~drivax.scenario.select.selection.FINDINGS` explains each finding.
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
from drivax.tasks.actions import PHYSICAL, PUBLISHED

Finding = dict[str, float | int | bool | str | None]

#: Logs per batch.
BATCH = 64
#: Agents that drive further backwards, or this far and hardly forwards, do not manoeuvre: their headings are wrong by
#: pi. Slower motion is jitter.
REVERSE_M, MOSTLY_REVERSE_M, MOSTLY, CREEP_MPS = 20.0, 5.0, 0.9, 0.5
_DRIVERS = (AgentKind.VEHICLE, AgentKind.CYCLIST)
#: A route leads to the goal when the log ends within this distance of it (semantics, ``reached_goal``).
GOAL_M = 3.0
_READ = (
    "collision", "offroad", "left_map", "red_light", "ignored", "moved_m", "route_deviation_m", "goal_distance_m",
    "logged", "log_divergence_m",
)  # fmt: skip
#: Action spaces whose bounds the audit compares with the log.
_SPACES = {"clipped_physical": PHYSICAL, "clipped_published": PUBLISHED}


def scenario_names(scenarios: Sequence[Scenario]) -> list[dict[str, str]]:
    """Return ``dataset``, ``scenario_id`` and ``segment`` of scenarios, the keys of tables."""
    return [{name: s.text(name) for name in ("dataset", "scenario_id", "segment")} for s in scenarios]


def audit(scenarios: Sequence[Scenario]) -> list[Finding]:
    """Replay the logs of scenarios of one capacity exactly, from the current step to their end.

    Returns:
        Findings by name, one mapping per scenario. None means not applicable (a route deviation without a route);
        logs that are too short to evaluate get only findings that need no replay.
    """
    futures = [scenario.steps >= LEAST_STEPS for scenario in scenarios]
    usable = [scenario for scenario, future in zip(scenarios, futures, strict=True) if future]
    batches = (usable[first : first + BATCH] for first in range(0, len(usable), BATCH))
    replayed = iter([row for batch in batches for row in _replay_batch(batch)])
    pairs = zip(scenarios, futures, strict=True)
    return [(next(replayed) if future else {}) | _static_findings(scenario) for scenario, future in pairs]


def _static_findings(scenario: Scenario) -> Finding:
    """Return findings that need no replay."""
    flags = scenario.has
    return {
        "lights_seen": int((scenario.light_state >= 0).any(axis=0).sum()),
        "default_sizes": Flag.DEFAULT_SIZES in flags,
        "velocity": "differentiated" if Flag.DIFFERENTIATED_VELOCITY in flags else "measured",
        "dt_jitter": Flag.JITTERED_TIME in flags,
    }


class _Watch:
    """A task without observation, reward, metrics and termination, which keeps the program small."""

    reads = frozenset(_READ)

    def motion(self, motion: Array, action: Array, length: Any) -> Array:
        return PHYSICAL.move(motion, action, length)

    def actuate(self, motion: Array, action: Array, last: Array, length: Any) -> Array:
        return PHYSICAL.actuate(motion, action, last, length)

    def coast(self, motion: Array, length: Any) -> Array:
        return jnp.zeros(2)

    def first_action(self, history: Array, length: Any) -> Array:
        return PHYSICAL.first(history, length)

    def observe(
        self, bank: ScenarioBank, context: AgentContext, agents: Any, frame: Frame
    ) -> Mapping[str, Any]:
        return {}

    def reward(self, before: Facts, now: Facts, around: Surroundings) -> dict[str, Array]:
        return {}

    def check_end(self, bank: ScenarioBank, context: AgentContext, facts: Facts) -> tuple[Array, Array]:
        return jnp.zeros((), bool), jnp.zeros((), bool)

    def episode_start(self) -> None:
        pass

    def episode_add(self, episode: Any, situation: Situation, start: Array, final: Array) -> None:
        pass


@partial(jax.jit, static_argnames="driven")
def replay(bank: ScenarioBank, index: Int[Array, " B"], driven: bool = False) -> dict[str, Array]:
    """Return facts of scenarios (rows of the bank) from the current step on, ``[B, T - 10]`` each.

    By the names of ``simulator.types.Facts``; ``clipped_<space>``: the action that follows the log to this step is
    outside of an action space. With ``driven``, ego follows the log through the dynamics instead of being put there.
    """
    simulator = Simulator(_Watch())

    def step(state: SimState, _: None) -> tuple[SimState, dict[str, Array]]:
        action = jnp.clip(expert_action(bank, state.context, PHYSICAL), -1.0, 1.0)
        if driven:
            after, _transition = simulator.step(bank, state, action)
        else:
            logged = logged_motion(bank, state.context, 1)
            after, _transition = simulator.replay(bank, state, logged, action)
        clipped = {
            name: space.exceeds_bounds(expert_action(bank, state.context, space))
            for name, space in _SPACES.items()
        }
        return after, _read(after.facts) | clipped

    def episode(row: Array) -> dict[str, Array]:
        start = simulator.reset(bank, row)
        first = _read(start.facts) | dict.fromkeys(_SPACES, jnp.zeros((), bool))
        _, later = jax.lax.scan(step, start, None, length=bank.steps - 1 - CURRENT_STEP)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)

    return jax.vmap(episode)(index)


def _read(facts: Facts) -> dict[str, Array]:
    return {name: getattr(facts, name) for name in _READ}


def _replay_batch(scenarios: Sequence[Scenario]) -> list[Finding]:
    """Return findings of one batch, padded and not trimmed, so that one compiled program serves every batch."""
    filled = [*scenarios, *[scenarios[-1]] * (BATCH - len(scenarios))]
    bank = ScenarioBank.from_scenarios(filled, trim=False)
    series = jax.tree.map(np.asarray, replay(bank, jnp.arange(BATCH)))
    return [
        _findings(scenario, {name: values[row] for name, values in series.items()})
        for row, scenario in enumerate(scenarios)
    ]


def _findings(scenario: Scenario, series: Mapping[str, np.ndarray[Any, Any]]) -> Finding:
    """Return findings of one replay; entry 0 of the series, the current step, counts only for ``first_*_step``."""
    flags, logged = scenario.has, series["logged"]
    evaluated = logged.copy()
    evaluated[0] = False
    mapped = int(scenario.segment_blocks[2]) > 0
    hit, off, red = (series[name] & evaluated for name in ("collision", "offroad", "red_light"))
    deviation = series["route_deviation_m"][evaluated] if Flag.ROUTE in flags else np.zeros(0)
    ran_red = bool(red.any()) if Flag.LIGHTS in flags else None
    reached = bool((series["goal_distance_m"][evaluated][-1:] <= GOAL_M).all())
    backwards, forwards = _driven_m(scenario)
    mostly = backwards > np.maximum(MOSTLY_REVERSE_M, MOSTLY * (backwards + forwards))
    reverses = (backwards > REVERSE_M) | mostly
    return {
        "log_collides": bool(hit.any()),
        "first_collision_step": _first(hit),
        "log_offroad_fraction": _rounded(off[evaluated].mean(), 4) if mapped and evaluated.any() else None,
        "first_offroad_step": _first(off) if mapped else None,
        "first_onroad_step": _first(logged & ~series["offroad"] & ~series["left_map"]) if mapped else None,
        "log_left_map": bool((series["left_map"] & evaluated).any()) if mapped else None,
        "log_runs_red": ran_red,
        "distance_m": _rounded(series["moved_m"][evaluated].sum()),
        "reverse_m": _rounded(backwards[0]),
        "log_reverses": bool(reverses[0]),
        "agents_reversing": int(reverses[1:].sum()),
        "route_deviation_mean_m": _rounded(deviation.mean()) if len(deviation) else None,
        "route_deviation_max_m": _rounded(deviation.max()) if len(deviation) else None,
        "route_reaches_goal": reached if len(deviation) else None,
        "ignored_overlaps": int(series["ignored"].max()),
        **{name: _share(series[name], evaluated) for name in _SPACES},
        "clean": not hit.any() and not off.any() and not ran_red and not reverses[0] if mapped else None,
    }


def _driven_m(scenario: Scenario) -> Float[np.ndarray, "2 agent"]:
    """Return how far vehicles and cyclists drive against and along their heading after the current step, metres."""
    now = slice(CURRENT_STEP, int(scenario.steps))
    valid, heading = scenario.agent_valid[now], scenario.agent_heading[now][:-1]
    step = np.diff(scenario.agent_xy[now].astype(np.float64), axis=0)
    along = step[..., 0] * np.cos(heading) + step[..., 1] * np.sin(heading)
    counted = valid[1:] & valid[:-1] & np.isin(scenario.agent_kind, _DRIVERS)
    return np.stack(
        [
            np.where(counted & (sign * along > CREEP_MPS * DT_S), sign * along, 0.0).sum(axis=0)
            for sign in (-1, 1)
        ]
    )


def _share(clipped: np.ndarray[Any, Any], evaluated: np.ndarray[Any, Any]) -> float | None:
    """Return the share of steps from an evaluated (or the current) step whose action a space clips."""
    steps = evaluated.copy()
    steps[2:] &= evaluated[1:-1]
    return _rounded(clipped[steps].mean(), 4) if steps.any() else None


def _first(holds: np.ndarray[Any, Any]) -> int | None:
    """Return the first step of the log at which a condition holds."""
    return CURRENT_STEP + int(holds.argmax()) if holds.any() else None


def _rounded(value: Any, digits: int = 3) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
