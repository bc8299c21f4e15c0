"""Which of many numbers is the smallest, in one reduction that vectorises.

A number that says which it is takes the place of the low bits of every float. The obvious way, to look for the minimum
and then for who equals it, is wrong under XLA: it may compute the values anew for the second reduction, rounded
otherwise, and then nobody equals the minimum.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

#: Smaller differences from the least value do not count, so that no key is below the smallest normal float.
_TINY = 1e-6
#: Infinity with other low bits would be no number.
_FAR = 1e30


def numbered(values: Float[Array, "..."], number: Any, bits: int) -> Float[Array, "..."]:
    """Positive floats with a number in place of their low bits, so that the smallest one says which it is.

    They stay floats, whose minima vectorise; those of integers do not.

    Args:
        values: Of at least the smallest normal float: what is below may count as zero.
        number: Of less than ``2**bits``.
        bits: How many of the 23 bits after the point are given up.
    """
    key = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values).astype(jnp.float32), jnp.int32)
    return jax.lax.bitcast_convert_type(
        (key & ~((1 << bits) - 1)) | jnp.asarray(number, jnp.int32), jnp.float32
    )


def number_of(key: Float[Array, "..."], bits: int) -> Int[Array, "..."]:
    """The number in a key of :func:`numbered`."""
    return jax.lax.bitcast_convert_type(key, jnp.int32) & ((1 << bits) - 1)


def first_smallest(values: Float[Array, "..."], axis: int = -1, least: float = 0.0) -> Int[Array, "..."]:
    """``argmin``, which XLA compares pair by pair on a CPU; of values that are all but alike the first.

    Of N values those are alike that differ by less than about ``N * 2**-23`` of what they are above ``least``, or by
    less than 1e-6.

    Args:
        values: Of at least ``least``; infinite ones are the largest.
        axis: Along which to look.
        least: What no value is below.
    """
    count = values.shape[axis]
    bits = (count - 1).bit_length()
    place = jax.lax.broadcasted_iota(jnp.int32, values.shape, axis % values.ndim)
    key = numbered(jnp.clip(values - least, 0.0, _FAR) + _TINY, place, bits)
    return jnp.minimum(number_of(jnp.min(key, axis=axis), bits), count - 1)
