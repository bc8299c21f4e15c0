from __future__ import annotations

import pytest

from drivax.cli.generate import Generate, run
from drivax.errors import UsageError
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import (
    BENCHMARK_VERSION,
    RESERVED_SEED,
    SPLITS,
    Generation,
    generate_benchmark,
    sizes,
)
from drivax.synthetic.world import WORLD_VERSION, WorldConfig

TRAIN = 8


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("benchmark") / "sets"
    progress = []
    sets = generate_benchmark(path, train=TRAIN, progress=lambda done, total: progress.append((done, total)))
    return path, sets, progress


def test_sizes_follow_the_table_or_scale():
    assert sizes() == {"train": 4096, "validation": 512, "test": 1024, "test-rare": 512}
    assert sizes(64) == {"train": 64, "validation": 8, "test": 16, "test-rare": 8}
    assert sizes(1) == {"train": 1, "validation": 1, "test": 1, "test-rare": 1}
    with pytest.raises(UsageError, match="the size of the training set is 0; use 1 or more scenarios"):
        sizes(0)


def test_existing_set_is_refused_before_others_are_written(tmp_path):
    (tmp_path / "test-rare").mkdir()
    (tmp_path / "test-rare" / "manifest.json").touch()
    with pytest.raises(UsageError, match="test-rare: output folder already exists"):
        generate_benchmark(tmp_path, train=1)
    assert [child.name for child in tmp_path.iterdir()] == ["test-rare"]


@pytest.mark.slow
def test_benchmark_sets_share_no_map(small):
    path, sets, progress = small
    assert sorted(sets) == sorted(SPLITS) == sorted(child.name for child in path.iterdir())
    total = sum(sizes(TRAIN).values())
    assert progress == [(done, total) for done in range(1, total + 1)]
    segments = []
    for name, split in SPLITS.items():
        scenarios = ScenarioSet.open(path / name)
        assert len(scenarios) == sizes(TRAIN)[name] == sets[name].scenarios
        source = scenarios.manifest["source"]
        assert (source["benchmark"], source["split"]) == (BENCHMARK_VERSION, name)
        assert (source["world"], source["seed"]) == (WORLD_VERSION, split.seed)
        assert source["config"]["rare_rate"] == (1.0 if name == "test-rare" else WorldConfig().rare_rate)
        segments.append({entry["segment"] for entry in scenarios.entries})
    assert sum(map(len, segments)) == len(set().union(*segments))
    seeds = [split.seed for split in SPLITS.values()]
    assert len(set(seeds)) == len(seeds) and min(seeds) >= RESERVED_SEED


@pytest.mark.slow
def test_smaller_benchmark_is_a_prefix_of_a_larger_one(small, tmp_path):
    path, *_ = small
    generate_benchmark(tmp_path / "less", Generation(), train=1)
    for name in SPLITS:
        first, again = ScenarioSet.open(path / name)[0], ScenarioSet.open(tmp_path / "less" / name)[0]
        assert first.record.tobytes() == again.record.tobytes()


@pytest.mark.slow
def test_command_names_benchmark_and_world(tmp_path, capsys):
    out = tmp_path / "sets"
    assert run(Generate(out=out, benchmark=True, scenarios=1, workers=1)) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"benchmark {BENCHMARK_VERSION} of world {WORLD_VERSION}, domain grid\n")
    assert all(f"{out / name}: 1 scenarios" in printed for name in SPLITS)
    with pytest.raises(UsageError, match="a fixed world; leave out all of its settings but --domain"):
        run(Generate(out=out, benchmark=True, workers=1), ["--rare_rate", "0.5"])
    with pytest.raises(UsageError, match="world is fixed but for its domain"):
        generate_benchmark(tmp_path / "other", Generation(world=WorldConfig(rare_rate=0.5)), train=1)
    for more in ({"seed": 1}, {"split": "80/10/10"}):
        with pytest.raises(UsageError, match="seeds and splits of its own"):
            run(Generate(out=out, benchmark=True, workers=1, **more))
