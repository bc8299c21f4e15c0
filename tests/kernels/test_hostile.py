"""Kernels stay inside of their arrays, whatever numbers a stranger's files hold, and refuse arrays of other shapes.

Under the sanitizers (``test_library.py``) any access outside of an array is an error.
"""

import ctypes
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.kernels import library
from kernels import test_observations, test_roads, test_set_encoder, test_simulation
from kernels.compare import TARGETS, needs_kernels, run_on_target

pytestmark = needs_kernels

KERNELS = (
    "differentiate_sets", "encode_sets", "look_ahead", "measure_contacts", "observe_agents", "observe_road",
    "observe_route", "query_edges", "query_lanes", "read_frames",
)  # fmt: skip
#: Last axes that no other array has, nor the kernel: arguments by number.
FREE = {("query_edges", 0), ("query_lanes", 0), ("observe_agents", 3)}
INTEGERS = (-(2**31), -(2**15), -129, -2, -1, 0, 1, 5, 31, 32, 127, 2**15 - 1, 2**31 - 1)
FLOATS = (np.nan, -np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 2.0**31, -(2.0**31), -1.0, 0.0, 1.0)


class Call(NamedTuple):
    """A call of a kernel: shapes of results and arguments, and attributes."""

    name: str
    results: Any
    arguments: list[jax.ShapeDtypeStruct]
    attributes: dict[str, Any]

    def compile(self):
        return jax.jit(lambda *arrays: jax.ffi.ffi_call(self.name, self.results)(*arrays, **self.attributes))


@cache
def calls():
    """One call of each kernel on a batch, as the functions make them whose results the other tests compare."""
    found = {}

    def record(name, results):
        def call(*arguments, **attributes):
            shapes = [jax.ShapeDtypeStruct(value.shape, value.dtype) for value in arguments]
            found[name.removeprefix("drivax_").rsplit("_", 1)[0]] = Call(name, results, shapes, attributes)
            return original(name, results)(*arguments, **attributes)

        return call

    original = library.jax.ffi.ffi_call
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library.jax.ffi, "ffi_call", record)
        rng = np.random.default_rng(0)
        config = test_observations.CONFIGS["all"]
        observe = jax.vmap(lambda *arrays: test_observations.observe(config, *arrays), (None, 0, 0))
        jax.eval_shape(observe, *test_observations.world((19, 33, 40), 0))
        bank = test_roads.random_bank(test_roads.SHAPES[2], 5, rng)[0]
        test_roads.look_up(bank, test_roads.poses_near(bank, 8, rng, 19.0))
        test_set_encoder.value_and_gradient(*test_set_encoder.problem((17, 31, 6, 32), 0))
        bank = test_simulation.hand_made_bank()
        logs = test_simulation.random_log(rng, bank, 5, 9)
        problem = test_simulation.following_problem(bank, 0, 9)
        jax.eval_shape(jax.vmap(test_simulation.look_ahead, (None, 0, 0)), *problem)
        jax.eval_shape(jax.vmap(lambda *a: test_simulation.simulator.now(*a), (None, 0)), logs, problem[1])
        jax.eval_shape(jax.vmap(test_simulation.measure), *test_simulation.contact_problem(0, 7))
    return found


def hostile(rng, shape, dtype):
    """Random numbers of an array: any, or mostly those that files hold."""
    dtype, share = np.dtype(dtype), rng.choice([0.0, 0.02, 0.5, 1.0])
    if dtype.kind == "b":
        return rng.integers(0, 256 if share else 2, shape, np.uint8).view(bool)
    if dtype.kind == "f":
        usual = rng.normal(size=shape) * rng.choice([0.5, 3.0, 40.0])
        with np.errstate(over="ignore"):
            return np.where(rng.random(shape) < share, rng.choice(FLOATS, shape), usual).astype(dtype)
    usual = rng.integers(0, rng.choice([2, 9, 100]), shape)
    if rng.random() < 0.5:
        usual = np.sort(usual, axis=-1)
    return np.where(rng.random(shape) < share, rng.choice(INTEGERS, shape), usual).astype(dtype)


def surrounded(array, byte):
    """A copy with ``byte`` in the memory around it, aligned as arrays of XLA are, which it takes without a copy."""
    memory = np.full(array.nbytes + 8192, byte, np.uint8)
    begin = 4096 + -memory.ctypes.data % 64
    memory[begin : begin + array.nbytes] = np.frombuffer(array.tobytes(), np.uint8)
    return jax.device_put(memory[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape))


def test_kernels_read_arrays_in_the_memory_around_them():
    array = surrounded(np.arange(5, dtype=np.int16), 0x7F)
    memory = ctypes.string_at(array.unsafe_buffer_pointer() - 5, 20)
    assert memory == b"\x7f" * 5 + bytes([0, 0, 1, 0, 2, 0, 3, 0, 4, 0]) + b"\x7f" * 5


def test_all_kernels_are_recorded():
    assert tuple(sorted(calls())) == KERNELS
    assert sorted(library._load().drivax_kernels().decode().split()) == sorted(KERNELS)


def run_hostile(name, seeds):
    call = calls()[name]
    run = call.compile()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        arguments = [hostile(rng, argument.shape, argument.dtype) for argument in call.arguments]
        # Sanitizers see what is read beyond arrays that lie in no larger memory.
        expected = jax.device_get(run(*arguments))
        for byte in (0, 0x7F):
            actual = jax.device_get(run(*[surrounded(array, byte) for array in arguments]))
            jax.tree.map(np.testing.assert_array_equal, actual, expected)


@pytest.mark.parametrize("name", KERNELS)
def test_any_numbers_are_read_inside_of_the_arrays(name):
    run_hostile(name, range(40))


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
def test_many_random_numbers_are_read_inside_of_the_arrays(name):
    run_hostile(name, range(1000, 2000))


@pytest.mark.parametrize("name", KERNELS)
def test_arrays_of_other_shapes_and_types_are_refused(name):
    call = calls()[name]
    arguments = [np.zeros(argument.shape, argument.dtype) for argument in call.arguments]
    run = call.compile()
    jax.block_until_ready(run(*arguments))
    for number, array in enumerate(arguments):
        others = [array.astype(np.float16)] + [array[..., 1:]] * ((name, number) not in FREE)
        for other in others:
            with pytest.raises(jax.errors.JaxRuntimeError, match="native kernel"):
                jax.block_until_ready(run(*arguments[:number], other, *arguments[number + 1 :]))


def test_indices_beyond_the_columns_are_refused():
    call = calls()["observe_road"]
    arguments = [np.zeros(argument.shape, argument.dtype) for argument in call.arguments]
    columns = call.attributes["columns"].copy()
    columns[-1] = 11
    with pytest.raises(jax.errors.JaxRuntimeError, match="a column does not exist"):
        call._replace(attributes=call.attributes | {"columns": columns}).compile()(*arguments)


@pytest.mark.parametrize("kind", ["edge", "lane"])
def test_runs_beyond_the_longest_are_cut_as_by_xla(kind):
    """A set whose cells have more segments than the longest run that it names, or lie outside of the array."""
    maps = test_roads.Maps(5, 90, 16)
    rng = np.random.default_rng(1)
    bank = test_roads.random_bank(maps, 40, rng)[0]
    poses = test_roads.poses_near(bank, 8, rng)
    start = np.sort(rng.integers(0, 3 * 90, (40, 26)), axis=1).astype(np.int16)
    bank = replace(bank, **{f"grid_{kind}": jnp.asarray(start)})
    actual, expected = test_roads.native(bank, poses), test_roads.by_xla(bank, poses)
    differs = test_roads.values(actual), test_roads.values(expected)
    share = np.mean([test_roads.differs(differs[0][name], differs[1][name]) for name in differs[1]])
    assert share <= 0.002


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
