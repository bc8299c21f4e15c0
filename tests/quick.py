"""Programs that run once, and modules whose parameters are drawn without one."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx


def quick(function, *arguments):
    """The function's result, compiled, as NumPy arrays."""
    return jax.device_get(jax.jit(function)(*arguments))


def drawn(make):
    """Structure of a module, and parameters drawn by NumPy: scales around one, the rest around zero, none exactly."""
    graph, empty = nnx.split(nnx.eval_shape(make))
    rng = np.random.default_rng(1)

    def draw(path, leaf):
        noise = 0.5 * rng.normal(size=leaf.shape)
        return jnp.asarray(noise + ("scale" in jax.tree_util.keystr(path)), jnp.float32)

    return graph, jax.tree_util.tree_map_with_path(draw, empty)
