"""Attention encoders over groups with masks: latent queries (``lq``, ``lqh``, ``wayformer``) and ``mtr``.

Layers are pre-norm; masked rows have no effect. See ``docs/algorithms/encoders.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

from drivax.checks import check_at_least, check_at_most
from drivax.networks.attention import (
    Dtype,
    Embedding,
    FeedForward,
    ResidualAttention,
    SelfAttention,
    TokenRows,
    check_heads,
    concatenate_groups,
    group_shapes,
    masked_mean,
)
from drivax.networks.encoders import MOST_LAYERS, MOST_WIDTH, Groups, GroupSpec, check_widths


@dataclass(frozen=True)
class Sizes:
    """Sizes of a transformer; see :class:`TransformerConfig`. ``latents`` is the number of latent queries."""

    width: int
    heads: int
    layers: int
    latents: int
    embedding: tuple[int, ...]
    dtype: Dtype = "float32"


SIZES = {
    "published": Sizes(width=256, heads=8, layers=4, latents=16, embedding=()),
    "small": Sizes(width=64, heads=4, layers=2, latents=8, embedding=(64,)),
}


@dataclass(frozen=True)
class TransformerConfig:
    """Settings of all transformers.

    Attributes:
        kind: Kind of encoder.
        size: ``published`` or ``small``: all sizes that are not set, see :data:`SIZES`.
        width: Width of tokens and of the embedding; a multiple of ``heads``.
        heads: Number of attention heads.
        layers: Depth.
        embedding: Hidden relu layers between features and tokens; empty: a linear map.
        dtype: Type of matrix products; parameters, softmax and norms are float32.
    """

    kind: str = ""
    size: Literal["published", "small"] = "small"
    width: int | None = None
    heads: int | None = None
    layers: int | None = None
    embedding: tuple[int, ...] | None = None
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        sizes = self.sizes
        check_heads(sizes.width, sizes.heads)
        check_at_least(sizes, 1, "layers", "latents")
        check_at_most(sizes, MOST_LAYERS, "layers")
        check_at_most(sizes, MOST_WIDTH, "latents")
        check_widths("embedding", sizes.embedding)

    @property
    def sizes(self) -> Sizes:
        """All sizes, with those of ``size`` where none is set."""
        sizes = {field.name: getattr(self, field.name, None) for field in fields(Sizes)}
        return replace(SIZES[self.size], **{n: value for n, value in sizes.items() if value is not None})


@dataclass(frozen=True)
class LatentConfig(TransformerConfig):
    """A transformer with ``latents`` latent queries."""

    latents: int | None = None


@dataclass(frozen=True)
class LqConfig(LatentConfig):
    """Latent queries (Perceiver; Jaegle et al. 2021, arXiv 2103.03206): latents attend to all tokens in each layer."""

    kind: Literal["lq"] = "lq"

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> LatentEncoder:
        """Return the encoder with fresh parameters."""
        return LatentEncoder(self.sizes, Fusion(0, self.sizes.layers, every_layer=True), spec, rngs)


@dataclass(frozen=True)
class LqhConfig(LatentConfig):
    """Latent queries per group, then latent queries over those of all groups.

    Attributes:
        local_layers: Depth per group, at least 1; ``layers`` is the depth over all groups.
    """

    kind: Literal["lqh"] = "lqh"
    local_layers: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, 1, "local_layers")
        check_at_most(self, MOST_LAYERS, "local_layers")

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> LatentEncoder:
        """Return the encoder with fresh parameters."""
        fusion = Fusion(self.local_layers, self.sizes.layers, every_layer=True)
        return LatentEncoder(self.sizes, fusion, spec, rngs)


@dataclass(frozen=True)
class WayformerConfig(LatentConfig):
    """Wayformer (Nayakanti et al. 2022, arXiv 2207.05844): cross-attention once, then self-attention.

    Attributes:
        fusion: ``early``: one encoder over all tokens; ``late``: one per group, latents averaged; ``hierarchical``: one
            layer per group, then ``layers`` over all latents.
        factorised: Whether tokens of a group attend over times, then over rows, before the latents.
    """

    kind: Literal["wayformer"] = "wayformer"
    fusion: Literal["early", "late", "hierarchical"] = "late"
    factorised: bool = False

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> LatentEncoder:
        """Return the encoder with fresh parameters."""
        layers = self.sizes.layers
        depths = {"early": (0, layers), "late": (layers, 0), "hierarchical": (1, layers)}
        group_layers, joint_layers = depths[self.fusion]
        fusion = Fusion(group_layers, joint_layers, every_layer=False, factorised=self.factorised)
        return LatentEncoder(self.sizes, fusion, spec, rngs)


@dataclass(frozen=True)
class MtrConfig(TransformerConfig):
    """An encoder after the Motion Transformer (Shi et al. 2022, arXiv 2209.13508).

    Each mover attends to its own times, then in each layer to all movers and to the map. Movers are the rows of series
    and of groups without a mask; the map is all other rows.
    """

    kind: Literal["mtr"] = "mtr"

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> MtrEncoder:
        """Return the encoder with fresh parameters."""
        return MtrEncoder(self.sizes, spec, rngs)


@dataclass(frozen=True)
class Fusion:
    """Depth of the stages of a :class:`LatentEncoder`.

    Attributes:
        group_layers: Depth of the latents of each group; 0: none.
        joint_layers: Depth of the latents over all groups; 0: none.
        every_layer: Whether latents attend to the tokens before every layer, or only before the first.
        factorised: See :class:`WayformerConfig`.
    """

    group_layers: int
    joint_layers: int
    every_layer: bool
    factorised: bool = False


class _Latents(nnx.Module):
    """Learned latent queries with cross-attention to tokens and self-attention.

    Attributes (names of stored parameters):
        first: Initial latents.
        looks: Cross-attention layers.
        layers: Self-attention layers.
    """

    def __init__(self, sizes: Sizes, layers: int, every_layer: bool, rngs: nnx.Rngs) -> None:
        width, heads, dtype = sizes.width, sizes.heads, sizes.dtype
        self.first = nnx.Param(nnx.initializers.normal(0.02)(rngs.params(), (sizes.latents, width)))
        cross_layers = layers if every_layer else 1
        self.looks = nnx.List([ResidualAttention(width, heads, rngs, dtype) for _ in range(cross_layers)])
        self.layers = nnx.List([SelfAttention(width, heads, rngs, dtype) for _ in range(layers)])
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(
        self, tokens: Float[Array, "*batch k width"], mask: Bool[Array, "*batch k"]
    ) -> Float[Array, "*batch latent width"]:
        """Return the latents after all layers."""
        x = self.first[...]
        for number, layer in enumerate(self.layers):
            if number < len(self.looks):
                x = self.looks[number](x, tokens, mask)
            x = layer(x)
        return self.norm(x)


class _Factorised(nnx.Module):
    """Self-attention over the times of each row, then over the rows of each time."""

    def __init__(self, sizes: Sizes, rngs: nnx.Rngs) -> None:
        self.time = SelfAttention(sizes.width, sizes.heads, rngs, sizes.dtype)
        self.space = SelfAttention(sizes.width, sizes.heads, rngs, sizes.dtype)
        self.norm = nnx.LayerNorm(sizes.width, rngs=rngs)
        self.dtype = sizes.dtype

    def __call__(self, rows: TokenRows) -> TokenRows:
        """Return the normalised tokens after both layers, with the same mask."""
        x = self.time(rows.value, rows.mask)
        x = self.space(jnp.swapaxes(x, -3, -2), jnp.swapaxes(rows.mask, -2, -1))
        return TokenRows(self.norm(jnp.swapaxes(x, -3, -2)).astype(self.dtype), rows.mask)


class LatentEncoder(nnx.Module):
    """Mean of latent queries over each group, over all groups, or over both in turn.

    Attributes (names of stored parameters):
        before: Factorised attention within each group, before its latents.
        local: Latents of each group.
        whole: Latents over all groups.
    """

    def __init__(self, sizes: Sizes, fusion: Fusion, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.width = sizes.width
        self.embedding = Embedding(spec, sizes.width, sizes.embedding, rngs, sizes.dtype)
        names = tuple(self.embedding.group_shapes)
        self.before = nnx.Dict({name: _Factorised(sizes, rngs) for name in names if fusion.factorised})

        def latents(layers: int) -> _Latents:
            return _Latents(sizes, layers, fusion.every_layer, rngs)

        self.local = nnx.Dict({name: latents(fusion.group_layers) for name in names if fusion.group_layers})
        self.whole = nnx.List([latents(fusion.joint_layers)] if fusion.joint_layers else [])

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch; float32."""
        tokens = []
        for name, rows in self.embedding(groups).items():
            x, mask = (self.before[name](rows) if name in self.before else rows).flatten()
            if name in self.local:
                x = self.local[name](x, mask)
                mask = jnp.ones(x.shape[:-1], bool)
            tokens.append((x, mask))
        x, mask = concatenate_groups(tokens)
        for latents in self.whole:
            x = latents(x, mask)
        return jnp.mean(x.astype(jnp.float32), axis=-2)


class MtrEncoder(nnx.Module):
    """Attention over the times of each mover, then over movers and map; the output is the mean over ego's tokens.

    Without a group of ego the output is the mean over all movers; without movers, all rows count as movers.

    Attributes (names of stored parameters):
        time: Self-attention over the times of a mover.
        among: Attention among movers, by layer.
        around: Attention of movers to the map, by layer.
    """

    def __init__(self, sizes: Sizes, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        width, heads, dtype = sizes.width, sizes.heads, sizes.dtype
        self.width = width
        self.embedding = Embedding(spec, width, sizes.embedding, rngs, dtype)
        shapes = group_shapes(spec)
        movers = tuple(name for name, shape in shapes.items() if shape.series or not shape.masked)
        self.mover_groups = movers or tuple(shapes)
        self.map_groups = tuple(name for name in shapes if name not in self.mover_groups)
        self.ego_groups = tuple(name for name in self.mover_groups if not shapes[name].masked)
        self.time = SelfAttention(width, heads, rngs, dtype)
        self.among = nnx.List([ResidualAttention(width, heads, rngs, dtype) for _ in range(sizes.layers)])
        map_layers = sizes.layers if self.map_groups else 0
        self.around = nnx.List([ResidualAttention(width, heads, rngs, dtype) for _ in range(map_layers)])
        self.feed_forward = nnx.List([FeedForward(width, rngs, dtype) for _ in range(sizes.layers)])
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch; float32."""
        tokens = self.embedding(groups)
        movers = {name: self._mover_tokens(name, tokens[name]) for name in self.mover_groups}
        x, mask = concatenate_groups(list(movers.values()))
        map_groups = [tokens[name].flatten() for name in self.map_groups]
        map_tokens = concatenate_groups(map_groups) if map_groups else None
        for number, layer in enumerate(self.feed_forward):
            x = self.among[number](x, mask=mask)
            if map_tokens is not None:
                x = self.around[number](x, *map_tokens)
            x = layer(x)
        output_groups = self.ego_groups or self.mover_groups
        masks = [m if name in output_groups else jnp.zeros_like(m) for name, (_, m) in movers.items()]
        return masked_mean(self.norm(x), jnp.concatenate(masks, axis=-1))

    def _mover_tokens(self, name: str, rows: TokenRows) -> tuple[Array, Array]:
        """Return one token per row and its mask; a series gives the mean over its times after self-attention."""
        if not self.embedding.group_shapes[name].series:
            return rows.flatten()
        return masked_mean(self.time(rows.value, rows.mask), rows.mask), rows.mask.any(axis=-1)
