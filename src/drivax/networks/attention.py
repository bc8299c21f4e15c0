"""Masked attention and pre-norm residual layers (Vaswani et al. 2017, arXiv 1706.03762).

Parameters are float32. ``dtype`` bfloat16 applies to matrix products; softmax, norms and residuals stay float32.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

Dtype = Literal["float32", "bfloat16"]

#: Logit of masked tokens: finite, because a softmax over masked tokens alone must stay finite.
_NOWHERE = -1e30


class Attention(nnx.Module):
    """Multi-head scaled dot-product attention without biases: with all tokens masked the output is zero.

    Args:
        width: Size of queries, tokens and outputs, a multiple of ``heads``.
        heads: Number of heads.
        rngs: For the parameters.
        dtype: Type of the matrix products.
    """

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.dtype = dtype
        split, joined = (width, heads, width // heads), (heads, width // heads, width)
        into = nnx.initializers.lecun_normal(in_axis=0, out_axis=(1, 2))
        back = nnx.initializers.lecun_normal(in_axis=(0, 1), out_axis=2)
        self.query = nnx.Param(into(rngs.params(), split))
        self.key = nnx.Param(into(rngs.params(), split))
        self.value = nnx.Param(into(rngs.params(), split))
        self.out = nnx.Param(back(rngs.params(), joined))

    def __call__(
        self,
        queries: Float[Array, "*#batch q width"],
        tokens: Float[Array, "*batch k width"],
        mask: Bool[Array, "*batch k"] | None = None,
    ) -> Float[Array, "*batch q width"]:
        """Return ``softmax(Q K^T / sqrt(width / heads)) V`` over the tokens in ``mask`` (None: all); float32.

        Zeros where no token is valid.
        """
        _, heads, size = self.query.shape
        if queries.shape[-2] * heads < self.query.shape[0]:
            return self._few(queries, tokens, mask)
        query = self._times("...qd,dhc->...qhc", queries, self.query) * size**-0.5
        key = self._times("...kd,dhc->...khc", tokens, self.key)
        value = self._times("...kd,dhc->...khc", tokens, self.value)
        weights = _weights(self._times("...qhc,...khc->...hqk", query, key), mask)
        return self._times(
            "...qhc,hcd->...qd", self._times("...hqk,...khc->...qhc", weights, value), self.out
        )

    def _few(self, queries: Array, tokens: Array, mask: Array | None) -> Array:
        """The same for few queries: keys are applied to queries and values to outputs, never to all tokens.

        ``(W_q x) . (W_k y) = (W_k^T W_q x) . y``, and the mean of ``W_v y`` is ``W_v`` times the mean of ``y``.
        """
        query = self._times("...qd,dhc->...qhc", queries, self.query) * self.query.shape[2] ** -0.5
        projected = self._times("...qhc,dhc->...qhd", query, self.key)
        weights = _weights(self._times("...qhd,...kd->...hqk", projected, tokens), mask)
        mean = self._times("...hqk,...kd->...qhd", weights, tokens)
        return self._times("...qhc,hcd->...qd", self._times("...qhd,dhc->...qhc", mean, self.value), self.out)

    def _times(self, axes: str, left: Any, right: Any) -> Array:
        def product(left: Array, right: Array) -> Array:
            return jnp.einsum(axes, left, right, preferred_element_type=jnp.float32)

        def rounded(left: Array, right: Array) -> Array:
            return product(left.astype(jnp.float32), right.astype(jnp.float32))

        left, right = jnp.asarray(left[...], self.dtype), jnp.asarray(right[...], self.dtype)
        if self.dtype == "float32":
            return product(left, right)
        # XLA for CPUs lacks some bfloat16 products; float32 products of the rounded numbers are the same.
        return jax.lax.platform_dependent(left, right, cpu=rounded, default=product)


def _weights(
    logits: Float[Array, "*batch h q k"], mask: Bool[Array, "*batch k"] | None
) -> Float[Array, "*batch h q k"]:
    if mask is None:
        return jax.nn.softmax(logits)
    there = mask[..., None, None, :]
    # With all tokens masked the softmax is uniform; the second mask makes it zero.
    return jnp.where(there, jax.nn.softmax(jnp.where(there, logits, _NOWHERE)), 0.0)


class Attend(nnx.Module):
    """``x + attention(norm(x), tokens)``; self-attention without ``tokens``.

    ``tokens`` are normalised already.
    """

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.attention = Attention(width, heads, rngs, dtype)

    def __call__(
        self,
        x: Float[Array, "*#batch q width"],
        tokens: Float[Array, "*batch k width"] | None = None,
        mask: Bool[Array, "*batch k"] | None = None,
    ) -> Float[Array, "*batch q width"]:
        """Return ``x`` plus the attention output."""
        normed = self.norm(x)
        return x + self.attention(normed, normed if tokens is None else tokens, mask)


class FeedForward(nnx.Module):
    """``x + W_2 gelu(W_1 norm(x))`` with four times the width between."""

    def __init__(self, width: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.wide = nnx.Linear(width, 4 * width, dtype=jnp.dtype(dtype), rngs=rngs)
        self.narrow = nnx.Linear(4 * width, width, dtype=jnp.dtype(dtype), rngs=rngs)

    def __call__(self, x: Float[Array, "*batch width"]) -> Float[Array, "*batch width"]:
        """Return ``x`` plus the output of two dense layers."""
        return x + self.narrow(jax.nn.gelu(self.wide(self.norm(x))))


class SelfAttention(nnx.Module):
    """A transformer layer: self-attention over rows, then two dense layers."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.attend = Attend(width, heads, rngs, dtype)
        self.feed_forward = FeedForward(width, rngs, dtype)

    def __call__(
        self, x: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"] | None = None
    ) -> Float[Array, "*batch rows width"]:
        """Return the rows after the layer; masked rows are undefined."""
        return self.feed_forward(self.attend(x, mask=mask))


def masked_mean(
    rows: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"]
) -> Float[Array, "*batch width"]:
    """Return the mean over valid rows; zeros without any."""
    total = jnp.sum(jnp.where(mask[..., None], rows, 0.0), axis=-2)
    return total / jnp.maximum(mask.sum(axis=-1, keepdims=True), 1)
