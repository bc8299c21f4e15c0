"""The identity of a scenario: a number that set, order and other scenarios do not change."""

import subprocess
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.scenario.bank.scenario_bank import ScenarioBank, identities
from drivax.scenario.build.assemble import assemble
from scenes import SMALL, car, straight_road


def test_identities_equal_an_independent_implementation():
    """``b2sum`` of coreutils, first four bytes, little-endian."""
    names = [("womd", "a"), ("av2", "a"), ("womd", "a")]
    expected = []
    for name, count in zip(names, (0, 0, 1), strict=True):
        try:
            done = subprocess.run(
                ["b2sum", "--length", "32"], input="\0".join((*name, str(count))).encode(),
                capture_output=True, check=True,
            )  # fmt: skip
        except FileNotFoundError:
            pytest.skip("no b2sum here")
        expected.append(int.from_bytes(bytes.fromhex(done.stdout.split()[0].decode()), "little"))
    assert identities(names).tolist() == expected and len(set(expected)) == 3


def test_identity_moves_with_its_scenario():
    scenarios = [
        assemble(replace(straight_road([car()]), scenario_id=name), SMALL) for name in ("a", "b", "c", "a")
    ]
    bank = ScenarioBank.from_scenarios(scenarios, trim=False)
    other = ScenarioBank.from_scenarios([scenarios[2], scenarios[0]], trim=False)
    a, _, c, copy = np.asarray(bank.identity).tolist()
    assert np.asarray(other.identity).tolist() == [c, a] and copy != a
    part = jax.jit(ScenarioBank.part)(bank, jnp.array([2, 0]))
    jax.tree.map(np.testing.assert_array_equal, part, other)
