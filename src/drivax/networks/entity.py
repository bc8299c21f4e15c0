"""The attention encoder of the long-tail study: the ego asks the things around it, once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.attention import Attention, Dtype, masked_mean
from drivax.networks.encoders import Groups, GroupSpec
from drivax.networks.tokens import Form, forms, raw_rows, side_by_side

#: Parts of the embedding, in its order.
_PARTS = ("ego", "others", "goal", "beside")


@dataclass(frozen=True)
class EntityConfig:
    """Every row, its times side by side, becomes an entity by one layer with relu; the ego and its goal ask the others.

    Groups are told apart by their masks, and by name where the study treats them differently; names that an
    observation lacks are passed over.

    Attributes:
        size: ``published``: width 64; ``small``: 32; 4 heads either way.
        width: Of an entity, a multiple of ``heads``; the embedding is several entities wide.
        heads: Of the attention.
        goal: Groups whose mean joins what asks.
        beside: Groups whose mean stands beside what was found.
        dtype: Of the attention's products; the rest is float32.
    """

    kind: Literal["entity"] = "entity"
    size: Literal["published", "small"] = "small"
    width: int | None = None
    heads: int = 4
    goal: tuple[str, ...] = ("route",)
    beside: tuple[str, ...] = ("lights",)
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        if self.heads < 1 or self.entity_width < 1 or self.entity_width % self.heads:
            raise ValueError(f"width {self.entity_width} is no multiple of {self.heads} heads")

    @property
    def entity_width(self) -> int:
        """The width, as given or by ``size``."""
        return self.width if self.width is not None else {"published": 64, "small": 32}[self.size]

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> EntityEncoder:
        """The encoder with fresh parameters."""
        return EntityEncoder(self, spec, rngs)


class EntityEncoder(nnx.Module):
    """``[ego, attention(ego + goal, others), goal, beside]``, without the parts that there are no groups for."""

    def __init__(self, config: EntityConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        width = config.entity_width
        self.forms = forms(spec)
        self.parts = {name: _part(config, name, form) for name, form in self.forms.items()}
        self.order = tuple(part for part in _PARTS if part in self.parts.values())
        self.width = width * len(self.order)
        self.layers = nnx.Dict(
            {name: nnx.Linear(_numbers(form), width, rngs=rngs) for name, form in self.forms.items()}
        )
        self.attention = Attention(width, config.heads, rngs, config.dtype)
        self.norm = nnx.LayerNorm(width, rngs=rngs)

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """The embedding of one observation or a batch; float32."""
        rows = {
            part: side_by_side([self._entities(groups, n) for n, its in self.parts.items() if its == part])
            for part in self.order
        }
        found = {part: masked_mean(*rows[part]) for part in self.order}
        if "others" in found:
            asks = sum((found[part] for part in ("ego", "goal") if part in found), jnp.zeros(()))
            asks = jnp.broadcast_to(asks, found["others"].shape)[..., None, :]
            found["others"] = self.norm(self.attention(asks, *rows["others"])[..., 0, :])
        return jnp.concatenate([found[part] for part in self.order], axis=-1)

    def _entities(self, groups: Groups, name: str) -> tuple[Array, Array]:
        """One entity for every row, and whether any of its times is there."""
        value, mask = raw_rows(groups, name, self.forms[name])
        lead = value.shape[:-2]
        numbers = [value.reshape(*lead, -1)]
        if self.forms[name].series:
            numbers.append(mask.astype(jnp.float32))
        return nnx.relu(self.layers[name](jnp.concatenate(numbers, axis=-1))), mask.any(axis=-1)


def _numbers(form: Form) -> int:
    """Numbers in a row: of all its times, and, of a series, which of them are there."""
    return form.times * form.features + (form.times if form.series else 0)


def _part(config: EntityConfig, name: str, form: Form) -> str:
    if name in config.goal:
        return "goal"
    if name in config.beside:
        return "beside"
    return "others" if form.masked else "ego"
