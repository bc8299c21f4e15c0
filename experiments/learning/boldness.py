"""Metrics of aggressive driving (``boldness:speed_ratio``), used by ``aggressive.py``."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from drivax.metrics.catalogue import Metric
from drivax.metrics.steps import Moment, StepValue

#: Times to collision below this are short, s.
_SHORT_S = 1.0


def _share_of_limit(moment: Moment) -> tuple[Array, Array]:
    known = moment.facts.limit_mps > 0
    return moment.facts.speed_mps / jnp.where(known, moment.facts.limit_mps, 1.0), known


def _short(moment: Moment) -> tuple[Array, Array]:
    return (moment.facts.ttc_s < _SHORT_S).astype(jnp.float32), moment.facts.ttc_defined


def _changed(moment: Moment) -> tuple[Array, bool]:
    return moment.facts.lane_changed.astype(jnp.float32), True


def _acceleration(moment: Moment) -> tuple[Array, bool]:
    return moment.facts.acceleration_mps2, True


def _braking(moment: Moment) -> tuple[Array, bool]:
    return -moment.facts.acceleration_mps2, True


_ACCELERATION_FACTS = frozenset({"acceleration_mps2"})

speed_ratio = Metric(
    "-",
    "-",
    "mean speed as a share of the limit",
    step_value=StepValue("speed_ratio", "-", _share_of_limit, frozenset({"speed_mps", "limit_mps"})),
    operator="mean",
)
short_ttc = Metric(
    "-",
    "low",
    "share of driving with a time to collision below 1 s",
    step_value=StepValue("short_ttc", "-", _short, frozenset({"ttc_s", "ttc_defined"})),
    operator="mean",
)
lane_changes = Metric(
    "-",
    "-",
    "lane changes in an episode",
    step_value=StepValue("lane_changed", "-", _changed, frozenset({"lane_changed"})),
    operator="sum",
)
max_acceleration = Metric(
    "m/s2",
    "-",
    "largest acceleration over 0.5 s",
    step_value=StepValue("acceleration", "m/s2", _acceleration, _ACCELERATION_FACTS),
    operator="max",
)
max_braking = Metric(
    "m/s2",
    "-",
    "largest deceleration over 0.5 s",
    step_value=StepValue("braking", "m/s2", _braking, _ACCELERATION_FACTS),
    operator="max",
)
