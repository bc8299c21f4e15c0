"""Where reactive traffic went, kept in whole numbers so that an episode can be drawn as it happened."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int16

from drivax.scenario.bank.columns import AgentColumn

#: Units of places (m) and headings (rad); int16 reaches 655 m from the origin of a scenario.
_METRES, _RADIANS = 0.02, 1e-4
_REACH_M = 650.0
#: Stands for "not there".
_ABSENT = -32768


def packed(agents: Float[Array, "*batch A 8"]) -> Int16[Array, "*batch A 3"]:
    """Place and heading of traffic's rows; who is not there, or further from the origin than 650 m, is absent."""
    place = agents[..., AgentColumn.XY]
    heading = jnp.arctan2(agents[..., AgentColumn.SIN], agents[..., AgentColumn.COS])
    rows = jnp.concatenate([place / _METRES, heading[..., None] / _RADIANS], axis=-1)
    there = (agents[..., AgentColumn.VALID] > 0) & (jnp.abs(place) < _REACH_M).all(axis=-1)
    return jnp.where(there[..., None], jnp.round(rows), _ABSENT).astype(jnp.int16)


def unpacked(
    rows: Int16[np.ndarray[Any, Any], "*batch A 3"],
) -> Float32[np.ndarray[Any, Any], "*batch A 3"]:
    """Place (m) and heading (rad), NaN where absent."""
    poses = rows * np.array([_METRES, _METRES, _RADIANS], np.float32)
    return np.where(rows == _ABSENT, np.nan, poses).astype(np.float32)
