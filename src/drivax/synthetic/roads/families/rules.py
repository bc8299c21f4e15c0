"""Right of way at junctions: phases of lights, signs, and left turns that yield."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction_layout import Move, Turn
from drivax.synthetic.roads.network import Control
from drivax.synthetic.roads.signals import LightGroup, SignalPlan, yellow_time_s

#: Pairs of connectors in conflict.
Conflicts = Bool[np.ndarray, "lane lane"]


def set_priorities(
    draft: Draft, moves: Sequence[Move], conflicts: Conflicts, major: Sequence[int], sign: Control
) -> None:
    """Set the rules of a priority road: other approaches have a sign, left turns yield to oncoming traffic.

    Args:
        draft: The draft.
        moves: Connectors of the junction.
        conflicts: Pairs of lanes in conflict.
        major: Approaches with priority.
        sign: Sign of the other approaches, ``STOP`` or ``YIELD``.
    """
    for move in moves:
        yields_to = _yields_to(move, moves, conflicts, major)
        unsigned = Control.YIELD if yields_to else Control.NONE
        draft.change(move.lane, control=unsigned if move.arm in major else sign, yields_to=yields_to)


@dataclass(frozen=True)
class LeftTurns:
    """Phases of the left turns of two opposing approaches.

    Attributes:
        protected: In a phase of their own, with arrows, where possible.
        permissive: Together with oncoming traffic, to which they yield; without either, one approach at a time.
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
    """Set the lights of a four-way junction: one or two phases for approaches 0 and 2, then for 1 and 3.

    Args:
        draft: The draft.
        moves: Connectors of the junction.
        conflicts: Pairs of lanes in conflict.
        lefts: Left turns of both pairs of opposing approaches.
        green_s: Green times of up to four phases.
    """
    groups: list[LightGroup] = []
    phases: list[tuple[int, ...]] = []

    def phase(*approaches: list[Move], arrow: bool = False) -> None:
        phases.append(tuple(range(len(groups), len(groups) + len(approaches))))
        for approach in approaches:
            groups.append(LightGroup(tuple(move.lane for move in approach), arrow))
            for move in approach:
                yields_to = _yields_to(move, [m for other in approaches for m in other], conflicts, ())
                draft.change(move.lane, control=Control.SIGNAL, yields_to=yields_to)

    for axis, turns in enumerate(lefts):
        approaches = [[move for move in moves if move.arm == arm] for arm in (axis, axis + 2)]
        left, other = (
            [[m for m in approach if (m.turn == Turn.LEFT) is turning] for approach in approaches]
            for turning in (True, False)
        )
        if turns.protected and _apart(left, conflicts) and _apart(other, conflicts):
            phase(*left, arrow=True)
            phase(*other)
        elif turns.permissive and _apart(other, conflicts):
            phase(*approaches)
        else:
            for approach in approaches:
                phase(approach)
    fastest = max(draft.lanes[move.lane].limit_mps for move in moves)
    return SignalPlan(
        tuple(groups), tuple(phases), tuple(green_s[: len(phases)]), yellow_s=yellow_time_s(fastest)
    )


def _yields_to(
    move: Move, others: Sequence[Move], conflicts: Conflicts, major: Sequence[int]
) -> tuple[int, ...]:
    """Conflicting moves with right of way: by priority road, then turn, then approach."""

    def order(m: Move) -> tuple[bool, Turn, int]:
        return m.arm not in major, m.turn, m.arm

    return tuple(m.lane for m in others if conflicts[move.lane, m.lane] and order(m) < order(move))


def _apart(approaches: list[list[Move]], conflicts: Conflicts) -> bool:
    a, b = approaches
    return not any(conflicts[x.lane, y.lane] for x in a for y in b)
