"""Merging sets: scenarios keep what they are, also in a larger capacity."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from drivax.cli import main
from drivax.datasets import merge
from drivax.errors import DataError, UsageError
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CAPACITIES, Capacity, common_capacity
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("merge")
    generate(folder / "default", 3, 1, Generation(workers=0))
    generate(folder / "large", 2, 2, Generation(workers=0, capacity="large"))
    return [folder / "default", folder / "large"]


def test_merged_scenarios_are_those_of_the_sets(sets, tmp_path):
    result = merge(sets, tmp_path / "both")
    merged, originals = (
        ScenarioSet.open(tmp_path / "both"),
        [s for path in sets for s in ScenarioSet.open(path)],
    )
    assert result.scenarios == len(merged) == 5 and merged.capacity == CAPACITIES["large"]
    entries = [entry for path in sets for entry in ScenarioSet.open(path).entries]
    assert merged.entries == entries
    assert [part["hash"] for part in merged.manifest["source"]["merged"]] == [
        ScenarioSet.open(p).hash for p in sets
    ]
    merged.check()
    for scenario, original in zip(merged, originals, strict=True):
        # Padding is not simulated: both make the same bank.
        sizes = ScenarioBank.from_scenarios([scenario]), ScenarioBank.from_scenarios([original])
        for (path, one), (_, other) in zip(*map(jax.tree.leaves_with_path, sizes), strict=True):
            np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path))


def test_a_filter_selects_from_every_set(sets, tmp_path):
    tracks = [[entry["source"]["tracks"] for entry in ScenarioSet.open(path).entries] for path in sets]
    least = min(map(max, tracks))  # so that each set has some
    expected = [count for counts in tracks for count in counts if count >= least]
    assert len(expected) < 5
    command = ["merge", *map(str, sets), "--filter", f"tracks>={least}", "--out", str(tmp_path / "many")]
    assert main(command) == 0
    merged = ScenarioSet.open(tmp_path / "many").entries
    assert [entry["source"]["tracks"] for entry in merged] == expected


def test_sets_that_cannot_be_merged_are_refused(sets, tmp_path, capsys):
    out = tmp_path / "out"
    with pytest.raises(UsageError, match="merge needs at least two sets; name two or more"):
        merge(sets[:1], out)
    with pytest.raises(DataError, match=r"scenario .* of .* is also in .*default; name each set once"):
        merge([sets[0], sets[0]], out)
    with pytest.raises(UsageError, match="is the input set"):
        merge(sets, sets[1], overwrite=True)
    with pytest.raises(DataError, match="no scenario is selected"):
        merge(sets, out, filters=["family=none"])
    assert not out.exists()
    assert main(["merge", str(sets[0]), str(tmp_path / "missing"), "--out", str(out)]) == 1
    assert "folder not found" in capsys.readouterr().err


def test_capacities_with_other_steps_have_nothing_in_common():
    default, large = CAPACITIES["default"], CAPACITIES["large"]
    assert common_capacity([default, large, default]) == large
    several = common_capacity([large, default.with_egos(4)])
    assert several == replace(large, name="default-4egos+large", egos=4)
    with pytest.raises(
        UsageError, match=r"'default-15s' has steps 161, 'default' 91; convert both with one --fut"
    ):
        common_capacity([default, default.with_future(15.0)])
    with pytest.raises(
        UsageError, match="'small' has grid 32, 'default' 64; convert both with one --capacity"
    ):
        common_capacity([default, Capacity(name="small", grid=32)])
