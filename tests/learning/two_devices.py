"""What two devices exchange, and resuming on them, in a process that simulates two: run by ``test_devices.py``."""

import math
import re
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from several_devices import problem

from drivax.learning.algorithms.optimisers import in_chunks
from drivax.learning.algorithms.ppo import _dividing_devices, _read_shares, minibatch_order
from drivax.learning.program import (
    _AXIS,
    Program,
    Seeds,
    compute_on_each_device,
    map_over_devices,
    read_columns,
    shard_axis,
    sum_over_devices,
)
from drivax.tracking.checkpoints import Checkpoints

TYPES = (jnp.float32, jnp.bfloat16, jnp.uint32, jnp.int8)
#: Most exchanges per update of each algorithm, however many parameters there are.
EXCHANGES = {"ppo": 1, "bc": 3, "driving_cql": 2, "sac": 2}
MESH = jax.sharding.Mesh(np.array(jax.devices()), (_AXIS,))


def on_two(function, *values):
    with jax.set_mesh(MESH):
        return jax.jit(function)(*values)


def same(one, other):
    assert one.dtype == other.dtype and one.shape == other.shape, (one, other)
    if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
        one, other = jax.random.key_data(one), jax.random.key_data(other)
    assert np.asarray(one).tobytes() == np.asarray(other).tobytes(), (one, other)


def at(ring, row, column):
    return jax.tree.map(lambda leaf: leaf[row, column], ring)


def check_columns():
    """Columns of every type, a number of columns that devices cannot divide, and types that are read directly."""
    row, column = jnp.array([[0, 1], [2, 2]]), jnp.array([[0, 3], [1, 2]])
    bits = np.random.default_rng(0).integers(0, 256, (3, 4, 5, 8), np.uint8)
    ring = {str(jnp.dtype(t)): jnp.asarray(bits.view(jnp.dtype(t))) for t in TYPES}
    ring |= {"bool": jnp.asarray(bits[..., 0] > 99), "flat": jnp.arange(12.0).reshape(3, 4)}
    jax.tree.map(same, on_two(partial(read_columns, at), ring, row, column), at(ring, row, column))
    for ring in (jnp.arange(15).reshape(3, 5), jax.random.split(jax.random.key(0), (3, 4))):
        same(on_two(partial(read_columns, at), ring, row, column), ring[row, column])
    with jax.enable_x64(True):
        ring = jnp.asarray(bits.view(np.float64))
        same(on_two(partial(read_columns, at), ring, row, column), ring[row, column])


def check_sums():
    """Sums and maxima over devices are those of one device; NaN on any of them stays."""

    def total(weight, x):
        return {"largest_x": x.max(), "mean": x.sum() / 4}, {"weighted": weight * x.sum()}

    for values in (
        [1.0, 2.0, np.nan, 3.0],
        [np.nan, 2.0, 1.0, 3.0],
        [-1.0, -2.0, -3.0, -4.0],
        [1.0, 2.0, 4.0],
    ):
        x, weight = jnp.array(values), jnp.array(3.0)
        jax.tree.map(same, on_two(partial(sum_over_devices, total, axis=0), weight, x), total(weight, x))

    def loss(weight, x):
        return sum_over_devices(total, weight, x, axis=0)[1]["weighted"]

    same(on_two(jax.grad(loss), jnp.array(3.0), jnp.arange(4.0)), jnp.array(6.0))


def check_shares():
    """Devices compute the rows of their share if shares are equal, else all rows."""

    def rows(offset, x):
        return x + offset, jnp.full(1, len(x))

    for count, counts in ((6, [3, 3]), (5, [5])):
        result, sizes = on_two(partial(map_over_devices, rows), jnp.array(1), jnp.arange(count))
        same(result, 1 + jnp.arange(count))
        assert sizes.tolist() == counts, sizes
        assert int(on_two(partial(compute_on_each_device, jnp.sum), jnp.arange(count))) == sum(range(count))


def check_chunks():
    """Each half of a batch stays on its device, whatever the size of the batch."""
    for count, shape in ((256, (2, 128)), (96, (1, 96)), (7, (1, 7))):
        chunks = on_two(in_chunks, jnp.arange(count))
        assert chunks.shape == shape and sorted(np.asarray(chunks).ravel()) == list(range(count)), chunks
        if count % 2 == 0:
            assert ((chunks < count // 2) == (jnp.arange(shape[1]) < shape[1] // 2)).all(), chunks


def check_minibatches():
    """Devices read the same samples from their own environments, or from all if these cannot be divided."""
    for time, environments, minibatches, devices in ((4, 64, 2, 2), (3, 4, 4, 1)):
        shape, key = (time, environments), jax.random.key(0)
        batch = {"log_prob": jnp.arange(time * environments).reshape(shape)}

        def read(batch, key, shape=shape, minibatches=minibatches, devices=devices):
            assert _dividing_devices(shape, minibatches) == devices
            order = minibatch_order(key, shape, minibatches, devices)
            return order, _read_shares(shard_axis(batch, axis=1), order, devices)["log_prob"]

        order, samples = on_two(read, batch, key)
        same(samples, order)


def exchanges(program):
    """Sizes of the arrays that each exchange of an update has, in the computation that exchanges the gradient."""
    parameters = ravel_pytree(program.initial_state().parameters)[0].size
    for computation in re.split(r"\n(?=\S)", program.compiled.as_text()):
        results = re.findall(r"= (.*) all-(?:reduce|gather)\(", computation)
        shapes = [re.findall(r"\w\[([\d,]*)\]", result) for result in results]
        sizes = [[math.prod(map(int, filter(None, shape.split(",")))) for shape in one] for one in shapes]
        if max(map(sum, sizes), default=0) >= parameters:
            return sizes
    raise AssertionError("no exchange of a gradient")


def check_training(name):
    """An update exchanges one vector; restored from disk, a run logs what it logs without an interruption."""
    learner, data = problem(name)
    program = Program(Seeds(learner, (3,)), data, 2)
    sizes = exchanges(program)
    assert sum(map(len, sizes)) <= EXCHANGES[name], sizes
    state, rows = program.initial_state(), []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(4):
            state, logs, _ = program.step(state)
            rows.append(jax.device_get(logs))
            if number == 1:
                Checkpoints(Path(folder)).save(2, state)
        template = program.seeds.member_shapes(program.shapes)
        resumed = program.state_of([Checkpoints(Path(folder)).restore(template)])
    for number in (2, 3):
        resumed, logs, _ = program.step(resumed)
        jax.tree.map(same, jax.device_get(logs), rows[number])
    jax.tree.map(same, state.parameters, resumed.parameters)


def main(name):
    if name == "functions":
        check_columns()
        check_sums()
        check_shares()
        check_chunks()
        check_minibatches()
    else:
        check_training(name)
    print("same")


if __name__ == "__main__":
    main(*sys.argv[1:])
