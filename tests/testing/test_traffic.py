"""Check of traffic: built-in and custom models pass, and each rule has a model that violates it."""

import itertools
import re
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

import own_terms
from drivax.simulator.traffic.log import LogTraffic
from drivax.tasks.features import View
from drivax.testing import BrokenContract, check_traffic
from drivax.testing.simulation import _check_rows, _Rollout

count = itertools.count()


def test_log_replay_passes():
    check_traffic(LogTraffic())


def test_classes_of_traffic_models_fail():
    with pytest.raises(
        BrokenContract, match="is not a traffic model; give it name, start, advance and agents"
    ):
        check_traffic(LogTraffic)


def test_rows_without_agents_pass():
    rows, view = np.zeros((1, 2, 3, 8), np.float32), View(jnp.zeros(2), jnp.ones(()), jnp.zeros(()))
    _check_rows("traffic 'empty'", _Rollout(rows, rows, view))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["idm", "own_terms:Drift"])
def test_reactive_and_custom_traffic_pass(name):
    check_traffic(name)


@dataclass(frozen=True)
class Wrong(own_terms.Drift):
    """Drift with a fault."""

    fault: str = ""

    def start(self, bank, index, step):
        rows = super().start(bank, index, step)
        if self.fault == "order":
            return rows.at[:, 5:7].multiply(1.0 + jnp.arange(len(rows))[:, None] / 100.0)
        if self.fault == "padding":
            return rows.at[:, 5:7].multiply(len(rows) / 40.0)
        if self.fault == "litter":
            return rows.at[:, 5:7].multiply(1.0 + jnp.abs(rows[:, 0]).max() / 2000.0)
        return jnp.zeros((9000,)).at[: rows.size].set(rows.ravel()) if self.fault == "size" else rows

    def advance(self, bank, context, frame):
        if self.fault == "size":
            return context.traffic
        rows = super().advance(bank, context, frame)
        change = {"form": rows[1:], "random": rows + float(next(count))}
        change["turn"] = rows.at[:, 0].add(0.05)
        change["leap"] = rows.at[:, 0].add(9.0)
        return change.get(self.fault, rows)

    def agents(self, bank, context, back):
        if self.fault == "size":
            return bank.agents[context.index, context.step]
        rows = super().agents(bank, context, 0 if self.fault == "past" else back)
        if self.fault in ("turn", "leap", "random"):
            rows = rows.at[:, 0].add(-back * {"turn": 0.05, "leap": 9.0, "random": 0.0}[self.fault])
        change = {
            "shape": rows[:, :7],
            "half": rows.at[:, 7].multiply(0.5),
            "unit": rows.at[:, 3:5].multiply(1.1),
        }
        change["nan"] = rows.at[:, 0].divide(rows[:, 7])
        return change.get(self.fault, rows)


@pytest.mark.parametrize(
    ("fault", "words"),
    {
        "form": "changes the shape of its state", "size": "carries 36000 bytes", "random": "is not deterministic",
        "shape": r"float32\[40, 7\]", "nan": "is not finite", "half": "fractional valid",
        "unit": "directions of length 1.1",
        "past": "changes past rows", "leap": "moves an agent by", "order": "order of agents changes",
        "padding": "empty slots are added", "litter": "rows of absent agents change", "turn": "rotated and shifted",
    }.items(),
)  # fmt: skip
def test_invalid_traffic_fails(fault, words):
    with pytest.raises(BrokenContract) as error:
        check_traffic(Wrong(fault=fault))
    assert re.search(words, str(error.value)) and "\n" not in str(error.value), str(error.value)
