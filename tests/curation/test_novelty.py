"""Novelty and diverse selection against brute force, and on a set with an odd recording."""

import itertools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.ensemble import EnsembleConfig, load_ensemble
from drivax.curation.methods import Request, curate
from drivax.curation.novelty import Embedding, NoveltyConfig, nearest_distances, scenario_embeddings
from drivax.curation.scores import diverse_rows, read_scores
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenes import SMALL, car, straight_road

CONFIG = NoveltyConfig(neighbours=3, reference=200)


def write(path, scenes):
    with ScenarioWriter(path, SMALL) as writer:
        for row, cars in enumerate(scenes):
            recording = replace(straight_road(cars), scenario_id=f"s{row}", segment=f"r{row}")
            writer.add(assemble(recording, SMALL))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Seven similar recordings, of which the first two are equal, and one with many cars and another speed."""
    plain = [[car(speed=8.0), car(x=40.0, speed=8.0)] for _ in range(2)]
    plain += [[car(speed=8.0 + 0.1 * n), car(x=40.0 + n, speed=8.0)] for n in range(1, 6)]
    odd = [car(speed=2.0), *(car(x=12.0 * n, y=3.7 * (-1) ** n, speed=1.0) for n in range(-3, 5) if n)]
    return write(tmp_path_factory.mktemp("novelty") / "set", [*plain, odd])


def test_distances_are_those_of_brute_force():
    rng = np.random.default_rng(0)
    values, reference = rng.normal(size=(3, 5, 4)), rng.normal(size=(20, 4))
    own, other = np.array([0, 1, 9]), rng.integers(0, 3, 20)
    result = nearest_distances(
        *(
            jnp.asarray(x, jnp.float32) if x.dtype == float else jnp.asarray(x)
            for x in (values, own, reference, other)
        ),
        3,
    )
    for row, step in itertools.product(range(3), range(5)):
        distance = np.linalg.norm(values[row, step] - reference[other != own[row]], axis=1)
        assert result[row, step] == pytest.approx(np.sort(distance)[:3].mean(), rel=1e-4)


def test_odd_recordings_are_novel(data, tmp_path):
    table = curate("novelty", Request(data, config=CONFIG))
    assert table.scenarios.argmax() == 7
    assert table.scenarios[7] > 1.5 * np.sort(table.scenarios)[-2]
    assert curate("novelty", Request(data, config=CONFIG)).steps.tolist() == table.steps.tolist()
    # The two equal recordings are each other's nearest neighbours.
    assert table.scenarios[0] == pytest.approx(table.scenarios[1], rel=0.15)
    with pytest.raises(DataError, match="use a set of two or more"):
        curate("novelty", Request(write(tmp_path / "one", [[car()]]), config=CONFIG))


def test_order_of_agents_does_not_matter(data, tmp_path):
    cars = [car(x=40.0, speed=8.0), car(x=20.0, y=3.7, speed=5.0)]
    both = write(tmp_path / "set", [[car(speed=8.0), *cars], [car(speed=8.0), *cars[::-1]]])
    embedding = Embedding.of(CONFIG, both)
    rows = scenario_embeddings(embedding, both, np.ones((2, 91), bool))
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-4)


def test_diverse_rows_cover_the_candidates():
    """Greedy k-center: no selection of as many has less than half of its largest distance."""
    rng = np.random.default_rng(1)
    embedding, rows = rng.normal(size=(30, 2)), rng.permutation(30)
    embedding[rows[3]] = embedding[rows[0]]
    candidates = rows[:12]
    selected = diverse_rows(rows.tolist(), embedding, 3)
    assert selected[0] == rows[0] and set(selected) <= set(candidates) and rows[3] not in selected
    assert selected == sorted(selected, key=rows.tolist().index)

    def radius(chosen):
        distance = np.linalg.norm(embedding[candidates][:, None] - embedding[list(chosen)], axis=-1)
        return distance.min(axis=1).max()

    best = min(map(radius, itertools.combinations(candidates, 3)))
    assert best <= radius(selected) <= 2.0 * best
    assert diverse_rows([4, 5, 6], np.zeros((8, 2)), 3) == [4]


def test_diverse_subsets_have_no_duplicates(data, tmp_path, capsys):
    top, scores = tmp_path / "top", tmp_path / "scores.npz"
    call = ["curate", "uniform", "--data", str(data.path), "--out", str(scores)]
    assert main([*call, "--export", str(top), "8", "--diverse"]) == 0
    assert "the 7 different critical scenarios" in capsys.readouterr().out
    subset = ScenarioSet.open(top)
    ids = [entry["scenario_id"] for entry in subset.entries]
    assert len(ids) == 7 and not {"s0", "s1"} <= set(ids) and "s7" in ids
    assert read_scores(top / "scores.npz", subset).scenario_ids == tuple(ids)
    assert main([*call, "--diverse", "--overwrite"]) == 2
    assert "--diverse without a subset to choose" in capsys.readouterr().err


@pytest.mark.slow
def test_members_of_an_ensemble_embed(data, tmp_path):
    members = tmp_path / "members"
    call = ["curate", "ensemble", "--data", str(data.path), "--out", str(tmp_path / "e.npz"), "--folds", "3"]
    call += [
        "--total_steps",
        "640",
        "--cloning.batch",
        "16",
        "--cloning.updates",
        "4",
        "--members",
        str(members),
    ]
    assert main(call) == 0
    assert load_ensemble(members, data).config == EnsembleConfig(
        folds=3, total_steps=640, cloning=replace(EnsembleConfig().cloning, batch=16, updates=4)
    )
    table = curate("novelty", Request(data, config=CONFIG, members=members))
    assert table.scenarios.argmax() == 7
    with pytest.raises(UsageError, match="not found"):
        curate("novelty", Request(data, config=CONFIG, members=tmp_path / "none"))
