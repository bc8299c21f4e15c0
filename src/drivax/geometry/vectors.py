"""Angles (radians, counter-clockwise from +x) and vectors in the plane, for NumPy and JAX arrays."""

from __future__ import annotations

import math
from typing import Any


def wrap(angle: Any) -> Any:
    """Wrap angles to [-pi, pi); one that is less than -pi by a rounding error may become pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def rotate(xy: Any, cos: Any, sin: Any) -> Any:
    """Rotate vectors ``[..., 2]`` by angles given as cosine and sine ``[...]``."""
    xp = xy.__array_namespace__()
    x, y = xy[..., 0], xy[..., 1]
    return xp.stack([x * cos - y * sin, x * sin + y * cos], axis=-1)


def root(squared: Any) -> Any:
    """Square root whose gradient at zero is zero; 0 for negative arguments and NaN.

    The gradient of ``sqrt`` at 0 is infinite, and infinity times the zero that a mask propagates back is NaN; so both
    the argument and the result are masked.
    """
    xp = squared.__array_namespace__()
    is_positive = squared > 0
    safe_root = xp.sqrt(xp.where(is_positive, squared, xp.ones_like(squared)))
    return xp.where(is_positive, safe_root, xp.zeros_like(squared))


def norm(vector: Any) -> Any:
    """Length of vectors ``[..., 2]``; its gradient at the zero vector is zero."""
    return root((vector * vector).sum(axis=-1))
