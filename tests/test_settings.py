"""Settings: what is written is read back exactly, and every mistake is named with its path."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax import settings
from drivax.errors import UsageError


@dataclass(frozen=True)
class Adam:
    lr: float = 3e-4
    clip: float | None = None
    betas: tuple[float, float] = (0.9, 0.999)


@dataclass(frozen=True)
class Sgd:
    lr: float = 0.1
    momentum: float = 0.0


@dataclass(frozen=True)
class TD3BC:
    kind: Literal["td3_bc"] = "td3_bc"
    alpha: float = 2.5


@dataclass(frozen=True)
class Network:
    hidden: tuple[int, ...] = (256, 256)
    activation: Literal["relu", "gelu", "tanh"] = "relu"
    optimizer: Adam = field(default_factory=lambda: Adam(lr=1e-3))


@dataclass(frozen=True)
class Training:
    steps: int = 1000
    name: str = "run"
    resume: bool = False
    data: Path = Path("sets/a")
    seed: int | None = 7
    optimizer: Adam | Sgd = field(default_factory=Adam)
    stages: tuple[Adam | Sgd, ...] = ()
    algorithm: TD3BC | Sgd | None = None
    network: Network = field(default_factory=Network)
    weights: dict[str, float] = field(default_factory=dict)
    limit: int | str = 3
    level: Literal["1", 2] = "1"


@dataclass(frozen=True)
class Needy:
    steps: int

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise UsageError("steps are negative", cure="use 0 or more")


@dataclass(frozen=True)
class Sized:
    width: int = 8
    depth: int = 2
    adam: Adam = field(default_factory=Adam)

    @classmethod
    def preset(cls, name: str) -> Sized:
        if name != "large":
            raise UsageError(f"unknown size {name!r}", cure="use large")
        return cls(width=99, depth=9, adam=Adam(lr=0.5, clip=1.0))


@dataclass(frozen=True)
class House:
    rooms: Sized = field(default_factory=lambda: Sized(width=5))


def load(text: str, *overrides: str) -> Training:
    return settings.load(Training, settings.parse_yaml(text) or {}, overrides)


def test_defaults_and_values():
    assert load("") == Training()
    assert load("steps: 5\nseed: null\ndata: b/c\nnetwork: {hidden: [3]}") == Training(
        steps=5, seed=None, data=Path("b/c"), network=Network(hidden=(3,))
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4), ("1E5", 1e5), ("+2.", 2.0), (".5e+2", 50.0), ("-7", -7), ("010", 10), ("1_000", 1000), ("0", 0),
        (".inf", math.inf), ("-.inf", -math.inf), ("true", True), ("False", False), ("null", None), ("~", None),
        ("", None), ("no", "no"), ("yes", "yes"), ("on", "on"), ("1:30", "1:30"), ("2026-01-01", "2026-01-01"),
        ("1e", "1e"), ("e4", "e4"), ("'3'", "3"), ("0x10", "0x10"), ("None", None), (".", "."), ("-", ["x"]),
    ],
)  # fmt: skip
def test_scalars_by_the_core_rules(text: str, value: object):
    if text == "-":
        text = "- x"
    result = settings.parse_yaml(text)
    assert result == value
    assert type(result) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stpes: 5", r"^stpes: unknown setting; did you mean 'steps'\?$"),
        ("network: {optimizer: {lrr: 1}}", r"^network\.optimizer\.lrr: unknown setting; did you mean 'lr'\?"),
        ("qqqq: 1", r"^qqqq: unknown setting; use one of steps, name, "),
        ("steps: 1.5", r"^steps: 1\.5 is not an integer"),
        ("steps: true", r"^steps: True is not an integer"),
        ("steps: '5'", r"^steps: '5' is not an integer"),
        ("steps: null", r"^steps: None is not an integer"),
        ("name: 5", r"^name: 5 is not text \(quote it\)"),
        ("resume: 1", r"^resume: 1 is not true or false"),
        ("resume: 'yes'", r"^resume: 'yes' is not true or false"),
        ("seed: x", r"^seed: 'x' is not an integer"),
        ("data: [a]", r"^data: \['a'\] is not text"),
        ("network: 3", r"^network: 3 is not a section of settings \(hidden, activation, optimizer\)"),
        ("network: {hidden: 256}", r"^network\.hidden: 256 is not a list"),
        ("network: {hidden: '256'}", r"^network\.hidden: '256' is not a list"),
        ("network: {hidden: [256, x]}", r"^network\.hidden\[1\]: 'x' is not an integer"),
        ("network: {activation: rleu}", r"^network\.activation: 'rleu' is not one of relu, gelu, tanh; did you mean"),
        ("level: 1", r"^level: '1' is not one of 1, 2; write it in quotes"),
        ("network: {optimizer: {betas: [0.9]}}", r"^network\.optimizer\.betas: 1 values, not 2"),
        ("network: {optimizer: {lr: true}}", r"^network\.optimizer\.lr: True is not a number"),
        ("optimizer: {lr: 1, kind: rmsprop}", r"^optimizer: unknown kind 'rmsprop'; use one of adam, sgd"),
        ("optimizer: {kind: adma}", r"^optimizer: unknown kind 'adma'; did you mean 'adam'"),
        ("optimizer: {kind: sgd, clip: 1}", r"^optimizer\.clip: unknown setting"),
        ("stages: [{lr: 1}]", r"^stages\[0\]: has no kind; use one of adam, sgd"),
        ("stages: [adam, {kind: sgd, momentum: x}]", r"^stages\[1\]\.momentum: 'x' is not a number"),
        ("algorithm: 5", r"^algorithm: 5 is not a section with a kind \(td3_bc, sgd\)"),
        ("weights: {a: x}", r"^weights.*'x' is not a number"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_their_path(text: str, message: str):
    with pytest.raises(UsageError, match=message) as error:
        load(text)
    assert error.value.status == 2 and error.value.cure


def test_semicolons_of_the_user_end_no_problem():
    for name, value in {"steps": "3; 4", "level": "a; b", "optimizer.kind": "x; y"}.items():
        with pytest.raises(UsageError) as error:
            settings.load(Training, {}, [f"--{name}", value])
        assert value in error.value.problem and ";" not in str(error.value.cure)


def test_missing_settings_and_failed_checks_are_named():
    with pytest.raises(UsageError, match="'steps' is missing; correct this setting"):
        settings.load(Needy, {})
    with pytest.raises(UsageError, match=r"steps are negative; use 0 or more$") as error:
        settings.load(Needy, {"steps": -1})
    assert error.value.cure == "use 0 or more"


def test_whole_floats_count_as_steps():
    assert load("steps: 25e6").steps == 25_000_000
    assert isinstance(load("steps: 25e6").steps, int)
    assert isinstance(load("network: {optimizer: {lr: 1}}").network.optimizer.lr, float)


def test_unions_are_read_by_kind_or_name():
    assert load("optimizer: {kind: sgd, momentum: 0.5}").optimizer == Sgd(momentum=0.5)
    assert load("optimizer: sgd").optimizer == Sgd()
    assert load("algorithm: {kind: td3_bc, alpha: 1}").algorithm == TD3BC(alpha=1.0)
    assert load("algorithm: null").algorithm is None
    assert load("stages: [adam, {kind: sgd, lr: 1}]").stages == (Adam(), Sgd(lr=1.0))
    assert load("limit: all").limit == "all"
    assert load("limit: 4").limit == 4


def test_kind_is_the_class_name_in_snake_case():
    class BcSac:
        pass

    bc_sac = dataclass(frozen=True)(BcSac)
    assert settings.kind_of(bc_sac) == "bc_sac"
    assert settings.kind_of(Adam) == "adam"
    assert settings.kind_of(TD3BC) == "td3_bc"


def test_missing_keys_keep_the_enclosing_defaults():
    """Network's optimizer has lr 1e-3 where a bare Adam has 3e-4; naming clip alone must not change lr."""
    assert load("network: {optimizer: {clip: 1}}").network.optimizer == Adam(lr=1e-3, clip=1.0)
    assert load("", "--network.optimizer.clip=1").network.optimizer == Adam(lr=1e-3, clip=1.0)
    assert load("optimizer: {clip: 2}").optimizer == Adam(clip=2.0)  # the kind is that of the default


def test_flags_override_the_file_by_type():
    changed = load(
        "steps: 5\noptimizer: {kind: sgd, lr: 1}",
        "--steps", "1e3", "--resume", "--name=12", "--network.hidden", "[3, 4]", "--seed", "null",
        "--optimizer.lr", "1e-3", "--data", "x/y", "--weights.left", "-2", "--network.activation", "tanh",
        "--stages", "[{kind: sgd}, adam]",
    )  # fmt: skip
    assert changed == Training(
        steps=1000, resume=True, name="12", seed=None, data=Path("x/y"), optimizer=Sgd(lr=1e-3),
        network=Network(hidden=(3, 4), activation="tanh"), weights={"left": -2.0}, stages=(Sgd(), Adam()),
    )  # fmt: skip
    assert load("resume: true", "--resume", "false").resume is False
    assert load("limit: 4", "--limit", "all").limit == "all"
    assert load("", "--limit", "5").limit == 5


def test_kind_by_name_alone_keeps_its_kind(tmp_path: Path):
    """``optimizer: sgd`` in a file, an extended file or a flag, then a setting of it."""
    assert load("optimizer: sgd", "--optimizer.lr=1").optimizer == Sgd(lr=1.0)
    assert load("", "--optimizer", "sgd", "--optimizer.lr", "1").optimizer == Sgd(lr=1.0)
    section = "{kind: sgd, momentum: 0.5}"
    assert load("", "--optimizer", section, "--optimizer.lr", "1").optimizer == Sgd(lr=1.0, momentum=0.5)
    assert load("optimizer: sgd", "--optimizer.kind", "adam", "--optimizer.clip", "1").optimizer == Adam(
        clip=1.0
    )
    (tmp_path / "base.yaml").write_text("optimizer: sgd")
    (tmp_path / "own.yaml").write_text("extends: base.yaml\noptimizer: {lr: 1}")
    assert settings.load(Training, tmp_path / "own.yaml").optimizer == Sgd(lr=1.0)
    assert load("weights: x", "--weights.left", "1").weights == {"left": 1.0}, "a mapping has no kind"


def test_another_kind_drops_previous_settings():
    text = "optimizer: {kind: adam, clip: 1}"
    assert load(text, "--optimizer.kind", "sgd", "--optimizer.momentum", "0.5").optimizer == Sgd(momentum=0.5)
    assert load(text, "--optimizer.kind", "adam").optimizer == Adam(clip=1.0)
    assert load(text, "--optimizer", "sgd").optimizer == Sgd()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("steps", "unexpected argument 'steps'; write --section.key value"),
        ("--stesp=1", r"stesp: .* did you mean 'steps'\?"),
        ("--steps=x", "steps: 'x' is not an integer"),
        ("--network.optimizer.lr=fast", r"network\.optimizer\.lr: 'fast' is not a number"),
        ("--steps.deep=1", "steps: .* is not an integer"),
        ("--network.hidden=[1", r"^network\.hidden: '\[1' is not a value"),
    ],
)
def test_mistaken_flags_are_refused(override: str, message: str):
    with pytest.raises(UsageError, match=message):
        load("", override)


def test_overrides_do_not_change_the_mapping():
    values = {"network": {"hidden": [1]}}
    settings.load(Training, values, ["--network.hidden=[2]"])
    assert values == {"network": {"hidden": [1]}}


def test_faulty_files_are_refused_with_file_and_line(tmp_path: Path):
    file = tmp_path / "train.yaml"
    file.write_text("stpes: 5\n")
    with pytest.raises(UsageError, match=r"train\.yaml: stpes: unknown setting"):
        settings.load(Training, file)
    file.write_text("a: [1,\nb: }\n")
    with pytest.raises(UsageError, match=r"train\.yaml: line 2: .*; fix the file"):
        settings.load(Training, file)
    file.write_text("steps: 1\nsteps: 2\n")
    with pytest.raises(UsageError, match=r"line 2: the key 'steps' appears twice"):
        settings.load(Training, file)
    file.write_text("- 1\n")
    with pytest.raises(UsageError, match="not a mapping of settings"):
        settings.load(Training, file)
    file.write_bytes(b"\xff\xfe\x00a")
    with pytest.raises(UsageError, match="is not text"):
        settings.load(Training, file)
    with pytest.raises(UsageError, match=r"none\.yaml: file not found"):
        settings.load(Training, str(tmp_path / "none.yaml"))
    with pytest.raises(UsageError, match="not a configuration file but a folder"):
        settings.load(Training, tmp_path)
    file.write_text("")
    assert settings.load(Training, str(file)) == Training()


def test_yaml_cannot_make_objects(tmp_path: Path):
    with pytest.raises(UsageError, match="could not determine a constructor"):
        settings.parse_yaml("!!python/object/apply:os.system ['true']")


def test_presets_are_found_by_name_in_subfolders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("drivax.settings.loading._configs", lambda: tmp_path)
    (tmp_path / "studies").mkdir()
    (tmp_path / "fast.yaml").write_text("steps: 3\n")
    (tmp_path / "studies" / "slow.yaml").write_text("steps: 4\n")
    assert settings.presets() == ["fast", "studies/slow"]
    assert settings.load(Training, "fast").steps == 3
    assert settings.load(Training, "studies/slow").steps == 4
    with pytest.raises(UsageError, match=r"no preset or file 'fsat'; did you mean 'fast'\?"):
        settings.load(Training, "fsat")


BASE = """
steps: 3
optimizer: {kind: sgd, lr: 1, momentum: 0.5}
network: {hidden: [1, 2], optimizer: {lr: 4, clip: 5}}
stages: [adam, sgd]
weights: {a: 1, b: 2}
"""


@pytest.mark.parametrize(
    ("text", "changes"),
    [
        ("", {}),
        ("steps: 4\nname: x", {"steps": 4, "name": "x"}),
        ("weights: {b: 3, c: 4}", {"weights": {"a": 1.0, "b": 3.0, "c": 4.0}}),
        ("network: {hidden: [3]}", {"network": Network(hidden=(3,), optimizer=Adam(lr=4.0, clip=5.0))}),
        (
            "network: {optimizer: {lr: 6}}",
            {"network": Network(hidden=(1, 2), optimizer=Adam(lr=6.0, clip=5.0))},
        ),
        ("stages: []", {"stages": ()}),
        ("optimizer: {lr: 2}", {"optimizer": Sgd(lr=2.0, momentum=0.5)}),
        ("optimizer: {kind: sgd, lr: 2}", {"optimizer": Sgd(lr=2.0, momentum=0.5)}),
        ("optimizer: {kind: adam, clip: 1}", {"optimizer": Adam(clip=1.0)}),
        ("optimizer: adam", {"optimizer": Adam()}),
        ("network: null", {"network": Network()}),
    ],
)
def test_extended_files_are_merged_by_key(tmp_path: Path, text: str, changes: dict[str, Any]):
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "runs").mkdir()
    own = tmp_path / "runs" / "own.yaml"
    own.write_text(f"extends: ../base.yaml\n{text}")
    base = settings.load(Training, tmp_path / "base.yaml")
    assert base.optimizer == Sgd(lr=1.0, momentum=0.5)
    extended = settings.load(Training, own)
    assert extended == replace(base, **changes)
    assert "extends" not in settings.dump(extended)
    assert settings.load(Training, own, ["--steps", "9"]) == replace(base, **{**changes, "steps": 9})


def test_another_preset_of_a_section_starts_again(tmp_path: Path):
    base, own = tmp_path / "base.yaml", tmp_path / "own.yaml"
    base.write_text("rooms: {width: 4, adam: {lr: 2}}")
    own.write_text("extends: base.yaml\nrooms: {preset: large, depth: 1}")
    assert settings.load(House, own).rooms == Sized(width=99, depth=1, adam=Adam(lr=0.5, clip=1.0))
    base.write_text("rooms: {preset: large, width: 4}")
    own.write_text("extends: base.yaml\nrooms: {preset: large, depth: 1}")
    assert settings.load(House, own).rooms == Sized(width=4, depth=1, adam=Adam(lr=0.5, clip=1.0))


def test_files_extend_presets_and_presets_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("drivax.settings.loading._configs", lambda: tmp_path)
    (tmp_path / "offline").mkdir()
    (tmp_path / "slow.yaml").write_text("steps: 3\nname: slow")
    (tmp_path / "offline" / "slow.yaml").write_text("extends: slow\nname: offline")
    own = tmp_path / "own.yaml"
    own.write_text("extends: offline/slow\nseed: 1")
    assert settings.load(Training, own) == Training(steps=3, name="offline", seed=1)
    own.write_text("extends: solw")
    with pytest.raises(
        UsageError, match=r"own\.yaml: extends 'solw', which is not found; did you mean 'slow'\?$"
    ):
        settings.load(Training, own)
    own.write_text("extends: none.yaml")
    with pytest.raises(
        UsageError, match=r"own\.yaml: extends 'none\.yaml', which is not found; name a file rel"
    ):
        settings.load(Training, own)
    (tmp_path / "slow.yaml").write_text("extends: own.yaml")
    own.write_text("extends: slow")
    with pytest.raises(
        UsageError, match=r"slow\.yaml: extends itself: own\.yaml -> slow\.yaml -> own\.yaml; remove"
    ):
        settings.load(Training, own)
    (tmp_path / "slow.yaml").write_text("steps: 3\nsteps: 4")
    with pytest.raises(UsageError, match=r"slow\.yaml: line 2: the key 'steps' appears twice"):
        settings.load(Training, own)


def test_presets_are_those_of_the_checkout(repository: Path):
    files = (repository / "configs").rglob("*.yaml")
    assert settings.presets() == sorted(
        str(file.relative_to(repository / "configs").with_suffix("")) for file in files
    )


words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12)
numbers = st.floats(allow_nan=False)
adams = st.builds(Adam, lr=numbers, clip=st.none() | numbers, betas=st.tuples(numbers, numbers))
sgds = st.builds(Sgd, lr=numbers, momentum=numbers)
trainings = st.builds(
    Training,
    steps=st.integers(),
    name=words
    | st.sampled_from(["3e-4", "null", "true", "no", "1", "", "-", "~", "a: b", "# c", "1_0", "'"]),
    resume=st.booleans(),
    data=st.sampled_from([Path("a/b"), Path("/"), Path("1"), Path("3e4")]),
    seed=st.none() | st.integers(),
    optimizer=adams | sgds,
    stages=st.lists(adams | sgds, max_size=3).map(tuple),
    algorithm=st.none() | sgds | st.builds(TD3BC, alpha=numbers),
    network=st.builds(Network, hidden=st.lists(st.integers(), max_size=4).map(tuple), optimizer=adams),
    weights=st.dictionaries(words, numbers, max_size=3),
    limit=st.integers() | words,
)


@given(trainings)
def test_round_trip_is_exact(record: Training):
    text = settings.dump(record)
    again = settings.load(Training, settings.parse_yaml(text))
    assert again == record
    assert settings.dump(again) == text


def test_dump_is_readable():
    text = settings.dump(Training(optimizer=Sgd(), network=Network(hidden=(1, 2))))
    assert "hidden: [1, 2]" in text
    assert "optimizer: {kind: sgd, lr: 0.1, momentum: 0.0}" in text
    assert text.index("steps") < text.index("name") < text.index("network")


def test_no_file_shadows_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A folder of a stranger may hold files of any name, and a configuration file is trusted."""
    configs, folder = tmp_path / "configs", tmp_path / "stranger"
    monkeypatch.setattr("drivax.settings.loading._configs", lambda: configs)
    for place, steps in ((configs, 3), (folder, 9)):
        (place / "studies").mkdir(parents=True)
        for name in ("fast.yaml", "studies/slow.yaml"):
            (place / name).write_text(f"steps: {steps}")
    for name in ("fast", "fsat", "studies/slow"):
        (folder / name).write_text("steps: 9")
    monkeypatch.chdir(folder)
    for name in ("fast", "studies/slow"):
        assert settings.load(Training, name).steps == 3
        for path in (f"{name}.yaml", f"./{name}", str(folder / name), Path(name)):
            assert settings.load(Training, path).steps == 9
        for base, steps in ((name, 3), (f"./{name}", 9), (f"{name}.yaml", 9)):
            (folder / "own.yaml").write_text(f"extends: {base}")
            assert settings.load(Training, "own.yaml").steps == steps
    # A misspelt preset reads no file either.
    with pytest.raises(UsageError, match=r"^no preset 'fsat'; write \./fsat for the file$"):
        settings.load(Training, "fsat")
    (folder / "own.yaml").write_text("extends: fsat")
    with pytest.raises(UsageError, match=r"extends 'fsat', which is not found; did you mean 'fast'\?"):
        settings.load(Training, "own.yaml")


def test_folder_may_share_the_name_of_a_preset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    assert settings.load(dict, "demo")["total_steps"] > 0


def test_record_may_start_from_its_own_preset():
    def house(text: str, *overrides: str) -> House:
        return settings.load(House, settings.parse_yaml(text), overrides)

    large = Sized(99, 9, Adam(lr=0.5, clip=1.0))
    assert house("rooms: {depth: 3}").rooms == Sized(width=5, depth=3)
    assert house("rooms: {preset: large}").rooms == large
    changed = house("rooms: {preset: large, depth: 3, adam: {clip: null}}", "--rooms.adam.lr", "0.25")
    assert changed.rooms == Sized(99, 3, Adam(lr=0.25, clip=None))
    assert house("{}", "--rooms.preset", "large", "--rooms.width", "4").rooms == Sized(4, 9, large.adam)
    assert settings.load(Sized, {"preset": "large", "width": 1}) == Sized(1, 9, large.adam)
    assert settings.load(House, settings.parse_yaml(settings.dump(changed))) == changed
    assert "preset" not in settings.dump(changed)
    with pytest.raises(UsageError, match=r"^rooms: unknown size 'huge'; use large$"):
        house("rooms: {preset: huge}")


@dataclass(frozen=True)
class Section:
    context: int = 1
    renamed: ClassVar[dict[str, str]] = {"beside": "context"}


@dataclass(frozen=True)
class Whole:
    section: Section = field(default_factory=lambda: Section(5))


def test_former_keys_are_renamed():
    assert settings.load(Whole, {"section": {"beside": 3}}) == Whole(Section(3))
    assert settings.load(Whole, {"section": {"context": 4}}) == Whole(Section(4))
