import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from drivax import kernels
from drivax.kernels import library
from drivax.kernels.library import append_stamp, read_stamp, stamp
from drivax.networks.encoders import max_pool
from kernels.compare import COMPILER, TARGETS, needs_compiler, needs_kernels, run_tests


def run(program, **variables):
    environment = os.environ | variables
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


PRINT_STATE = "from drivax import kernels; print(kernels.in_use(), kernels.state())"


def test_zero_switches_the_kernels_off():
    expected = "none, since DRIVAX_NATIVE=0"
    assert run(PRINT_STATE, DRIVAX_NATIVE="0") == f"False {expected}"


class Installed:
    """A file in place of the library, which is never loaded."""

    def __init__(self, path):
        self.path = path

    def install(self, content):
        self.path.write_bytes(content)
        self.path.chmod(0o755)
        return self.state()

    def state(self):
        state, maps = library._load.__wrapped__(), Path("/proc/self/maps")
        assert not maps.exists() or str(self.path) not in maps.read_text()
        return state


@pytest.fixture
def installed(tmp_path, monkeypatch):
    folder = tmp_path / "kernels"
    folder.mkdir(mode=0o755)
    monkeypatch.setattr(library, "PATH", folder / "libdrivax.so")
    return Installed(library.PATH)


#: Dynamic loaders read at least its header.
CODE = b"\x7fELF" + b"no library" * 50


def test_without_a_library_the_build_is_named(installed):
    assert installed.state() == "none: make native (on Linux x86-64)"


def test_a_damaged_library_is_not_loaded(installed):
    complete = append_stamp(CODE, stamp(library.SOURCES))
    assert "does not load here" in installed.install(complete)  # the loader's word: only the code is missing
    flipped = complete.replace(b"library", b"librarY", 1)
    problem = f"none: {installed.path} is incomplete, damaged or not a drivax library: make native"
    for content in (b"", CODE, complete[:200], complete[:-1], complete[:-80], complete + b"x", flipped):
        assert installed.install(content) == problem
    stampless = CODE + b"\nnot JSON"
    stampless += b"\n" + hashlib.sha256(stampless).hexdigest().encode()
    assert "does not load here" in installed.install(stampless)


@pytest.mark.parametrize(
    ("name", "other"), [("platform", "linux-aarch64"), ("XLA FFI", "7"), ("sources", "0123")]
)
def test_a_library_for_another_machine_or_version_is_not_loaded(installed, name, other):
    values = stamp(library.SOURCES)
    problem = f"was built for {name} {other}, this is {values[name]}: make native"
    assert installed.install(append_stamp(CODE, values | {name: other})).endswith(problem)
    del values[name]
    assert f"was built for {name} None" in installed.install(append_stamp(CODE, values))


def test_any_change_of_a_source_makes_a_library_stale(repository, tmp_path):
    sources = shutil.copytree(repository / "native", tmp_path / "native")
    before = stamp(sources)["sources"]
    assert before == stamp(repository / "native")["sources"]
    for name in ("lanes.cc", "simd.h", "build.py"):
        with (sources / name).open("a") as file:
            file.write("\n")
        before, after = stamp(sources)["sources"], before
        assert before != after
    for name in ("lanes.cc~", ".lanes.cc.swp", ".#lanes.cc", "lanes.cc.orig"):  # of editors
        (sources / name).write_text("draft")
    (sources / ".cache").mkdir()
    assert stamp(sources)["sources"] == before
    shutil.rmtree(sources)
    assert "sources" not in stamp(sources)  # a wheel


def test_a_library_that_others_can_replace_is_not_loaded(installed, tmp_path):
    installed.install(append_stamp(CODE, stamp(library.SOURCES)))
    cache = tmp_path / "cache"
    cache.mkdir(mode=0o755)
    for is_link in (False, True):
        if is_link:  # as package managers install it
            installed.path.symlink_to(installed.path.rename(cache / "libdrivax.so"))
        assert "does not load here" in installed.state()
        for path in {installed.path.resolve(), installed.path.resolve().parent, installed.path.parent}:
            before = path.stat().st_mode
            path.chmod(0o757)
            problem = f"{installed.path} or its folder is writable by other users: chmod go-w {path}"
            assert installed.state() == f"none: {problem}"
            path.chmod(before)


def test_a_library_as_easy_to_write_as_the_code_is_loaded(installed, tmp_path, monkeypatch):
    """Mounted folders may have all permissions everywhere."""
    code = tmp_path / "library.py"
    code.touch()
    monkeypatch.setattr(library, "__file__", str(code))
    installed.install(append_stamp(CODE, stamp(library.SOURCES)))
    for mode, is_loaded in ((0o777, True), (0o775, False), (0o755, False)):
        for path in (installed.path, installed.path.parent):
            path.chmod(0o777)
        code.chmod(mode)
        assert ("does not load here" in installed.state()) == is_loaded


def test_a_pipe_is_not_read(installed):
    os.mkfifo(installed.path, 0o600)
    assert installed.state().endswith("is not a regular file: make native")


def test_a_wheel_is_installed_again(installed, tmp_path, monkeypatch):
    monkeypatch.setattr(library, "SOURCES", tmp_path)
    assert installed.state() == "none: install drivax again (on Linux x86-64)"
    assert installed.install(CODE).endswith("not a drivax library: install drivax again")


def test_a_library_with_sanitizers_needs_their_runtime(installed, monkeypatch):
    """Without it, loading ends the process."""
    options = {"options": "-g -fsanitize=address"}
    content = append_stamp(CODE, stamp(library.SOURCES) | options)
    assert installed.install(content).endswith("is for tests with sanitizers: make native")
    monkeypatch.setenv("LD_PRELOAD", "/usr/lib/libasan.so")
    assert "does not load here" in installed.state()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_a_library_of_another_user_is_not_loaded(installed):
    installed.install(append_stamp(CODE, stamp(library.SOURCES)))
    os.chown(installed.path, 12345, 12345)
    problem = f"or its folder belongs to another user: chown 0 {installed.path}"
    assert installed.state() == f"none: {installed.path} {problem}"


def test_no_variable_and_no_current_folder_moves_the_library(tmp_path, monkeypatch):
    expected = run(PRINT_STATE)
    (tmp_path / "libdrivax.so").write_bytes(CODE)
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "libdrivax.so").write_bytes(CODE)
    monkeypatch.chdir(tmp_path)
    variables = {"DRIVAX_NATIVE_LIBRARY": "./libdrivax.so", "LD_LIBRARY_PATH": "."}
    assert run(PRINT_STATE, **variables) == expected
    assert Path(kernels.__file__).absolute().with_name("libdrivax.so") == library.PATH


def test_a_library_that_programs_do_not_call_is_not_in_use(monkeypatch):
    functions = {"drivax_target": lambda: b"AVX2", "drivax_hash": lambda: b"0123"}
    monkeypatch.setattr(library, "_load", lambda: SimpleNamespace(**functions))
    assert kernels.state() == "AVX2, build 0123"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert kernels.state() == "none: AVX2, build 0123 is for float32 on CPUs"


@needs_kernels
def test_the_target_can_be_lowered():
    assert run(PRINT_STATE, DRIVAX_NATIVE="sse4.2").startswith("True SSE4.2, build ")


@needs_kernels
def test_a_copy_of_the_library_is_used(tmp_path):
    copy = shutil.copy2(library.PATH, tmp_path)
    program = (
        f"from pathlib import Path; from drivax.kernels import library; library.PATH = Path({str(copy)!r}); "
    )
    assert run(program + PRINT_STATE) == f"True {kernels.state()}"


REGISTER = """
from pathlib import Path
from drivax.kernels import library
from drivax.kernels.library import append_stamp, stamp

library.PATH = Path({path!r})
library.PATH.write_bytes(append_stamp(library.PATH.read_bytes(), stamp(library.SOURCES)))
"""


@needs_compiler
def test_a_library_that_xla_refuses_is_not_used(tmp_path):
    """The handler of this one has version 0.0."""
    strings = {"kernels": "other", "target": "AVX2", "hash": "0123"}
    functions = [f'const char* drivax_{name}() {{ return "{value}"; }}' for name, value in strings.items()]
    source, path = tmp_path / "other.cc", tmp_path / "libdrivax.so"
    source.write_text(f'extern "C" {{ {" ".join(functions)} void* drivax_other(void*) {{ return 0; }} }}')
    subprocess.run([COMPILER, "-shared", "-fPIC", str(source), "-o", str(path)], check=True)
    path.chmod(0o755)
    state = run(REGISTER.format(path=str(path)) + PRINT_STATE)
    assert state.startswith(f"False none: {path} does not load here (") and "version" in state


@pytest.fixture
def checkout(repository, tmp_path):
    """A copy of the build with a single small source."""
    for name in ("native/build.py", "src/drivax/kernels/library.py"):
        (tmp_path / name).parent.mkdir(parents=True)
        shutil.copy2(repository / name, tmp_path / name)
    (tmp_path / "native" / "library.cc").write_text("int one() { return 1; }\n")
    return tmp_path


@pytest.fixture(scope="module")
def gcc():
    version = subprocess.check_output([COMPILER, "--version"], text=True)
    if "Free Software Foundation" not in version:
        pytest.skip(f"{COMPILER} is not GCC, whose sanitizers are preloaded")


def build(checkout, *options, umask=0o022, **variables):
    command = [sys.executable, str(checkout / "native" / "build.py"), *options]
    environment = os.environ | variables
    done = subprocess.run(command, env=environment, umask=umask, capture_output=True, text=True, check=False)
    return done, checkout / "src" / "drivax" / "kernels" / "libdrivax.so"


@needs_compiler
def test_no_umask_makes_the_library_writable_by_others(checkout):
    _, path = build(checkout, umask=0)
    assert path.stat().st_mode & 0o777 == 0o755
    assert read_stamp(path.read_bytes()) == stamp(checkout / "native") | {"options": ""}


@needs_compiler
def test_sources_that_change_during_the_build_end_it(checkout):
    compiler = checkout / "compiler"
    source = checkout / "native" / "library.cc"
    compiler.write_text(f'#!/bin/sh\n{COMPILER} "$@" && echo >> {source}\n')
    compiler.chmod(0o755)
    done, path = build(checkout, CXX=str(compiler))
    assert done.stderr == "make native: sources changed during the build; run it again\n"
    assert not path.exists()


@needs_compiler
def test_the_stamp_names_sanitizers(gcc, checkout):
    _, path = build(checkout, "--sanitize")
    assert "-fsanitize=address" in read_stamp(path.read_bytes())["options"]


def test_only_skips_for_want_of_kernels_fail_inner_tests(tmp_path):
    file = tmp_path / "test_skips.py"
    file.write_text("import pytest\ndef test(): pass\ndef test_skip(): pytest.skip('only root')\n")
    run_tests(file)
    file.write_text(file.read_text().replace("only root", "no native kernels: none"))
    with pytest.raises(AssertionError, match="no native kernels"):
        run_tests(file)


def test_kernels_are_part_of_the_key_of_compiled_programs(monkeypatch):
    monkeypatch.setattr(library, "_load", lambda: object())

    def answer(_):
        return jnp.float32(kernels.in_use())

    @jax.jit
    def program(x):
        scanned = jax.lax.scan(lambda carry, _: (carry, answer(carry)), x, length=2)[1]
        branch = jax.lax.cond(x > 0, answer, answer, x)
        return jnp.stack([answer(x), scanned[0], jax.checkpoint(answer)(x), branch])

    for _ in range(2):
        assert program(1.0).tolist() == [1.0] * 4
        with kernels.without_kernels():
            assert program(1.0).tolist() == [0.0] * 4


@needs_kernels
def test_one_function_is_compiled_with_and_without_kernels():
    layers = [(jnp.ones((3, 32)), jnp.zeros(32)), (jnp.ones((32, 32)), jnp.zeros(32))]
    arguments = layers, jnp.ones((2, 4, 3)), jnp.ones((2, 4), bool)
    program = jax.jit(lambda *arguments: max_pool("relu", *arguments))
    derivative = jax.jit(jax.grad(lambda *arguments: program(*arguments).sum()))

    def texts():
        for function in (program, derivative):
            function(*arguments)
        return [function.lower(*arguments).as_text() for function in (program, derivative)]

    native = texts()
    assert "drivax_encode_sets" in native[0] and "drivax_differentiate_sets" in native[1]
    with kernels.without_kernels():
        by_xla = texts()
        assert not any("drivax_" in text for text in by_xla)
    assert texts() == native


DIVIDE = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from drivax.networks.encoders import max_pool

rng = np.random.default_rng(0)
layer = lambda inputs: (jnp.asarray(rng.normal(size=(inputs, 32)), jnp.float32), jnp.zeros(32))
layers = layer(5), layer(32)
rows, valid = jnp.asarray(rng.normal(size=(8, 6, 5)), jnp.float32), jnp.asarray(rng.random((8, 6)) < 0.5)
encode = lambda layers, rows, valid: max_pool("relu", layers, rows, valid)
loss = lambda *arguments: (encode(*arguments) ** 2).sum()
seeds = jax.vmap(jax.grad(loss), (0, None, None))
mesh = Mesh(np.array(jax.devices()), ("devices",))
batch = jax.device_put((rows, valid), NamedSharding(mesh, PartitionSpec("devices")))
several = jax.tree.map(lambda weight: jnp.stack([weight, 2 * weight, weight]), layers)
for function, weights in ((encode, layers), (jax.grad(loss), layers), (seeds, several)):
    function = jax.jit(function)
    expected = function(weights, rows, valid)
    with jax.set_mesh(mesh):
        program = function.lower(jax.device_put(weights, NamedSharding(mesh, PartitionSpec())), *batch).compile()
    scale = max(abs(leaf).max() for leaf in jax.tree.leaves(expected))
    difference = jax.tree.map(lambda a, b: abs(a - b).max() / scale, program(weights, *batch), expected)
    text = program.as_text()
    calls = [line for line in text.splitlines() if "custom-call" in line and "drivax_" in line]
    print(max(jax.tree.leaves(difference)) < 1e-6, all("f32[4,6,5]" in line for line in calls), len(calls),
          "all-gather" in text, "all-reduce" in text)
"""


@needs_kernels
def test_devices_divide_a_batch_and_its_gradient():
    lines = run(DIVIDE, XLA_FLAGS="--xla_force_host_platform_device_count=2").splitlines()
    assert lines == ["True True 1 False False", "True True 2 False True", "True True 2 False True"]


@needs_kernels
def test_compiled_programs_name_the_build():
    from drivax.kernels.bindings import encode_sets

    layers = [(jnp.ones((3, 32)), jnp.zeros(32)), (jnp.ones((32, 32)), jnp.zeros(32))]
    text = jax.jit(encode_sets).lower(layers, jnp.ones((2, 4, 3)), jnp.ones((2, 4), bool)).as_text()
    digest = kernels.state().split()[-1]
    assert f"drivax_encode_sets_{digest}" in text


@pytest.fixture(scope="module")
def sanitized(gcc, repository, tmp_path_factory):
    """The environment of a copy of the package whose kernels have AddressSanitizer and UndefinedBehaviorSanitizer."""
    copy = tmp_path_factory.mktemp("sanitized")
    for folder in ("src", "native", "configs"):
        shutil.copytree(repository / folder, copy / folder)
    build = [sys.executable, str(copy / "native" / "build.py"), "--strict", "--sanitize"]
    subprocess.run(build, check=True)
    paths = [f"-print-file-name={name}.so" for name in ("libasan", "libubsan", "libstdc++")]
    runtimes = [subprocess.check_output([COMPILER, path], text=True).strip() for path in paths]
    return {
        "PYTHONPATH": str(copy / "src"),
        "LD_PRELOAD": ":".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",
    }


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("target", [*TARGETS, "best"])
def test_sanitizers_find_no_error_in_the_kernels(repository, sanitized, target):
    """Over the tests of all kernels, with 10,000 random maps and 10,000 calls with any numbers."""
    run_tests(repository / "tests" / "kernels", "slow or not slow", DRIVAX_NATIVE=target, **sanitized)
