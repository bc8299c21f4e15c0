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

#: Groups with one and two axes of rows, with and without masks; the second set lacks some, and one has no rows.
_SPECS = (
    {
        "agents": (4, 2, 3), "agents_mask": (4, 2), "ego": (2, 6), "ego_static": (4,), "route": (5, 5),
        "route_mask": (5,),
    },
    {"ego": (1, 6), "lights": (2, 7), "lights_mask": (2,), "route": (0, 5), "route_mask": (0,)},
)  # fmt: skip
_BATCH = 6
#: How far results may lie apart where settings say ``dtype: bfloat16``, which has eight significant bits.
_COARSE = 5e-2


def check_encoder(config: EncoderConfig | str) -> None:
    """Whether an encoder keeps to the rules.

    It builds for any groups, one without rows among them; embeds one observation or a batch as ``[..., width]``
    float32, the same compiled or not; its parameters follow from the key and are all that it keeps; values and
    gradients are finite, also where every row is masked; what masked rows hold does not matter, and what the others
    hold does. What is alike is compared more coarsely where the settings have ``dtype`` bfloat16.

    Args:
        config: The encoder's settings, or the dotted name of such a class or instance.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    found: Any = find_named(config) if isinstance(config, str) else config
    found = found() if isinstance(found, type) else found
    what = f"encoder {type(found).__name__}"
    expect(isinstance(found, EncoderConfig), f"{what} has no build(spec, rngs)", "see EncoderConfig")
    close = _COARSE if getattr(found, "dtype", "") == "bfloat16" else CLOSE
    for number, spec in enumerate(_SPECS):
        encoder: Any = found.build(spec, nnx.Rngs(0))
        batch = _observations(spec, number)
        run = program(what, encoder)
        embedding = run(batch)
        width = getattr(encoder, "width", None)
        expect(
            embedding.shape == (_BATCH, width) and embedding.dtype == jnp.float32,
            f"{what} embeds {_BATCH} observations as {embedding.dtype}{list(embedding.shape)}, its width being {width}",
            "give [*batch, width] float32, and say width",
        )
        check_numbers(what, embedding)
        _check_state(what, found, spec, encoder)
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
        f"{what} keeps {len(kept) - len(parameters)} variables that are no parameters, of {len(kept)}",
        "keep nnx.Param only: no dropout, no running means",
    )
    again = jax.tree.leaves(nnx.state(config.build(spec, nnx.Rngs(0)), nnx.Param))
    expect(
        same(jax.device_get(parameters), jax.device_get(again), 0.0),
        f"{what} begins with other parameters every time",
        "draw them from rngs",
    )


def _check_rows(what: str, forms: tuple[Any, Any], batch: Any, embedding: Any, close: float) -> None:
    """One observation in either form of the encoder, as it is and compiled: alone, and in a batch of batches of one."""
    one, (encoder, run) = jax.tree.map(lambda leaf: leaf[0], batch), forms
    for result in (encoder(one), run(jax.tree.map(lambda leaf: leaf[None, None], one))[0, 0]):
        expect(
            same(embedding[0], jax.device_get(result), close),
            f"{what} embeds an observation differently alone and in a batch",
            "work on the last axes, whatever axes lead",
        )
    spread = np.abs(embedding - embedding[:1]).max()
    expect(spread > 0, f"{what} embeds all observations alike", "let it read the groups")


def _check_masks(what: str, run: Any, batch: Any, embedding: Any, close: float) -> None:
    masked = [name for name in batch if f"{name}_mask" in batch]
    littered, nobody = dict(batch), dict(batch)
    for name in masked:
        there = batch[f"{name}_mask"][..., None]
        littered[name] = jnp.where(there, batch[name], GARBAGE)
        nobody[f"{name}_mask"] = jnp.zeros_like(batch[f"{name}_mask"])
    other = run(littered)
    expect(
        same(embedding, other, close),
        f"{what} changes with what masked rows hold",
        "use jnp.where(mask[..., None], rows, 0) first, and mask after every bias",
    )
    check_numbers(f"{what} without any row", run(nobody), "a mean or softmax over no rows")


def _check_gradients(what: str, encoder: Any, batch: Any) -> None:
    graph, parameters = nnx.split(encoder)
    nobody = {n: jnp.zeros_like(v) if n.endswith("_mask") else v for n, v in batch.items()}

    def loss(parameters: Any, batch: Any) -> Any:
        return jnp.mean(nnx.merge(graph, parameters)(batch) ** 2)

    run = program(what, jax.grad(loss))
    for groups in (batch, nobody):
        gradient = run(parameters, groups)
        finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        expect(
            finite, f"{what} has gradients that are not finite", "guard roots and divisions on their input"
        )
