import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from drivax import kernels
from drivax.kernels import library
from drivax.networks.encoders import max_pool
from kernels.compare import TARGETS, needs_kernels, run_tests


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


def test_a_missing_or_damaged_library_is_not_used(tmp_path):
    program = f"from pathlib import Path; from drivax.kernels import library; library.PATH = Path({{}}); {PRINT_STATE}"
    assert (
        run(program.format(repr(str(tmp_path / "libdrivax.so"))))
        == "False none: make native (on Linux x86-64)"
    )
    damaged = tmp_path / "libdrivax.so"
    damaged.write_bytes(b"\x7fELF" + b"no library" * 50)
    assert run(program.format(repr(str(damaged)))) == "False none: libdrivax.so does not load here"


def test_a_library_that_programs_do_not_call_is_not_in_use(monkeypatch):
    functions = {"drivax_target": lambda: b"AVX2", "drivax_hash": lambda: b"0123"}
    monkeypatch.setattr(library, "_library", lambda: SimpleNamespace(**functions))
    assert kernels.state() == "AVX2, build 0123"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert kernels.state() == "none: AVX2, build 0123 is for float32 on CPUs"


@needs_kernels
def test_the_target_can_be_lowered():
    assert run(PRINT_STATE, DRIVAX_NATIVE="sse4.2").startswith("True SSE4.2, build ")


@needs_kernels
def test_kernels_are_not_traced_where_they_are_excluded():
    layers = [(jnp.ones((3, 32)), jnp.zeros(32)), (jnp.ones((32, 32)), jnp.zeros(32))]
    rows, valid = jnp.ones((2, 4, 3)), jnp.ones((2, 4), bool)

    def program():
        return jax.jit(lambda: max_pool("relu", layers, rows, valid)).lower().as_text()

    assert "drivax_encode_sets" in program()
    with kernels.without_kernels():
        assert "drivax_encode_sets" not in program()
    assert "drivax_encode_sets" in program()


DIVIDE = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from drivax.kernels import set_encoder

rng = np.random.default_rng(0)
layer = lambda inputs: (jnp.asarray(rng.normal(size=(inputs, 32)), jnp.float32), jnp.zeros(32))
layers = layer(5), layer(32)
rows, valid = jnp.asarray(rng.normal(size=(8, 6, 5)), jnp.float32), jnp.asarray(rng.random((8, 6)) < 0.5)
encode = jax.jit(jax.vmap(lambda rows, valid: set_encoder.encode(layers, rows, valid)[0]))
expected = encode(rows, valid)
mesh = Mesh(np.array(jax.devices()), ("devices",))
arguments = jax.device_put((rows, valid), NamedSharding(mesh, PartitionSpec("devices")))
with jax.set_mesh(mesh):
    program = encode.lower(*arguments).compile()
np.testing.assert_array_equal(program(*arguments), expected)
text = program.as_text()
print("f32[4,32]" in text, "all-gather" in text)
"""


@needs_kernels
def test_devices_divide_a_batch():
    assert run(DIVIDE, XLA_FLAGS="--xla_force_host_platform_device_count=2") == "True False"


@needs_kernels
def test_compiled_programs_name_the_build():
    from drivax.kernels import set_encoder

    layers = [(jnp.ones((3, 32)), jnp.zeros(32)), (jnp.ones((32, 32)), jnp.zeros(32))]
    text = jax.jit(set_encoder.encode).lower(layers, jnp.ones((2, 4, 3)), jnp.ones((2, 4), bool)).as_text()
    digest = kernels.state().split()[-1]
    assert f"drivax_encode_sets_{digest}" in text


@pytest.fixture(scope="module")
def sanitized(repository, tmp_path_factory):
    """The library with AddressSanitizer and UndefinedBehaviorSanitizer, and the environment that it needs."""
    compiler = os.environ.get("CXX", "c++")
    if shutil.which(compiler) is None:
        pytest.skip("no C++ compiler")
    built = tmp_path_factory.mktemp("sanitized") / "libdrivax.so"
    script = repository / "native" / "build.py"
    subprocess.run([sys.executable, str(script), "--strict", "--sanitize", "--out", str(built)], check=True)
    paths = [f"-print-file-name={name}.so" for name in ("libasan", "libubsan", "libstdc++")]
    runtimes = [subprocess.check_output([compiler, path], text=True).strip() for path in paths]
    return {
        "DRIVAX_NATIVE_LIBRARY": str(built),
        "LD_PRELOAD": ":".join(runtimes),
        "ASAN_OPTIONS": "detect_leaks=0",
    }


@pytest.mark.slow
@pytest.mark.parametrize("target", [*TARGETS, "best"])
def test_sanitizers_find_no_error_in_the_kernels(repository, sanitized, target):
    """Over the tests of all kernels, with 10,000 random maps and 10,000 calls with any numbers."""
    run_tests(repository / "tests" / "kernels", "slow or not slow", DRIVAX_NATIVE=target, **sanitized)
