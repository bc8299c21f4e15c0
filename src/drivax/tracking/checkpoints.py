"""Checkpoints of complete training states, restored bit for bit.

Orbax stores the arrays; ``about.json`` has name, dtype, shape and CRC-32 of every leaf, so that errors name the leaf
that does not fit or is damaged. A checkpoint appears under its name only when it is complete. Exported policies are
single files without training state (:func:`pack`).
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DataError
from drivax.files import atomic_write, replace_folder, write_text

ABOUT = "about.json"
#: Fields of training states that checkpoints of version 0.1.0 store under another name.
_RENAMED_FIELDS = {"scene": "context", "scenes": "contexts"}
_ARRAYS = "arrays"
_CURE = "use the configuration that the checkpoint was trained with"
_SCALARS: tuple[type, ...] = (bool, int, float)

State = TypeVar("State")


class Checkpoints:
    """The checkpoints of one run, in sub-folders ``step-000001000``: the newest ``keep``, and the best by score."""

    def __init__(self, folder: str | Path, keep: int = 2, keep_best: bool = True) -> None:
        if keep < 1:
            raise ValueError("keep at least one checkpoint")
        self.folder, self.keep, self.keep_best = Path(folder), keep, keep_best

    def steps(self) -> list[int]:
        """Return the steps of all complete checkpoints, ascending."""
        names = (path.name.removeprefix("step-") for path in self.folder.glob("step-*") if path.is_dir())
        return sorted(int(name) for name in names if name.isdecimal())

    def best(self) -> int | None:
        """Return the step with the highest score, the latest if several tie; None without scores."""
        scores = [(self.about(step)["score"], step) for step in self.steps()]
        scored = [(tuple(np.atleast_1d(score)), step) for score, step in scores if score is not None]
        return max(scored)[1] if scored else None

    def best_or_newest(self) -> int | None:
        """Return the best step, or the newest without scores; None if there is no checkpoint."""
        best = self.best()
        return max(self.steps(), default=None) if best is None else best

    def about(self, step: int) -> dict[str, Any]:
        """Return the step, score and leaves of a checkpoint.

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
                leaf["name"] = _present_name(leaf["name"])
            return about
        except ValueError as error:
            raise DataError(f"is damaged ({error})", file=file, cure="use another checkpoint") from error

    def save(self, step: int, state: Any, score: float | Sequence[float] | None = None) -> Path:
        """Store a pytree of numbers and JAX or NumPy arrays, delete superseded checkpoints, and return the folder.

        Higher scores are better; sequences compare lexicographically. A NaN score counts as none.
        """
        arrays, leaves = _describe(state)
        score = None if score is None or np.isnan(score).any() else np.asarray(score, float).tolist()
        final = self._path(step)
        about = json.dumps({"step": step, "score": score, "leaves": leaves}, indent=1)
        needed = len(about) + sum(array.nbytes for array in arrays.values())
        with replace_folder(final, needed) as partial:
            if arrays:
                _save_arrays(partial / _ARRAYS, arrays)
            write_text(partial / ABOUT, about)
        self._drop()
        return final

    def drop_after(self, step: int) -> None:
        """Delete all checkpoints of later steps, which belong to an interrupted run."""
        for later in self.steps():
            if later > step:
                self._remove(later)

    def restore(self, template: State, step: int | None = None, part: str = "") -> State:
        """Return the stored state, or a part of it (``.parameters``, for example), given such a pytree or its shapes.

        ``step`` None is the newest checkpoint. Raises DataError with the first leaf if the checkpoint is missing,
        damaged, or does not fit the template.
        """
        return self.restore_parts({part: template}, step)[part]

    def restore_parts(
        self, templates: Mapping[str, State], step: int | None = None, cure: str = _CURE
    ) -> dict[str, State]:
        """Return several parts of a stored state by their paths, as :meth:`restore`; ``cure`` if one does not fit."""
        if step is None:
            step = max(self.steps(), default=None)
        if step is None:
            raise DataError("no checkpoint found", file=self.folder, cure="train without --resume")
        stored = self.about(step)["leaves"]
        path = self._path(step)
        requested = {
            part + name: leaf
            for part, template in templates.items()
            for name, leaf in _named_leaves(template)
        }
        numbers = {leaf["name"]: n for n, leaf in enumerate(stored) if is_part(leaf["name"], templates)}
        _compare(path, [stored[number] for number in numbers.values()], list(requested.items()), cure)
        arrays = _load_arrays(path, stored)
        values = iter([_rebuild(arrays[numbers[name]], leaf) for name, leaf in requested.items()])
        return {part: jax.tree.map(lambda _: next(values), template) for part, template in templates.items()}

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:09d}"

    def _drop(self) -> None:
        steps = self.steps()
        kept = {*steps[-self.keep :], *([self.best()] if self.keep_best else [])}
        for step in steps:
            if step not in kept:
                self._remove(step)

    def _remove(self, step: int) -> None:
        # Renamed first: a half-deleted folder must not look like a checkpoint.
        hidden = self.folder / f".step-{step}.old-{os.getpid()}"
        self._path(step).rename(hidden)
        shutil.rmtree(hidden, ignore_errors=True)


def is_part(leaf: str, parts: Iterable[str]) -> bool:
    """Whether the name of a leaf lies within one of these parts of a state (``.critic`` holds no ``.critics``)."""
    return any(leaf.startswith(part) and (leaf + ".")[len(part)] in ".[" for part in parts)


def _present_name(leaf: str) -> str:
    """Return the name of a leaf with the current names of renamed fields."""
    return re.sub(r"\.(\w+)", lambda field: f".{_RENAMED_FIELDS.get(field[1], field[1])}", leaf)


def pack(file: Path, tree: Any) -> None:
    """Write a pytree of arrays to one ``.npz``, by name, atomically; NumPy alone can read it."""
    named: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree)}
    with atomic_write(file, sum(array.nbytes for array in named.values())) as out:
        np.savez(out, **named)


def unpack(file: Path, template: State) -> State:
    """Return what :func:`pack` wrote, given a pytree of the same structure, or its shapes; errors as in restoring."""
    try:
        with zipfile.ZipFile(file) as archive:
            # Read to the end, which is when a zip compares its checksum.
            members = {name: io.BytesIO(archive.read(name)) for name in archive.namelist()}
        arrays = {
            name.removesuffix(".npy"): np.load(member, allow_pickle=False) for name, member in members.items()
        }
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile) as error:
        raise DataError(f"is damaged ({error})", file=file, cure="use another copy") from error
    requested = _named_leaves(template)
    stored = [{"name": n, "type": str(array.dtype), "shape": array.shape} for n, array in arrays.items()]
    _compare(file, stored, requested, _CURE)
    return jax.tree.unflatten(jax.tree.structure(template), [jnp.asarray(arrays[n]) for n, _ in requested])


def _named_leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def _describe(state: Any) -> tuple[dict[str, np.ndarray[Any, Any]], list[dict[str, Any]]]:
    """Return arrays by number, and name, type, shape and checksum of every leaf; Orbax refuses empty arrays."""
    arrays, leaves = {}, []
    for number, (name, leaf) in enumerate(_named_leaves(state)):
        array = np.asarray(_to_numpy(leaf), order="C")
        stored, crc = [str(array.dtype), list(array.shape)], zlib.crc32(array.tobytes())
        shape = list(np.shape(leaf))
        leaves.append({"name": name, "type": _type_name(leaf), "shape": shape, "stored": stored, "crc": crc})
        if array.size:
            arrays[f"{number:05d}"] = array
    return arrays, leaves


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_numpy(leaf: Any) -> np.ndarray[Any, Any]:
    array = np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
    if array.dtype == object or array.dtype.kind in "US":
        raise TypeError(f"a {type(leaf).__name__} cannot be stored in a checkpoint")
    return array


def _type_name(leaf: Any) -> str:
    return type(leaf).__name__ if type(leaf) in _SCALARS else str(leaf.dtype)


def _compare(path: Path, stored: list[dict[str, Any]], requested: list[tuple[str, Any]], cure: str) -> None:
    have = {leaf["name"]: (leaf["type"], tuple(leaf["shape"])) for leaf in stored}
    need = {name: (_type_name(leaf), tuple(np.shape(leaf))) for name, leaf in requested}
    for name in [*need, *have]:
        if name not in have:
            raise DataError(f"the checkpoint has no {name}", file=path, cure=cure)
        if name not in need:
            raise DataError(f"the checkpoint contains {name}, which the template lacks", file=path, cure=cure)
        if have[name] != need[name]:
            stored_as, requested_as = (f"{kind}{list(shape)}" for kind, shape in (have[name], need[name]))
            raise DataError(
                f"{name} is {stored_as} in the checkpoint, not {requested_as}", file=path, cure=cure
            )


def _save_arrays(path: Path, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.resolve(), arrays)


def _load_arrays(path: Path, leaves: list[dict[str, Any]]) -> list[np.ndarray[Any, Any]]:
    import orbax.checkpoint as ocp

    empty = [np.zeros(tuple(leaf["stored"][1]), jnp.dtype(leaf["stored"][0])) for leaf in leaves]
    target = {f"{number:05d}": array for number, array in enumerate(empty) if array.size}
    restored: dict[str, Any] = {}
    if target:
        try:
            with ocp.StandardCheckpointer() as checkpointer:
                restored = checkpointer.restore((path / _ARRAYS).resolve(), target)
        except Exception as error:
            problem = f"arrays cannot be read ({error})"
            raise DataError(problem, file=path, cure="use another checkpoint") from error
    arrays = [np.asarray(restored.get(f"{number:05d}", array)) for number, array in enumerate(empty)]
    for array, leaf in zip(arrays, leaves, strict=True):
        if zlib.crc32(array.tobytes()) != leaf["crc"]:
            raise DataError(f"checksum mismatch in {leaf['name']}", file=path, cure="use another checkpoint")
    return arrays


def _rebuild(array: np.ndarray[Any, Any], like: Any) -> Any:
    if type(like) in _SCALARS:
        return type(like)(array)
    if _is_key(like):
        # "key<fry>": the dtype is all that a ShapeDtypeStruct has.
        return jax.random.wrap_key_data(jnp.asarray(array), impl=like.dtype._impl.name)
    if isinstance(like, np.ndarray | np.generic):
        return array[()] if isinstance(like, np.generic) else array
    return jnp.asarray(array)
