"""Masked attention (Vaswani et al. 2017, arXiv 1706.03762), pre-norm residual layers, and groups as rows of tokens.

:class:`EntityEncoder`, that of the long-tail study, attends once; ``transformers`` has the deeper encoders.

Parameters are float32. ``dtype`` bfloat16 applies to matrix products; softmax, norms and residuals stay float32.

A group with a mask is a set of rows; further axes are times, in order. A group without a mask is one valid row with its
times in order. Agents ``[rows, time, F]`` are a set of series, route points ``[rows, F]`` a set, and the ego's history
``[time, F]`` is one series.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.networks.encoders import MOST_WIDTH, Groups, GroupSpec, dense_layers, group_names

Dtype = Literal["float32", "bfloat16"]

#: Largest number of attention weights of an observation; the published sizes have 0.3 million.
MOST_WEIGHTS = 1 << 26
#: Logit of masked tokens; finite, so that the softmax stays finite if all tokens are masked.
_MASKED = -1e30
#: Parts of the embedding, in order.
_PARTS = ("ego", "others", "goal", "context")


def check_heads(width: int, heads: int) -> None:
    """Raise UsageError unless tokens of this width divide among the heads."""
    for name, value in (("width", width), ("heads", heads)):
        if value < 1:
            raise UsageError(f"{name} is {value}", cure="use 1 or more")
        if value > MOST_WIDTH:
            raise UsageError(f"{name} is {value}", cure=f"use {MOST_WIDTH:,} or less")
    if width % heads:
        raise UsageError(f"width {width} is not a multiple of {heads} heads", cure="change width or heads")


class Attention(nnx.Module):
    """Multi-head scaled dot-product attention without biases; ``width`` is a multiple of ``heads``."""

    def __init__(self, width: int, heads: int, rngs: nnx.Rngs, dtype: Dtype = "float32") -> None:
        self.dtype = dtype
        in_shape, out_shape = (width, heads, width // heads), (heads, width // heads, width)
        in_init = nnx.initializers.lecun_normal(in_axis=0, out_axis=(1, 2))
        out_init = nnx.initializers.lecun_normal(in_axis=(0, 1), out_axis=2)
        self.query = nnx.Param(in_init(rngs.params(), in_shape))
        self.key = nnx.Param(in_init(rngs.params(), in_shape))
        self.value = nnx.Param(in_init(rngs.params(), in_shape))
        self.out = nnx.Param(out_init(rngs.params(), out_shape))

    def __call__(
        self,
        queries: Float[Array, "*#batch q width"],
        tokens: Float[Array, "*batch k width"],
        mask: Bool[Array, "*batch k"] | None = None,
    ) -> Float[Array, "*batch q width"]:
        """Return ``softmax(Q K^T / sqrt(width / heads)) V`` over tokens in ``mask`` (None: all); zeros if none are."""
        width, heads, size = self.query.shape
        count = heads * queries.shape[-2] * tokens.shape[-2]
        if count > MOST_WEIGHTS:
            problem = f"attention of {queries.shape[-2]:,} queries to {tokens.shape[-2]:,} tokens"
            raise UsageError(
                f"{problem} has {count:,} weights", cure=f"use {MOST_WEIGHTS:,} or less: observe less"
            )
        # Projecting a token takes width^2 products, comparing it with projected queries width x heads per query.
        if queries.shape[-2] * heads < width:
            return self._attend_few_queries(queries, tokens, mask)
        query = self._einsum("...qd,dhc->...qhc", queries, self.query) * size**-0.5
        key = self._einsum("...kd,dhc->...khc", tokens, self.key)
        value = self._einsum("...kd,dhc->...khc", tokens, self.value)
        weights = _masked_softmax(self._einsum("...qhc,...khc->...hqk", query, key), mask)
        mean = self._einsum("...hqk,...khc->...qhc", weights, value)
        return self._einsum("...qhc,hcd->...qd", mean, self.out)

    def _attend_few_queries(self, queries: Array, tokens: Array, mask: Array | None) -> Array:
        """Project queries instead of tokens."""
        # ``(W_q x) . (W_k y) = (W_k^T W_q x) . y``, and the mean of ``W_v y`` is ``W_v`` times the mean of ``y``.
        query = self._einsum("...qd,dhc->...qhc", queries, self.query) * self.query.shape[2] ** -0.5
        projections = self._einsum("...qhc,dhc->...qhd", query, self.key)
        weights = _masked_softmax(self._einsum("...qhd,...kd->...hqk", projections, tokens), mask)
        mean = self._einsum("...hqk,...kd->...qhd", weights, tokens)
        return self._einsum(
            "...qhc,hcd->...qd", self._einsum("...qhd,dhc->...qhc", mean, self.value), self.out
        )

    def _einsum(self, subscripts: str, left: Any, right: Any) -> Array:
        """Multiply two arrays or parameters in ``dtype``, with sums in float32."""

        def product(left: Array, right: Array) -> Array:
            return jnp.einsum(subscripts, left, right, preferred_element_type=jnp.float32)

        def float32_product(left: Array, right: Array) -> Array:
            return product(left.astype(jnp.float32), right.astype(jnp.float32))

        left, right = jnp.asarray(left[...], self.dtype), jnp.asarray(right[...], self.dtype)
        if self.dtype == "float32":
            return product(left, right)
        # XLA lacks some bfloat16 products on CPUs; float32 products of the rounded numbers give the same result.
        return jax.lax.platform_dependent(left, right, cpu=float32_product, default=product)


def _masked_softmax(
    logits: Float[Array, "*batch h q k"], mask: Bool[Array, "*batch k"] | None
) -> Float[Array, "*batch h q k"]:
    """Return the softmax over valid tokens; zeros if there are none."""
    if mask is None:
        return jax.nn.softmax(logits)
    valid = mask[..., None, None, :]
    # With all tokens masked the softmax is uniform; the second mask makes it zero.
    return jnp.where(valid, jax.nn.softmax(jnp.where(valid, logits, _MASKED)), 0.0)


class ResidualAttention(nnx.Module):
    """``x + attention(norm(x), tokens)``; the caller normalises ``tokens``. Without tokens, self-attention."""

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
        queries = self.norm(x)
        return x + self.attention(queries, queries if tokens is None else tokens, mask)


class FeedForward(nnx.Module):
    """``x + W_2 gelu(W_1 norm(x))`` with a hidden layer four times as wide."""

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
        self.attend = ResidualAttention(width, heads, rngs, dtype)
        self.feed_forward = FeedForward(width, rngs, dtype)

    def __call__(
        self, x: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"] | None = None
    ) -> Float[Array, "*batch rows width"]:
        """Return the rows after the layer; masked rows are undefined."""
        return self.feed_forward(self.attend(x, mask=mask))


def masked_mean(
    rows: Float[Array, "*batch rows width"], mask: Bool[Array, "*batch rows"]
) -> Float[Array, "*batch width"]:
    """Return the mean over valid rows; zeros if there are none."""
    total = jnp.sum(jnp.where(mask[..., None], rows, 0.0), axis=-2)
    return total / jnp.maximum(mask.sum(axis=-1, keepdims=True), 1)


@dataclass(frozen=True)
class GroupShape:
    """Shape of a group in one observation, features last, and whether it has a mask."""

    shape: tuple[int, ...]
    masked: bool

    @property
    def features(self) -> int:
        """Number of features of a token."""
        return self.shape[-1]

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.shape[0] if self.masked else 1

    @property
    def series(self) -> bool:
        """Whether there is a time axis, possibly of length 1."""
        return len(self.shape) > (2 if self.masked else 1)

    @property
    def times(self) -> int:
        """Number of tokens of a row, one per time."""
        return math.prod(self.shape[:-1]) // self.rows


class TokenRows(NamedTuple):
    """Rows of tokens and their mask."""

    value: Float[Array, "*batch rows time width"]
    mask: Bool[Array, "*batch rows time"]

    def flatten(self) -> tuple[Float[Array, "*batch tokens width"], Bool[Array, "*batch tokens"]]:
        """Return all tokens along one axis."""
        *lead, rows, times, width = self.value.shape
        return self.value.reshape(*lead, rows * times, width), self.mask.reshape(*lead, rows * times)


def group_shapes(spec: GroupSpec) -> dict[str, GroupShape]:
    """Return the shape of each group."""
    return {name: GroupShape(tuple(spec[name]), f"{name}_mask" in spec) for name in group_names(spec)}


def group_rows(groups: Groups, name: str, shape: GroupShape) -> TokenRows:
    """Return the features of a group as rows of tokens in float32; masked tokens are zero."""
    value = groups[name].astype(jnp.float32)
    axes = (*value.shape[: value.ndim - len(shape.shape)], shape.rows, shape.times)
    value = value.reshape(*axes, shape.features)
    mask = groups[f"{name}_mask"].reshape(axes) if shape.masked else jnp.ones(axes, bool)
    return TokenRows(jnp.where(mask[..., None], value, 0.0) if shape.masked else value, mask)


def time_code(times: int, width: int) -> Float[np.ndarray, "time width"]:
    """Return the sinusoidal encoding of time, counted back from the last step (Vaswani et al. 2017, section 3.5)."""
    steps_back = np.arange(times - 1, -1, -1)[:, None]
    angle = steps_back / 10_000 ** (2 * np.arange((width + 1) // 2) / width)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(times, -1)[:, :width].astype(np.float32)


class Embedding(nnx.Module):
    """Map features to normalised tokens: dense layers per group, plus a time encoding for series.

    Features are embedded in float32: in bfloat16 a point 50 m away would move by up to 20 cm.
    """

    def __init__(
        self, spec: GroupSpec, width: int, hidden: tuple[int, ...], rngs: nnx.Rngs, dtype: Dtype
    ) -> None:
        self.group_shapes = group_shapes(spec)
        self.dtype = dtype
        self.hidden, self.out, self.norms = nnx.Dict(), nnx.Dict(), nnx.Dict()
        for name, shape in self.group_shapes.items():
            self.hidden[name] = dense_layers(shape.features, hidden, rngs)
            self.out[name] = nnx.Linear(hidden[-1] if hidden else shape.features, width, rngs=rngs)
            self.norms[name] = nnx.LayerNorm(width, rngs=rngs)
        self.width = width

    def __call__(self, groups: Groups) -> dict[str, TokenRows]:
        """Return the tokens of each group by name."""
        return {name: self._rows(groups, name) for name in self.group_shapes}

    def _rows(self, groups: Groups, name: str) -> TokenRows:
        shape = self.group_shapes[name]
        x, mask = group_rows(groups, name, shape)
        for layer in self.hidden[name]:
            x = nnx.relu(layer(x))
        x = self.out[name](x)
        if shape.series:
            x = x + jnp.asarray(time_code(shape.times, self.width))
        return TokenRows(self.norms[name](x).astype(self.dtype), mask)


def concatenate_groups(groups: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Concatenate tokens and masks of several groups."""
    return jnp.concatenate([x for x, _ in groups], axis=-2), jnp.concatenate([m for _, m in groups], axis=-1)


@dataclass(frozen=True)
class EntityConfig:
    """Embed each row with one relu layer; the ego and its goal attend to the other rows.

    Attributes:
        size: Default of ``width``: 64 if ``published``, 32 if ``small``.
        width: Width of an embedded row, a multiple of ``heads``; the embedding concatenates one to four of them.
        heads: Number of attention heads.
        goal: Groups whose mean is added to the query and appended to the embedding; missing names are ignored, here
            and in ``context``.
        context: Groups whose mean is appended to the embedding, unless ``goal`` has them.
        dtype: Type of the attention's matrix products; the rest is float32.
    """

    kind: Literal["entity"] = "entity"
    size: Literal["published", "small"] = "small"
    width: int | None = None
    heads: int = 4
    goal: tuple[str, ...] = ("route",)
    context: tuple[str, ...] = ("lights",)
    dtype: Dtype = "float32"

    #: Keys of version 0.1.
    renamed: ClassVar[dict[str, str]] = {"beside": "context"}

    def __post_init__(self) -> None:
        check_heads(self.entity_width, self.heads)

    @property
    def entity_width(self) -> int:
        """Width of an embedded row, from ``width`` or ``size``."""
        return self.width if self.width is not None else {"published": 64, "small": 32}[self.size]

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> EntityEncoder:
        """Return the encoder with fresh parameters."""
        return EntityEncoder(self, spec, rngs)


class EntityEncoder(nnx.Module):
    """``[ego, attention(ego + goal, others), goal, context]``, without parts that have no groups."""

    def __init__(self, config: EntityConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        width = config.entity_width
        self.group_shapes = group_shapes(spec)
        self.parts = {name: _part_of(config, name, shape) for name, shape in self.group_shapes.items()}
        self.order = tuple(part for part in _PARTS if part in self.parts.values())
        self.width = width * len(self.order)
        # The inputs of a row are its features at all times and, in a series, its mask.
        sizes = {n: shape.times * (shape.features + shape.series) for n, shape in self.group_shapes.items()}
        self.layers = nnx.Dict({name: nnx.Linear(size, width, rngs=rngs) for name, size in sizes.items()})
        self.attention = Attention(width, config.heads, rngs, config.dtype)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch; float32."""
        entities = {}
        for part in self.order:
            names = [name for name, group_part in self.parts.items() if group_part == part]
            entities[part] = concatenate_groups([self._entities(groups, name) for name in names])
        embeddings = {part: masked_mean(*entities[part]) for part in self.order}
        if "others" in embeddings:
            query = sum((embeddings[part] for part in ("ego", "goal") if part in embeddings), jnp.zeros(()))
            # Without ego and goal the query is the scalar zero.
            query = jnp.broadcast_to(query, embeddings["others"].shape)[..., None, :]
            embeddings["others"] = self.norm(self.attention(query, *entities["others"])[..., 0, :])
        return jnp.concatenate([embeddings[part] for part in self.order], axis=-1)

    def _entities(self, groups: Groups, name: str) -> tuple[Array, Array]:
        """Return an embedding per row, and whether any of its times is valid."""
        value, mask = group_rows(groups, name, self.group_shapes[name])
        x = value.reshape(*value.shape[:-2], -1)
        if self.group_shapes[name].series:
            x = jnp.concatenate([x, mask.astype(jnp.float32)], axis=-1)
        return nnx.relu(self.layers[name](x)), mask.any(axis=-1)


def _part_of(config: EntityConfig, name: str, shape: GroupShape) -> str:
    """Return the part of the embedding, one of ``_PARTS``, that a group belongs to."""
    if name in config.goal:
        return "goal"
    if name in config.context:
        return "context"
    return "others" if shape.masked else "ego"
