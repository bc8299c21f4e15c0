"""Observation groups as rows of tokens, by their shapes.

A group with a mask is a set of rows; further axes are times, in order. A group without a mask is one valid row with its
times in order. Agents ``[rows, time, F]`` are a set of series, route points ``[rows, F]`` a set, and the ego's history
``[time, F]`` is one series.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float

from drivax.networks.attention import Dtype
from drivax.networks.encoders import Groups, GroupSpec, dense_layers, group_names


@dataclass(frozen=True)
class Form:
    """Shape of a group.

    Attributes:
        shape: Axes of one observation, features last.
        masked: Whether it has a mask.
    """

    shape: tuple[int, ...]
    masked: bool

    @property
    def features(self) -> int:
        """Width of a token."""
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
        """Number of tokens of a row."""
        return math.prod(self.shape[:-1]) // self.rows


class Rows(NamedTuple):
    """Rows of tokens and their mask."""

    value: Float[Array, "*batch rows time width"]
    mask: Bool[Array, "*batch rows time"]

    def flat(self) -> tuple[Float[Array, "*batch tokens width"], Bool[Array, "*batch tokens"]]:
        """Return all tokens along one axis."""
        *lead, rows, times, width = self.value.shape
        return self.value.reshape(*lead, rows * times, width), self.mask.reshape(*lead, rows * times)


def forms(spec: GroupSpec) -> dict[str, Form]:
    """Return the shape of each group."""
    return {name: Form(tuple(spec[name]), f"{name}_mask" in spec) for name in group_names(spec)}


def raw_rows(groups: Groups, name: str, form: Form) -> Rows:
    """Return a group's features as rows of times; masked ones are zero."""
    value = groups[name].astype(jnp.float32)
    axes = (*value.shape[: value.ndim - len(form.shape)], form.rows, form.times)
    value = value.reshape(*axes, form.features)
    mask = groups[f"{name}_mask"].reshape(axes) if form.masked else jnp.ones(axes, bool)
    return Rows(jnp.where(mask[..., None], value, 0.0) if form.masked else value, mask)


def time_code(times: int, width: int) -> Float[np.ndarray, "time width"]:
    """Return the sinusoidal encoding of time, counted back from the last step (Vaswani et al. 2017, section 3.5)."""
    back = np.arange(times - 1, -1, -1)[:, None]
    angle = back / 10_000 ** (2 * np.arange((width + 1) // 2) / width)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(times, -1)[:, :width].astype(np.float32)


class Embedding(nnx.Module):
    """Map features to normalised tokens: dense layers per group, plus a time encoding for series.

    Features are embedded in float32: in bfloat16 a point 50 m away would move by 20 cm.
    """

    def __init__(
        self, spec: GroupSpec, width: int, hidden: tuple[int, ...], rngs: nnx.Rngs, dtype: Dtype
    ) -> None:
        self.forms = forms(spec)
        self.dtype = dtype
        self.hidden, self.out, self.norms = nnx.Dict(), nnx.Dict(), nnx.Dict()
        for name, form in self.forms.items():
            self.hidden[name] = dense_layers(form.features, hidden, rngs)
            self.out[name] = nnx.Linear(hidden[-1] if hidden else form.features, width, rngs=rngs)
            self.norms[name] = nnx.LayerNorm(width, rngs=rngs)
        self.width = width

    def __call__(self, groups: Groups) -> dict[str, Rows]:
        """Return the tokens of each group by name."""
        return {name: self._rows(groups, name) for name in self.forms}

    def _rows(self, groups: Groups, name: str) -> Rows:
        form = self.forms[name]
        x, mask = raw_rows(groups, name, form)
        for layer in self.hidden[name]:
            x = nnx.relu(layer(x))
        x = self.out[name](x)
        if form.series:
            x = x + jnp.asarray(time_code(form.times, self.width))
        return Rows(self.norms[name](x).astype(self.dtype), mask)


def concatenate_groups(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Concatenate tokens and masks of several groups."""
    return jnp.concatenate([x for x, _ in parts], axis=-2), jnp.concatenate([m for _, m in parts], axis=-1)
