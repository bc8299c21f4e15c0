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


def first_smallest(values: Any, axis: int = -1) -> Any:
    """``argmin`` as two reductions: XLA's own compares pairs one by one on a CPU."""
    xp = values.__array_namespace__()
    smallest = xp.min(values, axis=axis, keepdims=True)
    # Whole numbers as floats: their minima vectorise, those of integers do not.
    place = xp.arange(values.shape[axis], dtype=xp.float32)
    place = xp.reshape(place, [-1 if at == axis % values.ndim else 1 for at in range(values.ndim)])
    last = xp.asarray(values.shape[axis] - 1, dtype=xp.float32)
    return xp.min(xp.where(values <= smallest, place, last), axis=axis).astype(xp.int32)
