"""Programs that run once: compiled with little optimisation, which is most of the time that they take."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

_OPTIONS = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def quickly(function):
    """The function under ``jit``, compiled that way."""
    return jax.jit(function, compiler_options=_OPTIONS)


def quick(function, *arguments):
    """The function's result, compiled, as NumPy arrays."""
    return jax.device_get(quickly(function)(*arguments))


def drawn(make):
    """Structure of a module, and parameters drawn by NumPy: scales around one, the rest around zero, none exactly."""
    graph, empty = nnx.split(nnx.eval_shape(make))
    rng = np.random.default_rng(1)

    def draw(path, leaf):
        noise = 0.5 * rng.normal(size=leaf.shape)
        return jnp.asarray(noise + ("scale" in jax.tree_util.keystr(path)), jnp.float32)

    return graph, jax.tree_util.tree_map_with_path(draw, empty)
