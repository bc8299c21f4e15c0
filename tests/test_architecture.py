"""Who may import whom, what must work without JAX, and rules about files."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

#: Rooms that are pure functions on arrays: nothing but these, the standard library and rooms below.
PURE_ROOMS = ("geometry", "scenario", "simulator", "metrics", "tasks", "rl")
PURE_PACKAGES = {"numpy", "jax", "jaxtyping", "lazy_loader"}
#: Modules of pure rooms that read or write files.
EDGES = {"scenario/store.py"}
#: Functions that are one long table.
TABLES = {"scenario/schema.py: scenario_fields"}
REGISTRIES = ("pypi." + "org", "files.python" + "hosted", "download.py" + "torch", "registry.npm" + "js")


@pytest.fixture(scope="module")
def package(repository: Path) -> Path:
    return repository / "src" / "drivax"


def imported(file: Path) -> set[str]:
    """Full names of the modules that a file imports, inside functions too."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_imports_obey_the_contracts(repository: Path):
    result = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=repository, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("room", PURE_ROOMS)
def test_pure_rooms_import_no_files_or_tracking(package: Path, room: str):
    for file in sorted((package / room).rglob("*.py")):
        if str(file.relative_to(package)) in EDGES:
            continue
        for name in imported(file):
            top = name.split(".")[0]
            allowed = top in PURE_PACKAGES | {"drivax", "__future__"} or top in sys.stdlib_module_names
            assert allowed, f"{file.relative_to(package)} imports {name}"
            forbidden = ("drivax.tracking", "drivax.scenario.store")
            assert not name.startswith(forbidden), f"{file.relative_to(package)} imports {name}"


def test_readers_and_the_world_work_without_jax(package: Path):
    """Their worker processes must start fast and never touch an accelerator."""
    modules = ["drivax", "drivax.errors", "drivax.geometry.boxes", "drivax.simulator.idm"]
    for room in ("datasets", "synthetic"):
        for file in sorted((package / room).rglob("*.py")):
            name = ".".join(file.relative_to(package.parent).with_suffix("").parts)
            modules.append(name.removesuffix(".__init__"))
    for room in ("arrays", "schema", "store", "build", "select"):
        place = package / "scenario" / room
        names = [f"{room}.{file.stem}" for file in place.glob("[a-z]*.py")] if place.is_dir() else [room]
        modules += [f"drivax.scenario.{name}" for name in names]
    program = f"import sys, {', '.join(modules)}\nprint('jax' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "False\n"


def test_every_module_imports_without_printing(package: Path):
    files = sorted(package.rglob("*.py"))
    names = [".".join(file.relative_to(package.parent).with_suffix("").parts) for file in files]
    names = [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]
    program = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"
    result = subprocess.run(
        [sys.executable, "-c", program, *names], capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_names_of_files(package: Path):
    forbidden = {"utils", "util", "helpers", "helper", "common", "misc"}
    found = [file for file in package.rglob("*") if file.stem in forbidden]
    assert found == []


def test_folders_hold_at_most_20_files(package: Path):
    folders = {file.parent for file in package.rglob("*.py")}
    assert {folder.name: n for folder in folders if (n := len(list(folder.glob("*.py")))) > 20} == {}


def test_files_and_functions_obey_the_size_limits(package: Path):
    """Files of at most 600 lines, functions of at most 60 lines and 8 parameters."""
    found = []
    for file in sorted(package.rglob("*.py")):
        text = file.read_text()
        place = str(file.relative_to(package))
        if (lines := len(text.splitlines())) > 600:
            found.append(f"{place}: {lines} lines")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                if lines > 60 and f"{place}: {node.name}" not in TABLES:
                    found.append(f"{place}: {node.name}: {lines} lines")
                own = {"self", "cls"} & {arg.arg for arg in node.args.args[:1]}
                if (count := len(node.args.args) + len(node.args.kwonlyargs) - len(own)) > 8:
                    found.append(f"{place}: {node.name}: {count} parameters")
    assert found == []


def tracked_files(repository: Path) -> list[Path]:
    command = ["git", "-C", str(repository), "ls-files", "--cached", "--others", "--exclude-standard"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.skip("not a git checkout")
    return [repository / line for line in result.stdout.splitlines() if (repository / line).is_file()]


def test_no_registry_hosts_and_no_paths_of_one_machine(repository: Path):
    pattern = re.compile(
        "|".join([*map(re.escape, REGISTRIES), "/" + "work/", "/" + r"home/\w", "/" + "root/"])
    )
    for file in tracked_files(repository):
        try:
            text = file.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        found = pattern.search(text)
        assert found is None, f"{file.relative_to(repository)}: {found}"


def test_no_large_files(repository: Path):
    limits = {".json": 300_000, ".png": 200_000}
    large = [
        file for file in tracked_files(repository) if file.stat().st_size > limits.get(file.suffix, 500_000)
    ]
    assert large == []


def test_episodes_and_tables_of_experiments_are_not_tracked(repository: Path):
    """Only weights are: those of the zoo, and while experiments run, those of their policies."""
    stored = [file for file in tracked_files(repository) if file.suffix in (".npz", ".csv", ".xz", ".jsonl")]
    places = {file.relative_to(repository).parts[:3] for file in stored if file.name == "policy.npz"}
    assert [file for file in stored if file.name != "policy.npz"] == []
    assert places <= {("src", "drivax", "zoo"), ("experiments", "state", "policies")}


#: ``name[extras]==version`` with an optional marker, and one or more hashes on lines of their own.
PIN = re.compile(
    r"(?P<pin>[A-Za-z0-9._-]+(\[[a-z0-9, -]+\])?==[\w.+!]+)(?P<marker> ; [^\\\n]+)?"
    r"( \\\n    --hash=sha256:[0-9a-f]{64})+\n"
)


def pins(path: Path) -> dict[str, Requirement]:
    """Pins of a lock file by normal name, of the packages that this machine needs."""
    found = {
        Requirement(match["pin"])
        for match in PIN.finditer(path.read_text())
        if not match["marker"] or Marker(match["marker"].removeprefix(" ; ")).evaluate()
    }
    return {canonicalize_name(pin.name): pin for pin in found}


def version_of(pin: Requirement) -> str:
    return next(iter(pin.specifier)).version


def unmet(requirement: Requirement, pinned: dict[str, Requirement]) -> set[str]:
    """The requirement, and what its package needs in turn, as far as the pins do not meet it, extras included."""
    found, waiting, seen = set(), [requirement], set()
    while waiting:
        needed = waiting.pop()
        pin = pinned.get(canonicalize_name(needed.name))
        if pin is None or not (
            needed.extras <= pin.extras and needed.specifier.contains(version_of(pin), prereleases=True)
        ):
            found.add(str(needed))
        elif str(needed) not in seen:
            installed = metadata.version(needed.name)
            assert installed == version_of(pin), f"install the lock file: {pin}"
            seen.add(str(needed))
            for line in map(Requirement, metadata.requires(needed.name) or ()):
                extras = ("", *needed.extras)
                if line.marker is None or any(line.marker.evaluate({"extra": extra}) for extra in extras):
                    waiting.append(line)
    return found


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-docs.lock"])
def test_lock_files_pin_exactly_with_hashes_and_name_no_index(name: str, repository: Path):
    text = (repository / name).read_text()
    assert PIN.sub("", text) == "", "something else than pins with hashes"
    assert len(pins(repository / name)) > 20


def test_lock_file_meets_every_requirement_of_the_project(repository: Path):
    """pip refuses a file with hashes if any requirement, direct or indirect, is missing from it."""
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    lines = [*project["project"]["dependencies"], *project["dependency-groups"]["dev"]]
    lines += [line for name in extras if name != "all" for line in extras[name]]
    assert Requirement(extras["all"][0]).extras == extras.keys() - {"all"}
    pinned = pins(repository / "requirements.lock")
    assert {found for line in lines for found in unmet(Requirement(line), pinned)} == set()
    assert unmet(Requirement("numpy<2"), pinned) == {"numpy<2"}
    assert unmet(Requirement("coverage[no-such]"), pinned) == {"coverage[no-such]"}
    del pinned["optax"]
    assert [line.split(">")[0] for line in unmet(Requirement("flax"), pinned)] == ["optax"]


def test_lock_files_agree(repository: Path):
    """The documentation is built in the environment of the tests."""
    one, other = (pins(repository / name) for name in ("requirements.lock", "requirements-docs.lock"))
    shared = one.keys() & other.keys()
    assert shared
    assert {name: version_of(one[name]) for name in shared} == {
        name: version_of(other[name]) for name in shared
    }
