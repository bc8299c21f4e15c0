"""City-wide map lines cut down to the neighbourhood of one recording, without phantom pieces between the parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the plane, metres."""

    low: Float[Array, "2"]
    high: Float[Array, "2"]

    @classmethod
    def around(cls, xy: Float[Array, "point 2"], margin_m: float) -> Box:
        """The box of some points, widened on all sides."""
        return cls(xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m)

    def touches(self, a: Float[Array, "segment 2"], b: Float[Array, "segment 2"]) -> Bool[Array, " segment"]:
        """Whether the bounding boxes of segments reach into it."""
        return np.all((np.maximum(a, b) >= self.low) & (np.minimum(a, b) <= self.high), axis=-1)

    def pieces(self, points: Float[Array, "point dim"]) -> Iterator[Float[Array, "part dim"]]:
        """The parts of a polyline that reach into the box: runs of whole segments, in order.

        A polyline that lies inside as a whole comes out unchanged, so that rings stay closed.
        """
        if len(points) < 2:
            return
        near = self.touches(points[:-1, :2], points[1:, :2])
        change = np.flatnonzero(np.diff(np.concatenate(([False], near, [False]))))
        for start, end in zip(change[::2], change[1::2], strict=True):
            yield points[start : end + 1]
