"""Where routes begin: on the way that the ego has driven, not in the lane beside it.

A car that is between two lanes at the current step is changing lanes. A line along the centre of one of them would
begin metres beside the ego, although nobody could drive it; here the line follows the ego's own poses up to now,
a metre aside at most, and goes over to the lane ahead of the ego.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.geometry.polylines import arc_lengths, headings, project

Array = np.ndarray[Any, Any]

#: A line may run this far beside where the ego drove; what it is further away is taken back.
BESIDE_M = 1.0
#: Driven poses closer together than this say nothing about the direction across the line.
_APART_M = 1.0
#: The ego drifts across a line by at most this many metres per metre (a change of 3.5 m within 12 m).
_MOST_SLOPE = 0.3
#: The line goes over to the ego's poses within this distance behind the first of them.
_BEHIND_M = 20.0


def join(
    xyz: Float[Array, "point 3"], driven: Float[Array, "step 2"], ahead_m: float
) -> Float[Array, "point 3"]:
    """Bends a line so that it passes within a metre of where the ego drove.

    At each driven pose the line is shifted across by what its distance exceeds a metre; between the poses the shift
    is interpolated along the line, and ahead of the last of them it fades out by a cubic polynomial that goes on in the
    ego's direction (Hermite: its shift and slope at the ego, zero and zero at the end).

    Args:
        xyz: Points of the line, about 1 m apart.
        driven: Positions of the ego up to now, in order.
        ahead_m: How far ahead of the ego the line is on its lane again.
    """
    first = int(arc_lengths(driven)[-1] + 2 * _BEHIND_M) + 2
    s, shift = _shifts(xyz[: max(first, 2)], driven)
    if not shift.any():
        return xyz
    arc = arc_lengths(xyz)
    across = np.interp(arc, s, shift)
    back = slice(0, int(np.searchsorted(arc, s[0])))
    ahead = slice(int(np.searchsorted(arc, s[-1], side="right")), len(arc))
    slope = np.clip(np.diff(shift) / np.diff(s), -_MOST_SLOPE, _MOST_SLOPE) if len(s) > 1 else np.zeros(1)
    across[back] = _fade(s[0] - arc[back], shift[0], -slope[0], _BEHIND_M)
    across[ahead] = _fade(arc[ahead] - s[-1], shift[-1], slope[-1], ahead_m)
    result = xyz.copy()
    result[:, :2] += across[:, None] * _left(headings(xyz))
    return result


def _shifts(xyz: Float[Array, "point 3"], driven: Float[Array, "step 2"]) -> tuple[Array, Array]:
    """Arc lengths of driven poses along a line, increasing, and how far the line has to go to its left there."""
    s, _ = project(xyz, driven)
    keep = [len(s) - 1]
    for i in range(len(s) - 2, -1, -1):
        if s[i] <= s[keep[-1]] - _APART_M:
            keep.append(i)
    rows = np.array(keep[::-1])
    arc, course = arc_lengths(xyz), np.unwrap(headings(xyz))
    foot = np.stack([np.interp(s[rows], arc, xyz[:, axis]) for axis in (0, 1)], axis=-1)
    offset = np.einsum("ij,ij->i", driven[rows] - foot, _left(np.interp(s[rows], arc, course)))
    return s[rows], np.sign(offset) * np.maximum(np.abs(offset) - BESIDE_M, 0.0)


def _fade(distance: Array, shift: float, slope: float, length: float) -> Array:
    """A cubic from a shift and its slope to zero and level at ``length``, zero beyond."""
    t = np.clip(distance / length, 0.0, 1.0)
    return shift * (1.0 + t**2 * (2.0 * t - 3.0)) + slope * length * t * (1.0 - t) ** 2


def _left(heading: Array) -> Array:
    return np.stack((-np.sin(heading), np.cos(heading)), axis=-1)
