"""``argmin`` as a single reduction that vectorises on CPUs.

The low bits of every float hold its index. Two reductions, for the minimum and for the index of the value that equals
it, are wrong under XLA: it may compute the values again for the second one with other rounding, and then none equals
the minimum.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

#: Offset that keeps keys above the smallest normal float, below which processors may round to zero.
_TINY = 1e-6
#: Replaces infinity, which would become NaN with other low bits.
_FAR = 1e30


def embed_number(values: Float[Array, "..."], number: Any, bits: int) -> Float[Array, "..."]:
    """Replace the low bits of positive floats by a number below ``2**bits``.

    Minima of floats vectorise; those of integers do not. Values below the smallest normal float may count as zero.
    """
    key = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(values).astype(jnp.float32), jnp.int32)
    return jax.lax.bitcast_convert_type(
        (key & ~((1 << bits) - 1)) | jnp.asarray(number, jnp.int32), jnp.float32
    )


def number_of(key: Float[Array, "..."], bits: int) -> Int[Array, "..."]:
    """Return the number in a key of :func:`embed_number`."""
    return jax.lax.bitcast_convert_type(key, jnp.int32) & ((1 << bits) - 1)


def first_smallest(values: Float[Array, "..."], axis: int = -1, least: float = 0.0) -> Int[Array, "..."]:
    """Return ``argmin`` of values of at least ``least``; of nearly equal values the first.

    N values are nearly equal if they differ by less than about ``N * 2**-23`` of their distance from ``least`` plus
    1e-6. Values below ``least`` count as equal to it.
    """
    count = values.shape[axis]
    bits = (count - 1).bit_length()
    index = jax.lax.broadcasted_iota(jnp.int32, values.shape, axis % values.ndim)
    key = embed_number(jnp.clip(values - least, 0.0, _FAR) + _TINY, index, bits)
    # The bits of a NaN are any number, so keep the index inside the axis.
    return jnp.minimum(number_of(jnp.min(key, axis=axis), bits), count - 1)
