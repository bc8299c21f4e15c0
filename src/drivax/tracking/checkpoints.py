"""Checkpoints of complete training states, restored bit for bit.

Orbax stores the arrays. ``about.json`` contains name, dtype, shape and CRC-32 of every leaf, so that errors name the
leaf that is damaged or does not match. Checkpoint folders appear only when they are complete. Exported policies are
single files without training state (:func:`pack`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DataError
from drivax.files import atomic_write, replace_folder, write_text
from drivax.reading import read_arrays

ABOUT = "about.json"
#: Former names of fields of training states, in checkpoints of version 0.1.0.
_RENAMED_FIELDS = {"scene": "context", "scenes": "contexts"}
_ARRAYS = "arrays"
_CURE = "use the configuration that the checkpoint was trained with"
_SCALARS: tuple[type, ...] = (bool, int, float)

State = TypeVar("State")


class Checkpoints:
    """Checkpoints of one run in sub-folders ``step-000001000``: the newest ``keep``, and the best by score."""

    def __init__(self, folder: str | Path, keep: int = 2, keep_best: bool = True) -> None:
        if keep < 1:
            raise ValueError("keep at least one checkpoint")
        self.folder, self.keep, self.keep_best = Path(folder), keep, keep_best

    def steps(self) -> list[int]:
        """Return the steps of all complete checkpoints, ascending."""
        names = (path.name.removeprefix("step-") for path in self.folder.glob("step-*") if path.is_dir())
        return sorted(int(name) for name in names if name.isdecimal())

    def best(self) -> int | None:
        """Return the step with the highest score, the latest if several are equal; None without scores."""
        scores = [(self.about(step)["score"], step) for step in self.steps()]
        candidates = [(tuple(np.atleast_1d(score)), step) for score, step in scores if score is not None]
        return max(candidates)[1] if candidates else None

    def best_or_newest(self) -> int | None:
        """Return the best step, or without scores the newest; None without checkpoints."""
        best = self.best()
        return max(self.steps(), default=None) if best is None else best

    def about(self, step: int) -> dict[str, Any]:
        """Return ``step``, ``score`` (None without one) and ``leaves`` of a checkpoint, the content of ``about.json``.

        Leaves have their current names.

        Raises:
            DataError: The checkpoint is missing or damaged.
        """
        file = self._path(step) / ABOUT
        if not file.is_file():
            cure = f"available steps: {', '.join(map(str, self.steps())) or 'none'}"
            raise DataError(f"no checkpoint of step {step}", file=self.folder, cure=cure)
        try:
            about = json.loads(file.read_bytes())
            for leaf in about.get("leaves", ()):
                leaf["name"] = _current_name(leaf["name"])
            return about
        except ValueError as error:
            raise DataError(f"is damaged ({error})", file=file, cure="use another checkpoint") from error

    def save(self, step: int, state: Any, score: float | Sequence[float] | None = None) -> Path:
        """Store a pytree of numbers and JAX or NumPy arrays, delete superseded checkpoints, and return the folder.

        Higher scores are better; sequences are compared lexicographically. A NaN score counts as no score.
        """
        arrays, leaves = _describe(state)
        score = None if score is None or np.isnan(score).any() else np.asarray(score, float).tolist()
        final = self._path(step)
        about = json.dumps({"step": step, "score": score, "leaves": leaves}, indent=1)
        size_bytes = len(about) + sum(array.nbytes for array in arrays.values())
        with replace_folder(final, size_bytes) as partial:
            if arrays:
                _save_arrays(partial / _ARRAYS, arrays)
            write_text(partial / ABOUT, about)
        self._delete_superseded()
        return final

    def drop_after(self, step: int) -> None:
        """Delete the checkpoints of later steps, which belong to an interrupted run."""
        for other in self.steps():
            if other > step:
                self._delete(other)

    def restore(self, template: State, step: int | None = None, part: str = "") -> State:
        """Return the stored state, or a part of it (for example ``.parameters``).

        ``template`` is a pytree with the structure and shapes of the state; ``step`` defaults to the newest
        checkpoint.

        Raises:
            DataError: The checkpoint is missing or damaged, or a leaf does not match the template.
        """
        return self.restore_parts({part: template}, step)[part]

    def restore_parts(
        self, templates: Mapping[str, State], step: int | None = None, cure: str = _CURE
    ) -> dict[str, State]:
        """Return several parts of a stored state by their paths, as :meth:`restore` does.

        Raises:
            DataError: As in :meth:`restore`; leaves that do not match suggest ``cure``.
        """
        if step is None:
            step = max(self.steps(), default=None)
        if step is None:
            raise DataError(
                "no checkpoint found", file=self.folder, cure="start the training again, without --resume"
            )
        stored_leaves, path = self.about(step)["leaves"], self._path(step)
        requested_leaves = [
            (part + name, leaf)
            for part, template in templates.items()
            for name, leaf in _named_leaves(template)
        ]
        part_leaves = [leaf for leaf in stored_leaves if is_part(leaf["name"], templates)]
        _compare(path, part_leaves, requested_leaves, cure)
        names = [leaf["name"] for leaf in stored_leaves]
        arrays = dict(zip(names, _load_arrays(path, stored_leaves), strict=True))
        values = iter([_rebuild(arrays[name], leaf) for name, leaf in requested_leaves])
        return {part: jax.tree.map(lambda _: next(values), template) for part, template in templates.items()}

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:09d}"

    def _delete_superseded(self) -> None:
        steps = self.steps()
        current = {*steps[-self.keep :], *([self.best()] if self.keep_best else [])}
        for step in steps:
            if step not in current:
                self._delete(step)

    def _delete(self, step: int) -> None:
        # Rename it first, so that a partially deleted folder does not look like a checkpoint.
        hidden_folder = self.folder / f".step-{step}.old-{os.getpid()}"
        self._path(step).rename(hidden_folder)
        shutil.rmtree(hidden_folder, ignore_errors=True)


def is_part(leaf: str, parts: Iterable[str]) -> bool:
    """Return whether a leaf belongs to one of the parts of a state, all by name (``.critics`` not to ``.critic``)."""
    # A part ends where the leaf does, or before an attribute or index.
    return any(leaf.startswith(part) and (leaf + ".")[len(part)] in ".[" for part in parts)


def _current_name(leaf: str) -> str:
    """Return the name of a leaf, with the current names of renamed fields."""
    return re.sub(r"\.(\w+)", lambda field: f".{_RENAMED_FIELDS.get(field[1], field[1])}", leaf)


def pack(file: Path, tree: Any) -> None:
    """Write a pytree of arrays atomically to an ``.npz`` file, which NumPy alone can read."""
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree)}
    with atomic_write(file, sum(array.nbytes for array in arrays.values())) as out:
        np.savez(out, **arrays)


def unpack(file: Path, template: State) -> State:
    """Return the pytree that :func:`pack` wrote, given a template with its structure and shapes.

    Raises:
        DataError: The file is damaged or does not match the template.
    """
    requested_leaves = _named_leaves(template)
    # Every array has a header and an entry in the archive's directory.
    most = sum(leaf.size * leaf.dtype.itemsize + 4096 for _, leaf in requested_leaves) + 4096
    arrays = read_arrays(file, "use another copy", 2 * most)
    stored_leaves = [
        {"name": name, "type": str(array.dtype), "shape": array.shape} for name, array in arrays.items()
    ]
    _compare(file, stored_leaves, requested_leaves, _CURE)
    return jax.tree.unflatten(
        jax.tree.structure(template), [jnp.asarray(arrays[name]) for name, _ in requested_leaves]
    )


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def _describe(state: Any) -> tuple[dict[str, np.ndarray[Any, Any]], list[dict[str, Any]]]:
    """Return the non-empty arrays by number (Orbax refuses empty ones), and descriptions of all leaves."""
    arrays, leaves = {}, []
    for number, (name, leaf) in enumerate(_named_leaves(state)):
        array = np.asarray(_to_numpy(leaf), order="C")
        # A key is stored as an array of other type and shape.
        array_type, crc = [str(array.dtype), list(array.shape)], zlib.crc32(array.tobytes())
        shape = list(np.shape(leaf))
        leaves.append(
            {"name": name, "type": _type_name(leaf), "shape": shape, "stored": array_type, "crc": crc}
        )
        if array.size:
            arrays[f"{number:05d}"] = array
    return arrays, leaves


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_numpy(leaf: Any) -> np.ndarray[Any, Any]:
    """Return a leaf as an array; that of a key holds its data."""
    array = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
    if array.dtype == object or array.dtype.kind in "US":
        raise TypeError(f"a {type(leaf).__name__} cannot be stored in a checkpoint")
    return array


def _type_name(leaf: Any) -> str:
    return type(leaf).__name__ if type(leaf) in _SCALARS else str(leaf.dtype)


def _compare(
    path: Path, stored_leaves: list[dict[str, Any]], requested_leaves: list[tuple[str, Any]], cure: str
) -> None:
    """Check that stored and requested leaves have the same names, types and shapes."""
    stored_types = {leaf["name"]: f"{leaf['type']}{list(leaf['shape'])}" for leaf in stored_leaves}
    requested_types = {name: f"{_type_name(leaf)}{list(np.shape(leaf))}" for name, leaf in requested_leaves}
    for name in [*requested_types, *stored_types]:
        if name not in stored_types:
            raise DataError(f"the checkpoint has no {name}", file=path, cure=cure)
        if name not in requested_types:
            raise DataError(f"the checkpoint contains {name}, which the template lacks", file=path, cure=cure)
        if stored_types[name] != requested_types[name]:
            problem = f"{name} is {stored_types[name]} in the checkpoint, not {requested_types[name]}"
            raise DataError(problem, file=path, cure=cure)


def _save_arrays(path: Path, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.resolve(), arrays)


def _load_arrays(path: Path, leaves: list[dict[str, Any]]) -> list[np.ndarray[Any, Any]]:
    """Read the arrays of all leaves, and verify their checksums."""
    import orbax.checkpoint as ocp

    templates = [np.zeros(tuple(leaf["stored"][1]), jnp.dtype(leaf["stored"][0])) for leaf in leaves]
    nonempty = {f"{number:05d}": array for number, array in enumerate(templates) if array.size}
    restored_arrays: dict[str, Any] = {}
    if nonempty:
        try:
            with ocp.StandardCheckpointer() as checkpointer:
                restored_arrays = checkpointer.restore((path / _ARRAYS).resolve(), nonempty)
        except Exception as error:
            problem = f"arrays cannot be read ({error})"
            raise DataError(problem, file=path, cure="use another checkpoint") from error
    arrays = [
        np.asarray(restored_arrays.get(f"{number:05d}", array)) for number, array in enumerate(templates)
    ]
    for array, leaf in zip(arrays, leaves, strict=True):
        if zlib.crc32(array.tobytes()) != leaf["crc"]:
            raise DataError(f"checksum mismatch in {leaf['name']}", file=path, cure="use another checkpoint")
    return arrays


def _rebuild(array: np.ndarray[Any, Any], template: Any) -> Any:
    """Return a stored array as a leaf of the template's type: number, key, or NumPy or JAX array."""
    if type(template) in _SCALARS:
        return type(template)(array)
    if _is_key(template):
        # The dtype ("key<fry>") names the implementation, also for a ShapeDtypeStruct.
        return jax.random.wrap_key_data(jnp.asarray(array), impl=template.dtype._impl.name)
    if isinstance(template, np.ndarray | np.generic):
        return array[()] if isinstance(template, np.generic) else array
    return jnp.asarray(array)
