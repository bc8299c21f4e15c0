"""Masked attention and the residual layers made of it (Vaswani et al. 2017, arXiv 1706.03762), normalised before.

Parameters are float32. With ``dtype`` bfloat16 the products of matrices are computed in it; softmax, norms and what
layers add to are float32 all the same.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

Dtype = Literal["float32", "bfloat16"]

#: Logit of what is masked: finite, so that a softmax over nothing else stays finite.
_NOWHERE = -1e30


class Attention(nnx.Module):
    """Multi-head scaled dot-product attention. No biases, so that who has nothing to look at gets zeros.

    Args:
        width: Size of queries, tokens and results, a multiple of ``heads``.
        heads: Number of heads.
        rngs: For the parameters.
        dtype: Of the products.
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
        """What every query finds among the tokens that are there (``mask``; None: all); float32.

        Per head, ``softmax(Q K^T / sqrt(width / heads)) V``, and zeros where no token is there.
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
        """The same for few queries: it takes keys to the queries and values to the results, never to every token.

        ``(W_q x) . (W_k y) = (W_k^T W_q x) . y``, and the mean of ``W_v y`` is ``W_v`` times the mean of ``y``.
        """
        query = self._times("...qd,dhc->...qhc", queries, self.query) * self.query.shape[2] ** -0.5
        asked = self._times("...qhc,dhc->...qhd", query, self.key)
        weights = _weights(self._times("...qhd,...kd->...hqk", asked, tokens), mask)
        found = self._times("...hqk,...kd->...qhd", weights, tokens)
        return self._times(
            "...qhc,hcd->...qd", self._times("...qhd,dhc->...qhc", found, self.value), self.out
        )

    def _times(self, axes: str, one: Any, other: Any) -> Array:
        def product(one: Array, other: Array) -> Array:
            return jnp.einsum(axes, one, other, preferred_element_type=jnp.float32)

        def rounded(one: Array, other: Array) -> Array:
            return product(one.astype(jnp.float32), other.astype(jnp.float32))

        one, other = jnp.asarray(one[...], self.dtype), jnp.asarray(other[...], self.dtype)
        if self.dtype == "float32":
            return product(one, other)
        # XLA for CPUs knows some products of bfloat16 only; those of the rounded numbers in float32 are the same.
        return jax.lax.platform_dependent(one, other, cpu=rounded, default=product)


def _weights(
    logits: Float[Array, "*batch h q k"], mask: Bool[Array, "*batch k"] | None
) -> Float[Array, "*batch h q k"]:
    if mask is None:
        return jax.nn.softmax(logits)
    there = mask[..., None, None, :]
    # Where nobody is there the softmax is even over everyone; the second mask makes it zero.
    return jnp.where(there, jax.nn.softmax(jnp.where(there, logits, _NOWHERE)), 0.0)


class Attend(nnx.Module):
    """``x + attention(norm(x), tokens)``; the tokens are ``norm(x)`` itself where none are given.

    Given tokens are normalised already: their norm's scale is as good as part of the keys and values.
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
        """``x`` and what it finds."""
        normed = self.norm(x)
        return x + self.attention(normed, normed if tokens is None else tokens, mask)


class FeedForward(nnx.Module):
    """``x + W_2 gelu(W_1 norm(x))`` with four times the width between."""

    def __init__(self, width: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.wide = nnx.Linear(width, 4 * width, dtype=jnp.dtype(dtype), rngs=rngs)
        self.narrow = nnx.Linear(4 * width, width, dtype=jnp.dtype(dtype), rngs=rngs)

    def __call__(self, x: Float[Array, "*batch width"]) -> Float[Array, "*batch width"]:
        """``x`` and what two dense layers add."""
        return x + self.narrow(jax.nn.gelu(self.wide(self.norm(x))))


class SelfAttention(nnx.Module):
    """A transformer layer: rows attend to each other, then each passes two dense layers."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.attend = Attend(width, heads, rngs, dtype)
        self.feed_forward = FeedForward(width, rngs, dtype)

    def __call__(
        self, x: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"] | None = None
    ) -> Float[Array, "*batch rows width"]:
        """The rows after the layer; those that are not there mean nothing."""
        return self.feed_forward(self.attend(x, mask=mask))


def masked_mean(
    rows: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"]
) -> Float[Array, "*batch width"]:
    """The mean over the rows that are there; zeros without any."""
    total = jnp.sum(jnp.where(mask[..., None], rows, 0.0), axis=-2)
    return total / jnp.maximum(mask.sum(axis=-1, keepdims=True), 1)
