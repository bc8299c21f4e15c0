"""Checks of encoders."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from drivax.networks.encoders import EncoderConfig
from drivax.plugins import find_named
from drivax.testing.contract import CLOSE, check_numbers, expect, program, same
from drivax.testing.worlds import GARBAGE

#: Groups with one and two row axes, with and without masks; the second set has fewer groups, one without rows.
_SPECS = (
    {
        "agents": (4, 2, 3), "agents_mask": (4, 2), "ego": (2, 6), "ego_static": (4,), "route": (5, 5),
        "route_mask": (5,),
    },
    {"ego": (1, 6), "lights": (2, 7), "lights_mask": (2,), "route": (0, 5), "route_mask": (0,)},
)  # fmt: skip
_BATCH = 6
#: Tolerance with ``dtype: bfloat16``, which has eight significant bits.
_COARSE = 5e-2


def check_encoder(config: EncoderConfig | str) -> None:
    """Check an encoder.

    It builds for any groups, including one without rows. It embeds an observation or a batch as ``[..., width]``
    float32, compiled or not. Its parameters follow from the key and are its only state. Values and gradients are
    finite, also with all rows masked. Masked rows have no effect, valid rows do.

    Args:
        config: The encoder's settings, or the dotted name of such a class or instance.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    settings: Any = find_named(config) if isinstance(config, str) else config
    settings = settings() if isinstance(settings, type) else settings
    what = f"encoder {type(settings).__name__}"
    expect(isinstance(settings, EncoderConfig), f"{what} has no build(spec, rngs)", "see EncoderConfig")
    close = _COARSE if getattr(settings, "dtype", "") == "bfloat16" else CLOSE
    for number, spec in enumerate(_SPECS):
        encoder: Any = settings.build(spec, nnx.Rngs(0))
        batch = _observations(spec, number)
        run = program(what, encoder)
        embedding = run(batch)
        width = getattr(encoder, "width", None)
        expect(
            embedding.shape == (_BATCH, width) and embedding.dtype == jnp.float32,
            f"{what} embeds {_BATCH} observations as {embedding.dtype}{list(embedding.shape)} with width {width}",
            "return [*batch, width] float32, and set width",
        )
        check_numbers(what, embedding)
        _check_state(what, settings, spec, encoder)
        _check_rows(what, (encoder if number == 0 else run, run), batch, embedding, close)
        _check_masks(what, run, batch, embedding, close)
        _check_gradients(what, encoder, batch)


def _observations(spec: Any, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    groups: dict[str, Any] = {}
    for name, shape in spec.items():
        if name.endswith("_mask"):
            groups[name] = jnp.asarray(rng.random((_BATCH, *shape)) < 0.6)
        else:
            groups[name] = jnp.asarray(rng.normal(size=(_BATCH, *shape)), jnp.float32)
    return groups


def _check_state(what: str, config: EncoderConfig, spec: Any, encoder: Any) -> None:
    kept, parameters = (jax.tree.leaves(nnx.state(encoder, *only)) for only in ((), (nnx.Param,)))
    expect(
        len(kept) == len(parameters) > 0,
        f"{what} keeps {len(kept) - len(parameters)} variables that are not parameters, of {len(kept)}",
        "keep nnx.Param only: no dropout, no running means",
    )
    again = jax.tree.leaves(nnx.state(config.build(spec, nnx.Rngs(0)), nnx.Param))
    expect(
        same(jax.device_get(parameters), jax.device_get(again), 0.0),
        f"{what} has other initial parameters every time",
        "draw them from rngs",
    )


def _check_rows(what: str, forms: tuple[Any, Any], batch: Any, embedding: Any, close: float) -> None:
    """Check one observation, alone and in a batch of batches of one, compiled and not."""
    single, (encoder, run) = jax.tree.map(lambda leaf: leaf[0], batch), forms
    for result in (encoder(single), run(jax.tree.map(lambda leaf: leaf[None, None], single))[0, 0]):
        expect(
            same(embedding[0], jax.device_get(result), close),
            f"{what} differs in a batch",
            "use the last axes; any axes may lead",
        )
    spread = np.abs(embedding - embedding[:1]).max()
    expect(spread > 0, f"{what} embeds all observations equally", "let it read the groups")


def _check_masks(what: str, run: Any, batch: Any, embedding: Any, close: float) -> None:
    masked = [name for name in batch if f"{name}_mask" in batch]
    scattered, empty = dict(batch), dict(batch)
    for name in masked:
        there = batch[f"{name}_mask"][..., None]
        scattered[name] = jnp.where(there, batch[name], GARBAGE)
        empty[f"{name}_mask"] = jnp.zeros_like(batch[f"{name}_mask"])
    changed = run(scattered)
    expect(
        same(embedding, changed, close),
        f"{what} changes with masked rows",
        "use jnp.where(mask[..., None], rows, 0) first, and mask after each bias",
    )
    check_numbers(f"{what} without rows", run(empty), "a mean or softmax over no rows")


def _check_gradients(what: str, encoder: Any, batch: Any) -> None:
    graph, parameters = nnx.split(encoder)
    empty = {n: jnp.zeros_like(v) if n.endswith("_mask") else v for n, v in batch.items()}

    def loss(parameters: Any, batch: Any) -> Any:
        return jnp.mean(nnx.merge(graph, parameters)(batch) ** 2)

    run = program(what, jax.grad(loss))
    for groups in (batch, empty):
        gradient = run(parameters, groups)
        finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        expect(finite, f"{what} has non-finite gradients", "guard roots and divisions on their input")
