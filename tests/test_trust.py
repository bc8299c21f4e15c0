"""Files of strangers: what they name is neither imported nor called, unless the user trusts its module."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import drivax
import own_terms
from drivax import settings
from drivax.adapters.gym import DrivingEnv, VectorDrivingEnv
from drivax.api import find_planner
from drivax.cli import main
from drivax.curation.methods import METHODS, check_current
from drivax.curation.scores import ScoreTable
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.loop import make_agent, train
from drivax.learning.policies import PretrainedRun, export_policy, find_traffic, load_policy, policy_traffic
from drivax.planners.catalogue import make_planner
from drivax.plugins import find_named, makes, result_class
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import Traffic
from drivax.studies.definition import StudyConfig
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.run_folder import RunFolder, policy_folder, zoo
from hostile_names import CARRIED, hostile_names
from hostile_names import modules as all_modules
from toy_learner import ToyConfig

#: Places of a configuration that may hold a name: mappings around it.
PLACES = {
    "feature": lambda name: {"task": {"observation": {"own": [{"feature": name}]}}},
    "feature_kind": lambda name: {"task": {"observation": {"own": [{"feature": {"kind": name}}]}}},
    "reward": lambda name: {"task": {"rewards": {"own": [{"term": name, "weight": 1.0}]}}},
    "reward_kind": lambda name: {
        "task": {"rewards": {"own": [{"term": {"kind": name, "a": 1}, "weight": 1}]}}
    },
    "metric": lambda name: {"task": {"metrics": ["training", name]}},
    "metrics": lambda name: {"task": {"metrics": name}},
    "record": lambda name: {"task": {"rewards": name}},
    "section": lambda name: {"task": name},
    "actions": lambda name: {"task": {"actions": {"kind": name}}},
    "encoder": lambda name: {"algorithm": {"kind": "ppo", "network": {"encoder": {"kind": name}}}},
    "encoder_name": lambda name: {"algorithm": {"kind": "ppo", "network": {"encoder": name}}},
    "algorithm": lambda name: {"algorithm": {"kind": name, "environments": 4}},
    "algorithm_name": lambda name: {"algorithm": name},
    "start": lambda name: {"start": {"kind": name}},
    "traffic": lambda name: {"traffic": name},
    "mixture": lambda name: {"traffic": {"log": 0.5, name: 0.5}},
    "share_of_0": lambda name: {"traffic": {"log": 1.0, name: 0.0}},
    "begin_from": lambda name: {"begin_from": name},
    "extends": lambda name: {"extends": name},
}
ATTACKS = {
    "feature": PLACES["feature"]("good_policy.extra:thing"),
    "traffic": PLACES["traffic"]("os:abort"),
    "inside": PLACES["traffic"]("drivax.cli:main"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with modules that leave a file when they are imported."""
    for name in CARRIED:
        file = tmp_path.joinpath(*name.split(".")).with_suffix(".py")
        if (package := tmp_path / name).is_dir():
            file = package / "__init__.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(
            f"open({str(tmp_path / f'imported-{name}')!r}, 'w').close()\n"
            "def thing(a, b, c):\n    return 0.0\n"
        )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


@pytest.fixture
def untouched(folder):
    """Check that nothing was imported and that the current folder is not searched."""
    path, modules = [*sys.path], {name for name in sys.modules if not name.startswith("drivax.")}
    yield
    assert not list(folder.glob("imported-*"))
    assert sys.path == path
    imported = {name for name in sys.modules if not name.startswith("drivax.")} - modules
    dangerous = {
        "good_policy",
        "carried",
        "drivaxx",
        "drivax_extra",
        "runpy",
        "antigravity",
        "this",
        "webbrowser",
    }
    assert not imported & dangerous


def text(values):
    return json.dumps(values)  # JSON is YAML


def write_stranger(path, values, kind="policy"):
    """A folder as a stranger hands it out: the zoo's policy with other settings."""
    path.mkdir()
    shutil.copy(policy_folder("zoo:ppo") / "policy.npz", path)
    (path / "run.json").write_text(json.dumps({"kind": kind, "data": []}))
    (path / "config.yaml").write_text(text(values))
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("trust") / "set"
    generate(path, 1, 3, Generation(workers=0))
    return ScenarioSet.open(path)


def small_config(**values):
    return settings.load(
        TrainConfig, {"algorithm": {"kind": "toy_learner:ToyConfig"}, "total_steps": 10} | values
    )


#: Ways to read the configuration of a run or policy: functions of the folder, a set and an empty place.
READERS = {
    "config": lambda run, data, out: RunFolder.open(run).config(TrainConfig),
    "load_policy": lambda run, data, out: load_policy(run, drivax.load(data.path).bank),
    "export_policy": lambda run, data, out: export_policy(run, out, drivax.load(data.path).bank),
    "policy_traffic": lambda run, data, out: policy_traffic(run),
    "find_traffic": lambda run, data, out: find_traffic(f"{run}+idm"),
    "find_planner": lambda run, data, out: find_planner(str(run), drivax.load(data.path).bank),
    "make_simulator": lambda run, data, out: drivax.make_simulator(traffic=str(run)),
    "evaluate": lambda run, data, out: drivax.evaluate(run, data.path),
    "evaluate_traffic": lambda run, data, out: drivax.evaluate("idm", data.path, traffic=str(run)),
    "make_agent": lambda run, data, out: make_agent(small_config(traffic=str(run)), drivax.load(data.path).bank),
    "train_traffic": lambda run, data, out: train(small_config(traffic=str(run)), data, out, validation=None),
    "resume": lambda run, data, out: train(small_config(), data, run, validation=None, resume=True),
    "gym": lambda run, data, out: DrivingEnv(1, traffic=str(run)),
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("attack", ATTACKS)
def test_code_in_a_run_is_refused_by_every_reader(attack, reader, folder, untouched, data, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["drivax", "never-a-command"])
    run = write_stranger(folder / "run", ATTACKS[attack], "training" if reader == "resume" else "policy")
    if reader == "resume":
        about = [{"hash": data.hash, "path": "set", "scenarios": 1}]
        (run / "run.json").write_text(json.dumps({"kind": "training", "data": about}))
    ignored = attack != "feature" and reader not in ("config", "resume")  # a policy needs no training traffic
    if ignored:
        values = ATTACKS[attack] | {"task": {"metrics": [ATTACKS[attack]["traffic"]]}}
        (run / "config.yaml").write_text(text(values))
    with pytest.raises(DrivaxError) as error:
        READERS[reader](run, data, folder / "out")
    message = str(error.value)
    assert "run/config.yaml: " in message and "\n" not in message, message
    assert ("--trust-code" in message) == (attack != "inside"), message
    assert not (folder / "out").exists()


@pytest.mark.parametrize("attack", ["feature", "traffic"])
@pytest.mark.parametrize(
    "command",
    [
        ["evaluate", "--planner", "RUN", "--data", "SET", "--out", "out"],
        ["evaluate", "--planner", "idm", "--traffic", "RUN", "--data", "SET", "--out", "out"],
        ["inspect", "SET", "--observations", "--planner", "RUN"],
        ["inspect", "SET", "--observations", "--traffic", "RUN"],
        ["bench", "--data", "SET", "--batch", "1", "--traffic", "RUN"],
        ["train", "demo", "--data", "SET", "--out", "out", "--traffic", "RUN", "--validation", "none"],
    ],
)
def test_code_in_a_run_is_refused_by_commands(attack, command, folder, untouched, data, capsys):
    values = ATTACKS[attack] | {"task": {"metrics": ["os:abort"]}} if attack == "traffic" else ATTACKS[attack]
    run = write_stranger(folder / "run", values)
    places = {"RUN": str(run), "SET": str(data.path)}
    assert main([places.get(word, word) for word in command]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("drivax: ")]
    assert len(lines) == 1 and "config.yaml: names code, " in lines[0] and "--trust-code" in lines[0]
    assert not (folder / "out").exists()


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 10])
def test_hostile_names_are_never_imported(folder, untouched, every):
    """Every name (every tenth in `make test`) in every place, read as a run reads it."""
    names = hostile_names()
    assert len(names) >= 300 and len(PLACES) >= 18
    for name in names[::every]:
        for place, values in PLACES.items():
            file = folder / "config.yaml"
            with pytest.raises(UsageError) as error:
                settings.load(TrainConfig, values(name), trust=())
            message, is_own = str(error.value), name.split(":")[0].split(".")[0] == "drivax"
            assert name in message and "\n" not in message and len(message) < 1000, (name, place, message)
            assert error.value.cure and (is_own or "--trust-code" in error.value.cure), (name, place, message)
        file.write_text(text(values(name)))
        with pytest.raises(UsageError, match=r"config\.yaml: "):
            settings.load(TrainConfig, file, trust=())


def test_reads_that_need_no_names_resolve_none(folder, untouched):
    """Tables, comparisons, reports and weights of another run read no configuration as code."""
    run = write_stranger(
        folder / "run", {"planner": "good_policy.extra:thing", "traffic": "os:abort"}, "evaluation"
    )
    assert RunFolder.open(run).settings["planner"] == "good_policy.extra:thing"
    with pytest.raises(DrivaxError):
        PretrainedRun.of(str(run))
    with pytest.raises(UsageError, match=r"config.yaml: names code, carried:thing; .*--trust-code carried"):
        RunFolder.open(write_stranger(folder / "study", {"training": ["--traffic", "carried:thing"]})).config(
            StudyConfig
        )


def test_score_tables_name_no_code(folder, untouched):
    for method in ("ensemble", "kinematic", "action_rarity"):
        config = settings.plain(METHODS[method].config)
        for key in config:
            hostile = config | {key: "good_policy.extra:thing"}
            empty = np.zeros((1, 2))
            table = ScoreTable(method, hostile, "f00d", ("a",), empty > 0, empty, empty[:, 0], {})
            with pytest.raises(DataError, match=r"scores.npz: names code.*score again"):
                check_current(table, file=folder / "scores.npz")


OWN = {
    "task": {
        "observation": {"own": [{"feature": "own_terms:goal"}]},
        "rewards": {"own": [{"term": {"kind": "own_terms:Crowded", "within_m": 7}, "weight": -0.1}]},
        "metrics": ["training", "own_terms:nearest_other"],
    },
    "algorithm": {"kind": "toy_learner:ToyConfig"},
    "traffic": "own_terms:Drift",
}


def test_trusted_modules_are_resolved(folder):
    run = RunFolder.open(write_stranger(folder / "run", OWN))
    with pytest.raises(
        UsageError, match=r"--trust-code own_terms --trust-code toy_learner \(in Python trust="
    ):
        run.config(TrainConfig)
    with pytest.raises(UsageError, match=r"names code, toy_learner:ToyConfig; .*--trust-code toy_learner "):
        run.config(TrainConfig, trust=["own_terms"])
    config = run.config(TrainConfig, trust=["own_terms", "toy_learner"])
    assert config == settings.load(TrainConfig, OWN) and config.algorithm == ToyConfig()
    assert config.task.rewards.own[0].term == own_terms.Crowded(7.0)
    modules = settings.modules_of(config), settings.modules_of(TrainConfig())
    assert modules == (["own_terms", "toy_learner"], [])
    # A package covers its modules, but not those whose names only begin alike.
    settings.check_names(["good_policy.extra:thing"], ["good_policy"])
    with pytest.raises(UsageError, match="names code"):
        settings.check_names(["good_policy_2:thing"], ["good_policy"])
    # What a trusted module has imported from others is not its own.
    for name in ("own_terms:jax.jit", "own_terms:Any", "own_terms:dataclass"):
        with pytest.raises(UsageError, match="is not a component of 'own_terms'"):
            settings.check_names({"a": [name]}, ["own_terms"])


@pytest.mark.parametrize("environment", [DrivingEnv, VectorDrivingEnv])
def test_environments_take_trust(environment, folder):
    run = write_stranger(folder / "run", PLACES["metric"]("own_terms:nearest_other"))
    with pytest.raises(UsageError, match="trust="):
        environment(data=1, traffic=str(run))
    # Trusted, the configuration is read, and the parameters of the policy with other groups are not.
    with pytest.raises(DataError, match=r"policy\.npz"):
        environment(data=1, traffic=str(run), trust=["own_terms"])


@pytest.mark.slow
def test_trusted_policy_is_evaluated_and_resumed(folder, data, capsys):
    run = train(
        small_config(**{k: OWN[k] for k in ("task", "traffic")}), data, folder / "run", validation=None
    ).path
    flags = ["--trust-code", "own_terms", "--trust-code", "toy_learner"]
    command = ["evaluate", "--planner", str(run), "--data", str(data.path), "--out", "evaluated"]
    assert main(command) == 2 and "--trust-code own_terms --trust-code toy_learner" in capsys.readouterr().err
    assert main([*command, *flags]) == 0
    trust = ["own_terms", "toy_learner"]
    traffic = policy_traffic(run, trust=trust)
    assert traffic.trust == tuple(trust) and traffic == find_traffic(str(run), trust)
    assert traffic.prepare(drivax.load(data.path).bank) is not None
    resume = {"validation": None, "resume": True}
    with pytest.raises(UsageError, match="names code"):
        train(TrainConfig(), data, run, **resume)
    train(TrainConfig(), data, run, trust=trust, **resume)
    # The user's own configuration names both modules.
    train(small_config(task=OWN["task"]), data, run, **resume)


@pytest.mark.parametrize(
    "command",
    ["doctor", "generate set --scenarios 5 --workers 2", "inspect set", "generate set --scenarios 1"],
)
def test_commands_import_nothing_from_the_current_folder(command, tmp_path):
    """Modules there have the names of those that commands and their child processes import first."""
    if command.startswith("inspect"):
        generate(tmp_path / "set", 1, 0, Generation(workers=0))
    for name in (
        "jax",
        "json",
        "multiprocessing",
        "numpy",
        "drivax",
        "signal",
        "os",
        "encodings",
        "sitecustomize",
    ):
        code = f"import os; os.mkdir({str(tmp_path / f'ran-{name}')!r}); raise ImportError('a module of the folder')"
        (tmp_path / f"{name}.py").write_text(code)
    program = Path(sys.executable).with_name("drivax")
    result = subprocess.run(
        [program, *command.split()], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert not [*tmp_path.glob("ran-*")]
    assert result.returncode == 0, result.stderr


def test_policies_of_the_zoo_need_no_trust():
    for name in zoo():
        assert RunFolder.open(policy_folder(name)).config(TrainConfig).task is not None


def test_flags_and_own_files_stay_the_users(folder):
    """Settings on the command line are the user's, also with a run's configuration; the current folder is searched."""
    run = RunFolder.open(write_stranger(folder / "run", PLACES["traffic"]("os:abort")))
    assert run.config(TrainConfig, ["--traffic", "own_terms:Drift"]).traffic == "own_terms:Drift"
    (folder / "mine.yaml").write_text(text(PLACES["feature"]("carried:thing")))
    config = settings.load(TrainConfig, folder / "mine.yaml")
    assert config.task.observation.own[0].feature(1, 2, 3) == 0.0 and (folder / "imported-carried").is_file()
    # That the user's file names it does not make it trusted in data.
    with pytest.raises(UsageError, match="names code"):
        settings.load(TrainConfig, PLACES["metric"]("carried:thing"), trust=())


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("encoder", "drivax.synthetic.roads.families:TJunction"),
        ("encoder_name", "drivax.synthetic.roads.families:TJunction"),
        ("algorithm", "drivax.learning.algorithms.warm_start:WarmStart"),
        ("feature", "drivax.tasks.observations:_masked_group"),
        ("feature", "drivax.tasks.features:ego_on_route"),
        ("feature", "drivax.tasks.rewards:collision"),
        ("reward", "drivax.tasks.conditions:draw_conditions"),
        ("reward", "drivax.tasks.rewards:reward_term"),
        ("record", "drivax.tasks.rewards:_Weights"),
    ],
)
def test_other_parts_of_drivax_are_refused(place, name, folder):
    """A name within drivax must lead to a component of the kind that its place takes."""
    with pytest.raises(UsageError) as error:
        settings.load(TrainConfig, PLACES[place](name), trust=())
    assert name in str(error.value) and error.value.cure and "\n" not in str(error.value)


def test_policies_of_useless_settings_are_one_line(folder, data):
    run = write_stranger(
        folder / "run", {"algorithm": {"kind": "ppo", "network": {"encoder": {"hidden": [-1]}}}}
    )
    with pytest.raises(UsageError, match=r"config\.yaml: .* hidden has a layer of width -1"):
        load_policy(run, drivax.load(data.path).bank)


def test_components_of_drivax_may_be_named():
    values = {
        "task": {
            "observation": {"own": [{"feature": "drivax.tasks.example_features:time_gap"}]},
            "rewards": {"own": [{"term": "drivax.tasks.rewards:pace", "weight": 1.0, "name": "again"}]},
        },
        "algorithm": {"network": {"encoder": {"kind": "drivax.networks.encoders:MlpConfig", "hidden": [8]}}},
    }
    assert settings.load(TrainConfig, values | {"algorithm": {"kind": "ppo"} | values["algorithm"]}, trust=())


TRAPS = """
from dataclasses import dataclass
import jax.numpy as jnp
calls = []
def zero() -> int:
    calls.append("zero")
def one(a):
    calls.append("one")
class Trap:
    def __init__(self, *args):
        calls.append("Trap")
@dataclass(frozen=True)
class Record:
    size: int = 0
    def __post_init__(self):
        calls.append("Record")
"""


@pytest.mark.parametrize("thing", ["zero", "one", "Trap", "Record", "calls", "jnp", "calls.append"])
@pytest.mark.parametrize("place", sorted(set(PLACES) - {"begin_from", "extends", "share_of_0"}))
def test_wrong_kinds_are_refused_before_a_call(place, thing, folder):
    (folder / "traps.py").write_text(TRAPS)
    sys.modules.pop("traps", None)
    with pytest.raises(UsageError) as error:
        settings.load(TrainConfig, PLACES[place](f"traps:{thing}"))
    assert f"traps:{thing}" in str(error.value) and error.value.cure and "\n" not in str(error.value)
    # Places without code of the user's do not even import it.
    traps = sys.modules.get("traps")
    assert traps.calls == [] if place not in ("actions", "start") else traps is None


def test_wrong_kinds_of_planners_and_traffic_are_not_called(folder):
    (folder / "traps.py").write_text(TRAPS)
    sys.modules.pop("traps", None)
    for name in ("traps:zero", "traps:one", "traps:Trap", "traps:Record", "os:abort", "drivax.cli:main"):
        with pytest.raises(UsageError, match=r"makes no planner|takes"):
            make_planner(name)
        with pytest.raises(UsageError, match="makes no traffic"):
            make_traffic(name)
    assert sys.modules["traps"].calls == [] and os.getpid()


def test_only_traffic_of_drivax_is_made_by_name():
    """Of everything in drivax that a name in data reaches, only traffic models would be called as traffic."""
    modules, made = all_modules(), set()
    assert len(modules) > 200
    for module in modules:
        for attribute in list(vars(module)):
            try:
                thing = find_named(f"{module.__name__}:{attribute}", ())
            except UsageError:
                continue
            if makes(thing, Traffic):
                made.add(result_class(thing))
    # Traffic of a policy or of given motions names what it needs when a bank lacks it; none opens a folder.
    assert {cls.__name__ for cls in made} == {"LogTraffic", "IdmTraffic", "PlannerTraffic", "OverrideTraffic"}
    with pytest.raises(UsageError, match="makes no traffic"):
        find_traffic("drivax.learning.policies:PolicyTraffic")
