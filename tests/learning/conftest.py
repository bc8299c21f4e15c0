"""What tests of learning share."""

import pytest

from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("learning") / "set"
    generate(path, 3, 11, Generation(workers=0))
    return ScenarioSet.open(path)


@pytest.fixture(scope="session")
def scenarios(tmp_path_factory):
    """Enough scenarios that some can be resident, or belong to a stage."""
    path = tmp_path_factory.mktemp("scenarios") / "set"
    generate(path, 8, 5, Generation(workers=0))
    return ScenarioSet.open(path)


@pytest.fixture(scope="session")
def data_of_egos(tmp_path_factory):
    """The scenarios of ``data``, with routes of further egos."""
    path = tmp_path_factory.mktemp("egos") / "set"
    generate(path, 3, 11, Generation(workers=0, egos=8))
    return ScenarioSet.open(path)
