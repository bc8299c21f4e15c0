"""The attention encoder of the long-tail study: the ego attends once to its surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.attention import (
    Attention,
    Dtype,
    GroupShape,
    check_heads,
    concatenate_groups,
    group_rows,
    group_shapes,
    masked_mean,
)
from drivax.networks.encoders import Groups, GroupSpec

#: Parts of the embedding, in order.
_PARTS = ("ego", "others", "goal", "context")


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
