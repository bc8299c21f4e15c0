"""Checks of numeric settings; NaN fails all of them, and None (a setting that is off) passes.

An untrusted run states its own sizes. Upper bounds far beyond practical values keep it from taking all memory or time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from drivax.errors import UsageError

#: Largest number of environments, of steps or updates per iteration, and of samples per batch.
MOST_SAMPLES = 1 << 20
#: Largest number of steps of n-step returns.
MOST_RETURN_STEPS = 1000
#: Largest number of steps that an iteration collects in all environments; those of the presets collect up to 8,192.
MOST_STEPS_PER_ITERATION = 1 << 24


def check_at_least(config: Any, least: int, *names: str) -> None:
    """Raise UsageError for the first of these settings that is below ``least``."""
    _check(config, names, lambda value: value >= least, f"use {least} or more")


def check_at_most(config: Any, most: int, *names: str) -> None:
    """Raise UsageError for the first of these settings that is above ``most``."""
    _check(config, names, lambda value: value <= most, f"use {most:,} or less")


def check_counts(config: Any, *names: str, most: int = MOST_SAMPLES) -> None:
    """Raise UsageError for the first of these settings that is below 1, or else above ``most``."""
    check_at_least(config, 1, *names)
    check_at_most(config, most, *names)


def check_above_zero(config: Any, *names: str) -> None:
    """Raise UsageError for the first of these settings that is not above 0."""
    _check(config, names, lambda value: value > 0, "use more than 0")


def check_shares(config: Any, *names: str) -> None:
    """Raise UsageError for the first of these settings that is outside [0, 1]."""
    _check(config, names, lambda value: 0 <= value <= 1, "use 0 to 1")


def _check(config: Any, names: tuple[str, ...], is_valid: Callable[[Any], bool], cure: str) -> None:
    for name in names:
        value = getattr(config, name)
        if value is not None and not is_valid(value):
            raise UsageError(f"{name} is {value}", cure=cure)
