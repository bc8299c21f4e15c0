"""The cache of compiled programs on disk."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drivax.compilation import use_compilation_cache

#: Prints how many programs came from the cache, and a result.
_PROGRAM = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp
import drivax
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
drivax.use_compilation_cache(Path(sys.argv[1]))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(float(jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.arange(3.0))), len(hits))
"""


@pytest.fixture
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the cache of the tests; what a test sets is restored."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "jax")


def _run(folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMP")}
    command = [sys.executable, "-c", _PROGRAM, str(folder)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)


def test_second_process_reads_programs_and_a_damaged_entry_is_compiled_again(tmp_path: Path) -> None:
    first, second = _run(tmp_path), _run(tmp_path)
    value, hits = second.stdout.split()
    assert first.stdout.split() == [value, "0"]
    assert int(hits) > 0
    for entry in tmp_path.glob("jax-*/*-cache"):
        entry.write_bytes(entry.read_bytes()[:100])
    damaged = _run(tmp_path)
    assert damaged.stdout.split() == [value, "0"]
    assert "persistent compilation cache" in damaged.stderr


@pytest.mark.usefixtures("no_environment")
def test_only_the_user_may_enter_the_folder(tmp_path: Path) -> None:
    (tmp_path / "top").mkdir(0o777)
    folder = use_compilation_cache(tmp_path / "top")
    assert folder is not None
    assert {stat.S_IMODE(path.stat().st_mode) for path in (folder, folder.parent)} == {0o700}
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(folder)


@pytest.mark.usefixtures("no_environment")
def test_a_folder_of_another_user_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    assert use_compilation_cache(tmp_path / "top") is None
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


@pytest.mark.usefixtures("no_environment")
def test_a_file_in_place_of_the_folder_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "top").write_text("")
    assert use_compilation_cache(tmp_path / "top") is None


@pytest.mark.usefixtures("no_environment")
def test_a_user_without_a_home_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    assert use_compilation_cache() is None


def test_folder_of_the_environment_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    assert use_compilation_cache(tmp_path / "top") is None
    assert not (tmp_path / "top").exists()


@pytest.mark.usefixtures("no_environment")
def test_least_recently_used_programs_of_all_versions_are_deleted(tmp_path: Path) -> None:
    # The first version had one folder for all.
    ages_s = {"jax/a": 9000, "jax-0.1-old/b": 7000, "jax-0.2-new/c": 8000, "jax-0.2-new/d": 10}
    for name, age_s in ages_s.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(100))
        os.utime(path, (time.time() - age_s,) * 2)
    use_compilation_cache(tmp_path, max_bytes=250)
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.glob("*/*")} == {
        "jax-0.1-old/b",
        "jax-0.2-new/d",
    }
    del os.environ["JAX_COMPILATION_CACHE_DIR"]
    use_compilation_cache(tmp_path, max_bytes=0)
    # The newest may still be written by another process; the folder of an old version goes.
    assert {path.parent.name for path in tmp_path.glob("*/*")} == {"jax-0.2-new"}
    assert not [path for path in (tmp_path / "jax", tmp_path / "jax-0.1-old") if path.exists()]


def test_long_compilation_is_reported_once() -> None:
    program = """
import sys
import time
import jax
from drivax import compilation
compilation._PATIENCE_S = 0.0
compilation.report_compilation(lambda line: print(line, file=sys.stderr))
jax.jit(lambda x: jax.lax.sort(x * 2))(jax.numpy.arange(5.0))
jax.jit(lambda x: jax.lax.sort(x * 3))(jax.numpy.arange(5.0))
time.sleep(0.2)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.count("compiling (the first time only") == 1
    quiet = program.replace("= 0.0", "= 60.0")
    done = subprocess.run([sys.executable, "-c", quiet], capture_output=True, text=True, check=True)
    assert "compiling" not in done.stderr


@pytest.mark.parametrize("flag", ["", "--no-cache"])
def test_commands_store_programs_without_no_cache(tmp_path: Path, flag: str) -> None:
    program = f"""
from drivax.cli import main
main("bench --help {flag}".split())
import jax, jax.numpy as jnp
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.jit(lambda x: jnp.sin(x) * 2)(jnp.arange(3.0))
"""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMP")}
    # JAX itself follows its own variable.
    environment |= {"XDG_CACHE_HOME": str(tmp_path)} | (
        {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own")} if flag else {}
    )
    subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True)
    assert bool(list(tmp_path.rglob("*-cache"))) == (not flag)
