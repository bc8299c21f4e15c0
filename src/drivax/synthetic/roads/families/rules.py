"""Who goes first at a junction: lights with their phases, signs, and the left turn that gives way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction import Move, Turn
from drivax.synthetic.roads.network import Control
from drivax.synthetic.roads.signals import LightGroup, SignalPlan, yellow_time_s

#: Pairs of connectors that cannot be driven at the same time.
Conflicts = Bool[np.ndarray, "lane lane"]


def set_priorities(
    draft: Draft, moves: Sequence[Move], conflicts: Conflicts, major: Sequence[int], sign: Control
) -> None:
    """A priority road: the others have a sign, and on either road who turns left gives way to oncoming traffic.

    Args:
        draft: Where the connectors get their rules.
        moves: All connectors of the junction.
        conflicts: Which lanes are in conflict.
        major: The approaches with priority.
        sign: What the other approaches have, ``STOP`` or ``YIELD``.
    """
    for move in moves:
        before = _before(move, moves, conflicts, major)
        bare = Control.YIELD if before else Control.NONE
        draft.change(move.lane, control=bare if move.arm in major else sign, yields_to=before)


def set_all_way_stop(draft: Draft, moves: Sequence[Move]) -> None:
    """Everybody stops, and who stood first goes first."""
    for move in moves:
        draft.change(move.lane, control=Control.ALL_WAY_STOP)


@dataclass(frozen=True)
class LeftTurns:
    """How lights serve the left turns of two opposing approaches.

    Attributes:
        protected: In a phase of their own, with arrows, where that is possible.
        permissive: Together with oncoming traffic, to which they give way. Without either, the two approaches take
            turns.
    """

    protected: bool
    permissive: bool


def set_lights(
    draft: Draft,
    moves: Sequence[Move],
    conflicts: Conflicts,
    lefts: tuple[LeftTurns, LeftTurns],
    green_s: Sequence[float],
) -> SignalPlan:
    """Lights of a four-way junction: one to two phases for approaches 0 and 2, then as many for 1 and 3.

    Args:
        draft: Where the connectors get their rules.
        moves: All connectors of the junction.
        conflicts: Which lanes are in conflict.
        lefts: What both pairs of opposing approaches do with their left turns.
        green_s: Green times of as many phases as there may be, four.
    """
    groups: list[LightGroup] = []
    phases: list[tuple[int, ...]] = []

    def phase(*parts: list[Move], arrow: bool = False) -> None:
        phases.append(tuple(range(len(groups), len(groups) + len(parts))))
        for part in parts:
            groups.append(LightGroup(tuple(move.lane for move in part), arrow))
            for move in part:
                before = _before(move, [m for other in parts for m in other], conflicts, ())
                draft.change(move.lane, control=Control.SIGNAL, yields_to=before)

    for axis, how in enumerate(lefts):
        ways = [[move for move in moves if move.arm == arm] for arm in (axis, axis + 2)]
        left, other = (
            [[m for m in way if (m.turn == Turn.LEFT) is turning] for way in ways]
            for turning in (True, False)
        )
        if how.protected and _apart(left, conflicts) and _apart(other, conflicts):
            phase(*left, arrow=True)
            phase(*other)
        elif how.permissive and _apart(other, conflicts):
            phase(*ways)
        else:
            for way in ways:
                phase(way)
    fastest = max(draft.lanes[move.lane].limit_mps for move in moves)
    return SignalPlan(
        tuple(groups), tuple(phases), tuple(green_s[: len(phases)]), yellow_s=yellow_time_s(fastest)
    )


def _before(
    move: Move, others: Sequence[Move], conflicts: Conflicts, major: Sequence[int]
) -> tuple[int, ...]:
    """Whom a move lets pass: the priority road, then who does not turn left, then, of two left turns, the first."""

    def order(m: Move) -> tuple[bool, Turn, int]:
        return m.arm not in major, m.turn, m.arm

    return tuple(m.lane for m in others if conflicts[move.lane, m.lane] and order(m) < order(move))


def _apart(ways: list[list[Move]], conflicts: Conflicts) -> bool:
    a, b = ways
    return not any(conflicts[x.lane, y.lane] for x in a for y in b)
