"""Banks with the data that traffic models need in addition to the log."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Self, TypeVar, cast

import jax
from jaxtyping import Array, Int

from drivax.errors import UsageError
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.types import Traffic


class TrafficData:
    """Data of one traffic model for all scenarios of a bank; subclasses are records."""

    def part(self, rows: Int[Array, " n"]) -> Self:
        """Return the data of some scenarios."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


Data = TypeVar("Data", bound=TrafficData)


@record
class PreparedBank(ScenarioBank):
    """A bank and the data of its traffic models, at most one record of each type."""

    traffic: tuple[TrafficData, ...]

    def part(self, rows: Int[Array, " n"]) -> PreparedBank:
        """Return some of the scenarios as a bank."""
        logs = ScenarioBank.part(replace(self, traffic=()), rows)
        return replace(cast(PreparedBank, logs), traffic=tuple(data.part(rows) for data in self.traffic))


def prepare_bank(traffic: Traffic, bank: ScenarioBank) -> ScenarioBank:
    """Return the bank with the data that a traffic model needs."""
    prepare = getattr(traffic, "prepare", None)
    return bank if prepare is None else prepare(bank)


def with_data(bank: ScenarioBank, data: TrafficData) -> PreparedBank:
    """Return the bank with the data of a traffic model; data of the same type are replaced."""
    others = tuple(other for other in _all_data(bank) if type(other) is not type(data))
    logs = {field.name: getattr(bank, field.name) for field in fields(ScenarioBank)}
    return PreparedBank(**logs, traffic=(*others, data))


def find_data(bank: ScenarioBank, kind: type[Data]) -> Data | None:
    """Return the data of a type, or None if the bank has none."""
    return next((data for data in _all_data(bank) if isinstance(data, kind)), None)


def data_of(bank: ScenarioBank, kind: type[Data], cure: str = "call prepare_bank(traffic, bank)") -> Data:
    """Return the data of a type.

    Raises:
        UsageError: The bank has none; ``cure`` says how to add them.
    """
    data = find_data(bank, kind)
    if data is None:
        raise UsageError(f"the bank has no {kind.__name__}", cure=cure)
    return data


def _all_data(bank: ScenarioBank) -> tuple[TrafficData, ...]:
    return bank.traffic if isinstance(bank, PreparedBank) else ()
