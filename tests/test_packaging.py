"""The wheel: built from the tree, installed into an empty environment, and used there."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import site
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from kernels.compare import needs_compiler


def build(tree: Path, folder: Path, *options: str) -> Path:
    """Build a tree into a folder, and return the wheel."""
    command = [sys.executable, "-m", "build", *options, "--no-isolation", "--outdir", str(folder), str(tree)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    return build(repository, tmp_path_factory.mktemp("wheel"), "--wheel")


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory, wheel: Path) -> Path:
    """A fresh virtual environment with the wheel in it, and the packages that it needs, but not this checkout."""
    folder = tmp_path_factory.mktemp("environment") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    # A path in a .pth file is searched, but .pth files inside it (the editable install) are not run.
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    return folder


def run(environment: Path, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    command = [str(environment / "bin" / arguments[0]), *arguments[1:]]
    return subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)


def test_wheel_contains_sources_presets_and_types_only(wheel: Path, repository: Path):
    names = set(zipfile.ZipFile(wheel).namelist())
    package = repository / "src" / "drivax"
    files = [path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    # `make native` may have left a library, which only wheels of one platform contain.
    sources = {str(path.relative_to(package.parent)) for path in files if path.suffix != ".so"}
    assert sources <= names
    assert not [name for name in names if name.endswith(".so")]
    presets = {f"drivax/configs/{path.relative_to(repository / 'configs')}"
               for path in (repository / "configs").rglob("*.yaml")}  # fmt: skip
    assert presets <= names
    assert "drivax/py.typed" in names
    tops = {name.split("/")[0] for name in names}
    assert len(tops) == 2, tops  # the package and its metadata
    assert not [name for name in names if "test" in Path(name).name or name.endswith(".pyc")]


@pytest.mark.slow
def test_wheel_and_sdist_are_reproducible_byte_for_byte(wheel: Path, repository: Path, tmp_path: Path):
    """Two copies in other folders, with other times, modes and umask; the wheels come from the sdists."""
    names = [
        "src",
        "configs",
        "tests",
        "examples",
        "experiments",
        "docs",
        "native",
        "pyproject.toml",
        "requirements.lock",
    ]
    names += [*(path.name for path in repository.glob("*.md")), "LICENSE", "Makefile", ".gitignore"]
    wheels, archives = [], []
    for number, (umask, mode) in enumerate([(0o022, 0o644), (0o077, 0o600)]):
        before = os.umask(umask)
        try:
            tree = tmp_path / ("tree" * (number + 1))
            for name in sorted(names, reverse=bool(number)):
                source, target = repository / name, tree / name
                target.parent.mkdir(exist_ok=True)
                ignore = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, target, ignore=ignore) if source.is_dir() else shutil.copy(
                    source, target
                )
            for path in filter(Path.is_file, tree.rglob("*")):
                path.chmod(mode)
                os.utime(path, (1e9 + 1e8 * number, 1e9 + 1e8 * number))
            wheels.append(build(tree, tmp_path / f"out-{number}"))
            archives.extend((tmp_path / f"out-{number}").glob("*.tar.gz"))
        finally:
            os.umask(before)
    assert len({hashlib.sha256(path.read_bytes()).hexdigest() for path in archives}) == 1
    assert len({hashlib.sha256(path.read_bytes()).hexdigest() for path in [wheel, *wheels]}) == 1
    with tarfile.open(archives[0]) as archive:
        assert any(name.endswith("/src/drivax/__init__.py") for name in archive.getnames())


@pytest.mark.slow
@needs_compiler
def test_a_wheel_for_one_platform_contains_the_native_kernels(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("DRIVAX_WHEEL_TAG", "linux_x86_64")
    wheel = build(repository, tmp_path, "--wheel")
    assert wheel.name.endswith("-py3-none-linux_x86_64.whl")
    assert "drivax/kernels/libdrivax.so" in zipfile.ZipFile(wheel).namelist()


def test_wheel_declares_licence_python_and_entry_point(wheel: Path):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
    metadata = Parser().parsestr(archive.read(name).decode())
    assert metadata["Name"] == "drivax"
    assert metadata["License-Expression"] == "MIT"
    assert metadata["License-File"] == "LICENSE"
    assert metadata["Requires-Python"] in (">=3.11,<3.14", "<3.14,>=3.11")
    requirements = metadata.get_all("Requires-Dist") or []
    assert not [line for line in requirements if "tensorflow" in line.lower() or "waymax" in line.lower()]
    assert "drivax = drivax.cli:main" in archive.read(name.replace("METADATA", "entry_points.txt")).decode()


def test_installed_package_works(environment: Path, tmp_path: Path):
    where = run(environment, "python", "-c", "import drivax; print(drivax.__file__)", folder=tmp_path)
    assert str(environment) in where.stdout, where.stderr
    overview = run(environment, "drivax", "--help", folder=tmp_path)
    assert (overview.returncode, overview.stderr) == (0, "")
    made = run(
        environment, "drivax", "generate", "world", "--scenarios", "1", "--workers", "1", folder=tmp_path
    )
    assert made.returncode == 0, made.stderr
    seen = run(environment, "drivax", "inspect", "world", "--json", folder=tmp_path)
    assert seen.returncode == 0, seen.stderr
    (scenario,) = json.loads(seen.stdout)["scenarios"]
    assert scenario["steps"] == 91
    assert [path.name for path in tmp_path.iterdir()] == ["world"]


def test_presets_are_found_in_the_installed_package(environment: Path, tmp_path: Path, repository: Path):
    program = (
        "from drivax.settings import preset, presets\nfor name in presets(): print(preset(name).read_text())"
    )
    result = run(environment, "python", "-c", program, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    files = sorted((repository / "configs").rglob("*.yaml"), key=lambda path: str(path.with_suffix("")))
    assert result.stdout == "".join(f"{path.read_text()}\n" for path in files)
