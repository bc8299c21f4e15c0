"""Kinds of traffic by name."""

from __future__ import annotations

from collections.abc import Callable

from drivax.errors import UsageError
from drivax.plugins import find_named, is_dotted
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.simulator.types import Traffic

TRAFFIC: dict[str, Callable[[], Traffic]] = {"log": LogTraffic, "idm": IdmTraffic}


def make_traffic(name: str) -> Traffic:
    """The traffic of a name: one of :data:`TRAFFIC`, or ``package.module:name`` of a class or function of your own.

    Raises:
        UsageError: If there is none of that name, or it is no traffic.
    """
    if name in TRAFFIC:
        return TRAFFIC[name]()
    if not is_dotted(name):
        raise UsageError(
            f"there is no traffic {name!r}", cure=f"use {', '.join(TRAFFIC)}, or package.module:name"
        )
    made = find_named(name)()
    if not isinstance(made, Traffic):
        raise UsageError(f"{name!r} makes no traffic", cure="see drivax.simulator.types.Traffic")
    return made
