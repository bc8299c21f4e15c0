"""Angles in radians, counter-clockwise from +x. Functions take numpy or JAX arrays and return the same kind."""

from __future__ import annotations

import math
from typing import Any


def wrap(angle: Any) -> Any:
    """Wraps an angle to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def rotate(xy: Any, cos: Any, sin: Any) -> Any:
    """Rotates vectors ``[..., 2]`` by the angle with this cosine and sine (each ``[...]``)."""
    xp = xy.__array_namespace__()
    x, y = xy[..., 0], xy[..., 1]
    return xp.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)
