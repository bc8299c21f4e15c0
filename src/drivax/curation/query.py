"""Queries: steps of logs at which an expression over quantities of driving holds.

Expressions contain numbers, the quantities of :data:`QUANTITIES`, ``+ - * /``, comparisons, and ``and``, ``or`` and
``not``. They are parsed and evaluated here; nothing in them is executed by Python.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.curation.kinematic import gaps_on_path
from drivax.curation.logged import LoggedScenario, Numbers
from drivax.errors import UsageError, did_you_mean
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import STOPPED_MPS, TTC_HORIZON_S, nearest_gap, time_to_collision
from drivax.simulator.types import Frame

#: Definition of each quantity of a step; those without an agent are infinite.
QUANTITIES = {
    "speed": "speed, m/s",
    "acceleration": "change of the speed to the next step, m/s2",
    "yaw_rate": "change of the heading to the next step, rad/s",
    "lateral_acceleration": "speed times yaw_rate, m/s2",
    "ttc": "time to collision, s; 5 if no collision is nearer, or at standstill",
    "gap": "gap to the nearest agent ahead on ego's path, m",
    "closing": "speed of approach to that agent, m/s",
    "cut_in": "gap to an agent that drives ahead on ego's path, and was not on it a second ago, m",
    "nearest": "gap to the nearest agent anywhere, m; at most 50",
    "agents": "number of agents, ego included",
}
#: Steps before which an agent that cuts in was not on ego's path, and its least speed along the path, m/s.
_CUT_IN_STEPS, _CUT_IN_MPS = 10, 1.0
_MOST_CHARACTERS = 1000
_COMPARISONS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
_ARITHMETIC: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: np.divide,
}  # fmt: skip


@dataclass(frozen=True)
class QueryConfig:
    """A query.

    Attributes:
        where: The expression.
        for_s: Time for which it must hold without interruption, s; 0: at a single step.
    """

    where: str = ""
    for_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.for_s <= 60.0:
            raise UsageError(f"for_s is {self.for_s}", cure="use 0 to 60")
        if self.where:
            evaluate(self.where, {name: np.ones((1, 1)) for name in QUANTITIES})

    def matches(
        self, quantities: Mapping[str, Float[Numbers, "M T"]], valid: Bool[Numbers, "M T"]
    ) -> Bool[Numbers, "M T"]:
        """Return the mask of valid steps at which the query holds, in runs of ``for_s`` or longer.

        Raises:
            UsageError: There is no expression.
        """
        if not self.where:
            raise UsageError("no query", cure='pass --where "cut_in < 20 and speed > 10"')
        holds = evaluate(self.where, quantities) & valid
        steps = max(round(self.for_s / DT_S), 1)
        # A step matches if it lies in a run of at least that many steps.
        total = np.pad(holds, ((0, 0), (1, 0))).cumsum(axis=1)
        begins = total[:, steps:] - total[:, :-steps] == steps if holds.shape[1] >= steps else holds[:, :0]
        result = np.zeros(holds.shape, bool)
        for offset in range(steps):
            result[:, offset : offset + begins.shape[1]] |= begins
        return result


def evaluate(expression: str, quantities: Mapping[str, Numbers]) -> Bool[Numbers, "M T"]:
    """Evaluate an expression: return a mask of the steps at which it holds.

    Raises:
        UsageError: The expression is invalid, or names an unknown quantity.
    """
    cure = 'write for example "cut_in < 20 and speed > 10"'
    try:
        if len(expression) > _MOST_CHARACTERS:
            raise ValueError(f"more than {_MOST_CHARACTERS} characters")
        tree = ast.parse(expression.strip(), mode="eval")
        with np.errstate(all="ignore"):
            result = _value(tree.body, quantities)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise UsageError(f"{expression!r} is not a query: {error}", cure=cure) from error
    if np.asarray(result).dtype != bool:
        raise UsageError(f"{expression!r} is a number, not a condition", cure=cure)
    return np.broadcast_to(result, next(iter(quantities.values())).shape)


def _value(node: ast.AST, quantities: Mapping[str, Numbers]) -> Any:
    """Return the value of a node; conditions are boolean."""

    def number(node: ast.AST) -> Any:
        value = _value(node, quantities)
        if np.asarray(value).dtype == bool:
            raise ValueError("a condition instead of a number")
        return value

    def condition(node: ast.AST) -> Any:
        value = _value(node, quantities)
        if np.asarray(value).dtype != bool:
            raise ValueError("a number instead of a condition")
        return value

    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return np.float64(value)
        case ast.Name(id=name):
            if name not in quantities:
                raise UsageError(f"unknown quantity {name!r}", cure=did_you_mean(name, sorted(quantities)))
            return quantities[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -number(operand)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return np.logical_not(condition(operand))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
            return _ARITHMETIC[type(op)](number(left), number(right))
        case ast.BoolOp(op=op, values=values):
            combine = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return reduce(combine, map(condition, values))
        case ast.Compare(left=left, ops=ops, comparators=others) if all(
            type(op) in _COMPARISONS for op in ops
        ):
            values = [number(item) for item in (left, *others)]
            pairs = zip(ops, values, values[1:], strict=False)
            return reduce(np.logical_and, [_COMPARISONS[type(op)](a, b) for op, a, b in pairs])
    raise ValueError(f"{ast.unparse(node)!r} is not allowed")


@dataclass(frozen=True)
class Quantities:
    """Function ``(bank, log) -> {name: [T]}`` of the quantities of a log (:data:`QUANTITIES`)."""

    def __call__(self, bank: ScenarioBank, log: LoggedScenario) -> dict[str, Float[Array, " T"]]:
        """Return the quantities of every step."""
        speed, heading = log.motion[:, 3], log.motion[:, 2]
        yaw_rate = _to_next(wrap(heading[1:] - heading[:-1]) / DT_S)
        slots = jnp.arange(log.frame.valid.shape[1])

        def at_step(frame: Frame, ignored: Array, along_m: Array) -> tuple[Array, Array, Array, Array]:
            included = frame.valid & ~ignored & (slots != log.slot)
            gap, agent_mps = gaps_on_path(log, frame, included, along_m)
            return (
                gap,
                agent_mps,
                time_to_collision(frame, log.slot, ignored),
                nearest_gap(frame, log.slot, ignored),
            )

        gap, agent_mps, ttc, nearest = jax.vmap(at_step)(log.frame, log.ignored, log.along_m)
        first = jnp.argmin(gap, axis=1)
        leader_gap = gap.min(axis=1)
        leader_mps = jnp.take_along_axis(agent_mps, first[:, None], axis=1)[:, 0]
        # An agent cuts in if it was present, and not on the path, a second before.
        before = jnp.roll(gap, _CUT_IN_STEPS, axis=0), jnp.roll(log.frame.valid, _CUT_IN_STEPS, axis=0)
        is_new = ~jnp.isfinite(before[0]) & before[1] & (jnp.arange(len(gap)) >= _CUT_IN_STEPS)[:, None]
        cuts_in = is_new & (agent_mps > _CUT_IN_MPS)  # not one that crosses
        return {
            "speed": speed,
            "acceleration": _to_next((speed[1:] - speed[:-1]) / DT_S),
            "yaw_rate": yaw_rate,
            "lateral_acceleration": speed * yaw_rate,
            "ttc": jnp.where(speed >= STOPPED_MPS, ttc, TTC_HORIZON_S),
            "gap": leader_gap,
            "closing": jnp.where(jnp.isfinite(leader_gap), speed - leader_mps, -jnp.inf),
            "cut_in": jnp.where(cuts_in, gap, jnp.inf).min(axis=1),
            "nearest": nearest,
            "agents": log.frame.valid.sum(axis=1).astype(jnp.float32),
        }


def _to_next(values: Float[Array, " K"]) -> Float[Array, " T"]:
    """Append the last change again, for the last step, which has no next one."""
    return jnp.concatenate([values, values[-1:]])
