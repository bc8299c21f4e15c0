"""Dotted names: found, refused in one line, written and read back; and a configuration full of them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import pytest

import own_terms
from drivax import settings
from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.planners.catalogue import make_planner
from drivax.plugins import dotted_name, find_named, is_dotted
from drivax.tasks.observations import ObservationConfig, OwnGroup
from drivax.tasks.rewards import OwnTerm, RewardConfig


@runtime_checkable
class Shape(Protocol):
    @property
    def sides(self) -> int: ...

    def area(self) -> float: ...


@dataclass(frozen=True)
class Square:
    size: float = 1.0

    @property
    def sides(self) -> int:
        return 4

    def area(self) -> float:
        return self.size**2


@dataclass(frozen=True)
class Circle:
    kind: str = "circle"
    radius: float = 1.0
    sides: int = 0

    def area(self) -> float:
        return 3.14 * self.radius**2


@dataclass(frozen=True)
class Holder:
    shape: Square | Shape = field(default_factory=Square)
    any_shape: Shape | None = None
    measure: Callable[[int, int], float] | None = None
    squares: tuple[Square, ...] = ()


def ratio(one: int, other: int) -> float:
    return one / other


def alone(one: int) -> float:
    return one


@dataclass(frozen=True)
class Power:
    exponent: int = 2

    def __call__(self, one: int, other: int) -> float:
        return one**self.exponent - other


BIG = Square(9.0)
HERE = __name__


def load(**values):
    return settings.load(Holder, values)


def test_dotted_names_have_a_module_and_a_name():
    for name in ("a:b", "a.b:c", "a.b:C.d", "_a1:b2"):
        assert is_dotted(name)
    for name in ("a", "a.b", "a:", ":b", "a:b:c", "a b:c", "1a:b", "a/b:c", "", None, 3, "/tmp/a:b", "log"):
        assert not is_dotted(name)


def test_named_objects_round_trip():
    assert find_named("math:pi") == pytest.approx(3.14159, abs=1e-5)
    assert find_named(f"{HERE}:Square.area") is Square.area
    with pytest.raises(UsageError, match=f"'{HERE}:Square' has no 'aera'; did you mean 'area'"):
        find_named(f"{HERE}:Square.aera")
    with pytest.raises(UsageError, match="'math:pi' has no 'x'; define x there"):
        find_named("math:pi.x")
    for thing in (ratio, Square, Square.area, len):
        assert find_named(dotted_name(thing)) is thing
    for thing in (lambda x: x, load.__get__(1)):
        with pytest.raises(
            UsageError, match="cannot be saved in a configuration; define it by def or class, at the top"
        ):
            dotted_name(thing)


def test_dotted_values_become_objects():
    held = load(
        shape={"kind": f"{HERE}:Circle", "radius": 2},
        any_shape=f"{HERE}:BIG",
        measure={"kind": f"{HERE}:Power", "exponent": 3},
        squares=[f"{HERE}:BIG", {"size": 3}],
    )
    assert held == Holder(Circle(radius=2.0), BIG, Power(3), (BIG, Square(3.0)))
    assert load(shape=f"{HERE}:Circle", measure=f"{HERE}:ratio") == Holder(Circle(), measure=ratio)
    # What stands beside the open place works as before.
    assert load(shape={"size": 2}) == load(shape={"kind": "square", "size": 2}) == Holder(Square(2.0))
    flags = ["--shape.kind", f"{HERE}:Circle", "--shape.radius", "5"]
    assert settings.load(Holder, {}, flags).shape == Circle(radius=5.0)


@pytest.mark.parametrize(
    "held",
    [
        Holder(Circle(radius=2.0), BIG, Power(3), (BIG, Square(3.0))),
        Holder(measure=ratio),
        Holder(any_shape=Circle()),
    ],
)
def test_records_with_dotted_values_round_trip(held):
    text = settings.dump(held)
    assert settings.load(Holder, settings.parse_yaml(text)) == held
    assert settings.dump(settings.load(Holder, settings.parse_yaml(text))) == text


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"measure": f"{HERE}:rato"},
            f"measure: '{HERE}:rato': '{HERE}' has no 'rato'; did you mean 'ratio'?",
        ),
        ({"measure": f"{HERE}:zzz"}, f"measure: '{HERE}:zzz': '{HERE}' has no 'zzz'; define zzz there"),
        (
            {"measure": "no_such_package.terms:f"},
            "measure: 'no_such_package.terms:f': module 'no_such_package' not found; install it, add its folder to "
            "PYTHONPATH, or run from its folder",
        ),
        ({"measure": "ratio"}, "measure: 'ratio' is not a dotted name; write package.module:name"),
        ({"measure": f"{HERE}:BIG"}, f"measure: '{HERE}:BIG' is not callable; name a function"),
        (
            {"measure": f"{HERE}:alone"},
            f"measure: '{HERE}:alone' takes (one: 'int') -> 'float'; it is called with (int, int)",
        ),
        ({"any_shape": f"{HERE}:Power"}, f"any_shape: '{HERE}:Power' lacks 'sides'; see {HERE}.Shape"),
        (
            {"shape": {"kind": f"{HERE}:Circle", "radios": 1}},
            "shape.radios: unknown setting; did you mean",
        ),
        (
            {"shape": {"kind": f"{HERE}:ratio", "radius": 1}},
            f"shape: '{HERE}:ratio' takes no settings; make it a frozen",
        ),
        ({"shape": {"kind": "sqare"}}, "shape: unknown kind 'sqare'; did you mean 'square'?"),
        ({"squares": [f"{HERE}:ratio"]}, f"squares[0]: '{HERE}:ratio' is not a Square"),
    ],
)
def test_errors_name_key_name_and_cure(values, words):
    with pytest.raises(UsageError) as error:
        load(**values)
    told = str(error.value)
    assert words in told and "\n" not in told, told


def test_modules_in_the_current_folder_are_found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "terms_at_hand.py").write_text("def f(a, b):\n    return a - b\n")
    assert load(measure="terms_at_hand:f").measure(3, 1) == 2
    (tmp_path / "terms_broken.py").write_text("import no_such_thing\n")
    with pytest.raises(UsageError) as error:
        load(measure="terms_broken:f")
    assert "'terms_broken:f': importing 'terms_broken' fails with ModuleNotFoundError: No module" in str(
        error.value
    )


def test_current_folder_is_searched_only_for_named_modules(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "absent_extra.py").write_text("raise SystemExit")
    (tmp_path / "local_size.py").write_text("SIZE = 3\n")
    package = tmp_path / "local_terms"
    package.mkdir()
    (package / "first.py").write_text("class Extra: pass\n")
    (package / "second.py").write_text("from local_size import SIZE\n")
    path = [*sys.path]
    assert find_named("local_terms.first:Extra").__name__ == "Extra"
    # Other modules of a local package may import the modules next to it.
    assert find_named("local_terms.second:SIZE") == 3
    with pytest.raises(UsageError, match="'local_missing' not found"):
        find_named("local_missing:f")
    assert sys.path == path
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("absent_extra")


def test_training_runs_with_custom_terms(tmp_path):
    text = """
task:
  observation: {agents: 2, own: [{feature: "own_terms:goal"}, {feature: "own_terms:walkers", name: people}]}
  rewards:
    preset: safety
    own:
      - {term: "own_terms:hurry", weight: -0.5}
      - {term: {kind: "own_terms:Crowded", within_m: 7}, weight: -0.1}
  metrics: [training, "own_terms:nearest_other"]
algorithm: {kind: ppo, network: {encoder: {kind: "own_terms:MeanConfig", width: 4}}}
"""
    (tmp_path / "own.yaml").write_text(text)
    config = settings.load(TrainConfig, tmp_path / "own.yaml")
    assert config.task.rewards.own == (
        OwnTerm(own_terms.hurry, -0.5), OwnTerm(own_terms.Crowded(7.0), -0.1, "crowded")
    )  # fmt: skip
    assert [group.name for group in config.task.observation.own] == ["goal", "people"]
    assert config.algorithm.network.encoder == own_terms.MeanConfig(4)
    assert hash(config.task) == hash(settings.load(TrainConfig, tmp_path / "own.yaml").task)
    dumped = settings.dump(config)
    assert settings.load(TrainConfig, settings.parse_yaml(dumped)) == config
    other = settings.load(TrainConfig, {"algorithm": {"kind": "own_terms:ReinforceConfig", "unroll": 7}})
    assert other.algorithm == own_terms.ReinforceConfig(unroll=7) and other.iterations == -(-2_000_000 // 21)
    assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(other))) == other


def test_custom_terms_and_groups_are_named():
    with pytest.raises(ValueError, match=r"rewards\.own: name 'collision' is taken"):
        RewardConfig(own=(OwnTerm(own_terms.hurry, 1.0, "collision"),))
    with pytest.raises(ValueError, match=r"rewards\.own: name 'hurry' is taken"):
        RewardConfig(own=(OwnTerm(own_terms.hurry, 1.0), OwnTerm(own_terms.hurry, 2.0)))
    with pytest.raises(ValueError, match=r"observation\.own: name 'agents' is taken"):
        ObservationConfig(own=(OwnGroup(own_terms.goal, "agents"),))
    with pytest.raises(ValueError, match="cannot be named 'a_mask'"):
        OwnGroup(own_terms.goal, "a_mask")
    with pytest.raises(ValueError, match="'<lambda>' is not a name; pass one"):
        OwnTerm(lambda before, now, around: now.speed_mps, 1.0)
    assert OwnTerm(own_terms.Crowded(), 1.0).name == "crowded"


def test_custom_planners_are_found():
    assert make_planner("own_terms:FullBrake") == own_terms.FullBrake()
    with pytest.raises(UsageError, match="'own_terms:MeanConfig' makes no planner; see"):
        make_planner("own_terms:MeanConfig")
