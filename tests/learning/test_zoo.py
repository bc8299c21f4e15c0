"""Policies that are packed and shipped: what comes back is what was trained, under one name everywhere."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import drivax
from drivax import settings
from drivax.api import find_planner
from drivax.cli import main
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.policies import (
    POLICY_FILE,
    PolicyTraffic,
    export_policy,
    find_traffic,
    load_policy,
    policy_traffic,
)
from drivax.planners.catalogue import PLANNERS
from drivax.planners.planner_traffic import TrafficDriver
from drivax.planners.simple import IdmPlanner
from drivax.scenario.build.assemble import assemble
from drivax.seal import allow_edited, seal
from drivax.simulator.traffic.bank_data import data_of, prepare_bank
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.actions import Route
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder, is_policy, policy_folder, policy_training_sets, zoo
from scenes import bank_of, car, straight_road
from tiny_run import TINY, write_run


@pytest.fixture(scope="module")
def bank():
    return bank_of(straight_road([car(speed=10.0), car(20.0, speed=6.0)]))


@pytest.fixture(scope="module")
def run(tmp_path_factory, bank):
    return write_run(tmp_path_factory.mktemp("runs") / "bold", bank)


def weights(planner):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(planner.parameters)]


@pytest.mark.slow
def test_exported_policy_is_the_best_of_its_run(run, bank, tmp_path):
    packed = export_policy(run.path, tmp_path / "packed", bank, {"measured": {"speed": 0.5}})
    (one, task), (best, _) = load_policy(packed.path, bank), load_policy(run.path, bank, step=4)
    assert task == settings.load(TrainConfig, TINY).task and one.name == "packed"
    assert jax.tree.structure(replace(one, name="bold@4")) == jax.tree.structure(best)
    for mine, its in zip(weights(one), weights(best), strict=True):
        np.testing.assert_array_equal(mine, its)
    newest, _ = load_policy(run.path, bank, step=8)
    assert any((mine != its).any() for mine, its in zip(weights(one), weights(newest), strict=True))
    assert load_policy(packed.path, bank, samples=True)[0].samples


def test_exported_policy_has_provenance_without_paths(run, bank, tmp_path):
    packed = export_policy(run.path, tmp_path / "packed", bank, {"measured": {"speed": 0.5}})
    assert sorted(path.name for path in packed.path.iterdir()) == [
        "config.yaml", POLICY_FILE, "run.json", "seal.json",
    ]  # fmt: skip
    assert packed.config(TrainConfig) == settings.load(TrainConfig, TINY)
    info = json.loads((packed.path / "run.json").read_text())
    assert info["data"] == [{"hash": "f00d", "scenarios": 3}] and info["machine"] is None
    assert (info["kind"], info["step"], info["command"]) == ("policy", 4, "drivax train tiny")
    assert info["validation"] == "c0de" and info["measured"] == {"speed": 0.5} and "jax" in info["versions"]
    # The value network stays behind.
    stored = np.load(packed.path / POLICY_FILE)
    assert sum(stored[name].size for name in stored.files) == sum(
        leaf.size for leaf in weights(load_policy(run.path, bank)[0])
    )


def test_training_is_not_replaced_by_its_policy(run, bank):
    with pytest.raises(UsageError, match="contains a run of kind training, not policy"):
        export_policy(run.path, run.path, bank, overwrite=True)


def test_policy_of_the_working_folder_has_its_name(run, bank, monkeypatch):
    (run.path / "inner").mkdir()
    monkeypatch.chdir(run.path)
    assert (
        load_policy(".", bank)[0].name == policy_traffic(".").name.removeprefix("driven_by_") == run.path.name
    )
    monkeypatch.chdir("inner")
    assert load_policy("..", bank)[0].name == run.path.name


def test_failed_export_leaves_the_former_policy(run, bank, tmp_path, monkeypatch):
    """A folder never appears without all of its files."""
    former = export_policy(run.path, tmp_path / "packed", bank)
    files = {path.name: path.read_bytes() for path in former.path.iterdir()}
    assert RunFolder.open(former.path) == former

    def fail(*_):
        raise RuntimeError("disk failed")

    for name in ("pack", "seal"):
        with monkeypatch.context() as context, pytest.raises(RuntimeError, match="disk failed"):
            context.setattr(f"drivax.learning.policies.{name}", fail)
            export_policy(run.path, former.path, bank, {"measured": {}}, overwrite=True)
        assert {path.name: path.read_bytes() for path in former.path.iterdir()} == files
    assert [path.name for path in tmp_path.iterdir()] == ["packed"]


@pytest.mark.slow
def test_exported_policies_have_no_steps_or_checkpoints(run, bank, tmp_path):
    packed = export_policy(run.path, tmp_path / "packed", bank)
    with pytest.raises(UsageError, match="is an exported policy without steps; leave out @4"):
        find_planner(f"{packed.path}@4", bank)
    with pytest.raises(UsageError, match="already exists"):
        export_policy(run.path, packed.path, bank)
    wider = {**TINY, "algorithm": {**TINY["algorithm"], "network": {"encoder": {"rows": [4], "hidden": [9]}}}}
    (packed.path / "config.yaml").write_text(settings.dump(settings.load(TrainConfig, wider)))
    with pytest.raises(DataError, match=r"config\.yaml: changed since drivax wrote it"):
        load_policy(packed.path, bank)
    seal(packed.path, "config.yaml")
    with pytest.raises(DataError, match=r"parameters.* in the checkpoint, not"):
        load_policy(packed.path, bank)
    (packed.path / POLICY_FILE).write_bytes(b"PK")
    seal(packed.path, POLICY_FILE)
    with pytest.raises(DataError, match=r"policy\.npz: not an \.npz file, or damaged"):
        load_policy(packed.path, bank)


def test_policies_load_without_their_training_traffic(run, bank, tmp_path):
    text = (run.path / "config.yaml").read_text()
    moved = RunFolder.create(tmp_path / "moved", settings.load(TrainConfig, TINY), kind="training")
    (moved.path / "config.yaml").write_text(text.replace("traffic: idm", "traffic: runs/gone"))
    seal(moved.path, "config.yaml")
    run.checkpoints.rename(moved.checkpoints)
    try:
        assert weights(load_policy(moved.path, bank)[0])
    finally:
        moved.checkpoints.rename(run.checkpoints)


def test_traffic_is_found_by_name(run, tmp_path):
    assert find_traffic("log") == LogTraffic() and find_traffic("idm") == IdmTraffic()
    assert isinstance(find_traffic("drivax.simulator.traffic.reactive:IdmTraffic"), IdmTraffic)
    path = str(run.path)
    assert find_traffic(path) == policy_traffic(path) and find_traffic(path).name == "driven_by_bold"
    mixed = find_traffic(f"{path}+idm")
    assert mixed == policy_traffic(path, base=IdmTraffic()) and mixed.name == "driven_by_bold+idm"
    assert isinstance(find_traffic("zoo:aggressive+idm"), PolicyTraffic)
    for name, words in (
        ("runs/none", "unknown traffic 'runs/none'; use log, idm,.* zoo:aggressive"),
        ("runs/none+idm", "unknown traffic 'runs/none.idm'"),
        ("zoo:agressive+idm", "no policy 'zoo:agressive' in the zoo; use zoo:aggressive"),
        ("zoo:aggressive+idn", "no policy 'zoo:aggressive.idn' in the zoo"),
    ):
        with pytest.raises(UsageError, match=words):
            find_traffic(name)
    with pytest.raises(DataError, match="not a run folder"):
        find_traffic(str(tmp_path))


def test_no_folder_shadows_a_name(run, bank, tmp_path, monkeypatch):
    names = ("idm", "zoo:ppo", "drivax.planners.simple:IdmPlanner")
    traffic = "drivax.simulator.traffic.reactive:IdmTraffic"
    for name in (*names, traffic):
        shutil.copytree(run.path, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert find_planner("idm", bank)[0] == find_planner(names[2], bank)[0] == IdmPlanner()
    for name in names:
        with pytest.raises(UsageError, match=f"trained policy './{name}' has its own task"):
            find_planner(f"./{name}", bank, task=Task())
        other, own = (policy_training_sets(path, PLANNERS) for path in (name, f"./{name}"))
        assert other != own == run.info["data"]
        assert not is_policy(name, PLANNERS) or name == "zoo:ppo"
    assert find_traffic("idm") == find_traffic(traffic) == IdmTraffic()
    assert find_traffic("zoo:ppo").run == str(policy_folder("zoo:ppo"))
    for name in ("idm", "zoo:ppo", traffic):
        assert find_traffic(f"./{name}").run == find_traffic(f"./{name}+idm").run == str(tmp_path / name)
    with pytest.raises(UsageError, match=r"unknown traffic 'idm\+idm'"):
        find_traffic("idm+idm")
    with pytest.raises(UsageError, match=r"trained policy '/.*/idm' has its own task"):
        drivax.evaluate(Path("idm"), drivax.load([assemble(straight_road([car()]))]), task=Task())


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        (
            {"hidden": [10**6]},
            r"config\.yaml: algorithm\.network\.encoder: hidden has a layer of width 1000000",
        ),
        ({"hidden": [4096] * 20}, r"config\.yaml: a network has 320,060,837 parameters; use 33,554,432"),
    ],
)
def test_policy_of_huge_sizes_is_refused_at_once(sizes, words, bank, tmp_path):
    folder = shutil.copytree(policy_folder("zoo:ppo"), tmp_path / "huge")
    values = settings.parse_yaml((folder / "config.yaml").read_text())
    values["algorithm"]["network"]["encoder"] |= sizes
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    with allow_edited(), pytest.raises(DrivaxError, match=words) as raised:
        find_planner(str(folder), bank)
    assert "\n" not in str(raised.value)


def test_names_of_the_zoo():
    assert "zoo:aggressive" in zoo() and all(is_policy(name) for name in zoo())
    assert policy_folder("runs/a") == Path("runs/a") and not is_policy("idm")
    for name in ("zoo:", "zoo:../zoo/aggressive", "zoo:agressive"):
        with pytest.raises(UsageError, match="in the zoo; use zoo:aggressive"):
            policy_folder(name)


def test_misspelt_policy_lists_the_names(bank, capsys, tmp_path):
    command = [
        "evaluate",
        "--planner",
        "idm",
        "--traffic",
        "zoo:bold",
        "--data",
        str(tmp_path),
        "--out",
        "out",
    ]
    assert main(command) == 2
    message = f"no policy 'zoo:bold' in the zoo; use {', '.join(zoo())}"
    assert capsys.readouterr().err == f"drivax: {message}\n"
    with pytest.raises(UsageError, match=message):
        find_planner("zoo:bold", bank)


@pytest.mark.parametrize("name", zoo())
def test_shipped_policies_drive_and_have_provenance(name, bank):
    folder = policy_folder(name)
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5e5
    info = json.loads((folder / "run.json").read_text())
    assert info["kind"] == "policy" and info["command"].startswith("drivax train ")
    assert {"jax", "flax", "numpy", "drivax"} <= set(info["versions"])
    assert all(re.fullmatch(r"[0-9a-f]{64}", data["hash"]) for data in info["data"]) and info["data"]
    assert info["measured"]["ego"] and not re.search(r'"/|/(tmp|home|root)/', json.dumps(info))
    planner, task = find_planner(name, bank)
    assert planner.name == name.removeprefix("zoo:") and all(
        np.isfinite(leaf).all() for leaf in weights(planner)
    )
    with pytest.raises(UsageError, match="without steps"):
        find_planner(f"{name}@5", bank)
    among = find_traffic(name)
    assert among.task == task
    if isinstance(task.actions, Route):
        with pytest.raises(UsageError, match="cannot drive others without routes"):
            prepare_bank(among, bank)
    else:
        assert data_of(prepare_bank(among, bank), TrafficDriver).planner.name == planner.name


@pytest.mark.slow
def test_aggressive_policy_drives_as_planner_and_as_traffic(data, tmp_path):
    loaded = drivax.load(data.path)
    alone = drivax.evaluate("zoo:aggressive", loaded)
    pushed = drivax.evaluate("zoo:aggressive", loaded, traffic="zoo:aggressive+idm")
    assert pushed.traffic == "driven_by_aggressive+idm"
    assert np.isfinite(alone.metrics["distance"]).all()
    assert (alone.metrics["average_ttc"] != pushed.metrics["average_ttc"]).any()
    command = [
        "evaluate",
        "--planner",
        "zoo:aggressive",
        "--traffic",
        "zoo:aggressive+idm",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main([*command, "--data", str(data.path)]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["planner"], summary["traffic"]) == ("aggressive", "driven_by_aggressive+idm")
    assert summary["metrics"]["distance"]["mean"] == pytest.approx(
        pushed.metrics["distance"].mean(), rel=1e-5
    )
