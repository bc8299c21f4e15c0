"""Vectors in the plane. Functions take numpy or JAX arrays and return the same kind."""

from __future__ import annotations

from typing import Any


def root(squared: Any) -> Any:
    """Square root whose gradient at zero is zero.

    Reverse differentiation of ``sqrt(0)`` is infinite, and infinity times the zero that a mask sends back is not a
    number; so both the argument and the result are masked.
    """
    xp = squared.__array_namespace__()
    positive = squared > 0
    return xp.where(
        positive, xp.sqrt(xp.where(positive, squared, xp.ones_like(squared))), xp.zeros_like(squared)
    )


def norm(vector: Any) -> Any:
    """Length of vectors ``[..., 2]``; its gradient at the zero vector is zero."""
    return root((vector * vector).sum(axis=-1))
