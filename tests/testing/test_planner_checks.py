"""Check of planners: built-in planners pass, and each rule has a planner that violates it."""

from __future__ import annotations

import itertools
import re

import jax.numpy as jnp
import pytest

from drivax.planners.planner import Memoryless
from drivax.planners.simple import ConstantVelocity, expert_action
from drivax.scenario.record import record, static
from drivax.tasks.actions import PHYSICAL
from drivax.testing import BrokenContract, check_planner

count = itertools.count()


@record
class Wrong(Memoryless):
    """A planner that violates one rule."""

    fault: str = static(default="")
    name: str = static(default="wrong")
    replays: bool = static(default=False)

    def init(self, bank, state, key):
        return jnp.zeros(2)

    def act(self, carry, bank, state, situation, observation, key):
        frame, context = situation.surroundings.frame, state.context
        carry = jnp.zeros(3) if self.fault == "form" else carry
        if self.fault == "python" and situation.facts.speed_mps > 3:
            return jnp.zeros(2), carry
        here = {
            "size": jnp.zeros(3),
            "pair": (jnp.zeros(()), jnp.zeros(())),
            "finite": jnp.stack([1.0 / jnp.maximum(frame.valid.sum() - 1.0, 0.0), 0.0]),
            "random": jnp.full(2, 0.1) * next(count),
            "litter": jnp.stack([jnp.max(jnp.abs(frame.velocity)) / 1e3, 0.0]),
            "order": jnp.stack([frame.valid[5] * jnp.sum(frame.velocity[5] ** 2) / 1e3, 0.0]),
            "padding": jnp.stack([frame.valid.mean(dtype=jnp.float32), 0.0]),
            "turn": jnp.stack([jnp.zeros(()), jnp.cos(context.history[-1, 2])]),
            "future": expert_action(bank, context, PHYSICAL),
        }
        return here.get(self.fault, jnp.zeros(2)), carry


def refused(planner, words):
    with pytest.raises(BrokenContract) as error:
        check_planner(planner)
    assert re.search(words, str(error.value)), str(error.value)
    assert "\n" not in str(error.value) and "; " in str(error.value)


def test_shapes_are_checked_before_anything_runs():
    refused(ConstantVelocity, "is not a planner")
    refused(Wrong(fault="size"), r"gives float32\[3\] as an action; return float32\[2\]")
    refused(Wrong(fault="pair"), r"gives float32\[\], float32\[\] as an action; return float32\[2\]")
    refused(Wrong(fault="form"), "changes the shape of its carry")
    refused(Wrong(fault="python"), "cannot be compiled")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["constant_velocity", "idm", "pdm", "search_planner:SearchPlanner"])
def test_built_in_planners_pass(name):
    check_planner(name)


@pytest.mark.slow
def test_experts_pass_as_privileged_planners():
    check_planner("expert_actions", privileged=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "words"),
    {
        "finite": "is not finite", "random": "is not deterministic", "litter": "rows of absent agents change",
        "order": "order of agents changes", "padding": "empty slots are added", "turn": "rotated and shifted",
        "future": "the log's future changes",
    }.items(),
)  # fmt: skip
def test_invalid_planners_fail(fault, words):
    refused(Wrong(fault=fault), words)
