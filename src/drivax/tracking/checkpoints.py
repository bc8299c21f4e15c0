"""Checkpoints of complete training states, restored bit for bit.

Orbax stores the arrays. ``about.json`` contains name, dtype, shape and CRC-32 of every leaf, so that errors name the
leaf that does not match, and the CRC-32 of each file and of itself, so that damage is found before Orbax reads it.
Checkpoint folders appear only when they are complete and on disk. Exported policies are single files without training
state (:func:`pack`).
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import resource
import sys
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DataError
from drivax.files import atomic_write, format_bytes, inside, remove, replace_folder, sync_folder, write_text
from drivax.reading import ArrayType, check_regular, check_size, explain_damage, read_arrays, read_json
from drivax.seal import check_seal

ABOUT = "about.json"
#: Former names of fields of training states, in checkpoints of version 0.1.0.
_RENAMED_FIELDS = {"scene": "context", "scenes": "contexts"}
_ARRAYS = "arrays"
_RETRAIN = "use another checkpoint, or train again"
_CHUNK_BYTES = 1 << 24
#: Largest file of a checkpoint: bytes for each number in its arrays (a key has several words), and for all else.
_MOST_ITEM_BYTES, _MOST_OTHER_BYTES = 32, 1 << 24
_CURE = "use the configuration that the checkpoint was trained with"
_SCALARS: tuple[type, ...] = (bool, int, float)

State = TypeVar("State")


class Checkpoints:
    """Checkpoints of a run in sub-folders ``step-000001000``: the newest ``keep``, and with ``keep_best`` the best."""

    def __init__(self, folder: str | Path, keep: int = 2, keep_best: bool = True) -> None:
        if keep < 1:
            raise ValueError("keep at least one checkpoint")
        self.folder, self.keep, self.keep_best = Path(folder), keep, keep_best

    def steps(self) -> list[int]:
        """Return the steps of all complete checkpoints, ascending."""
        names = (
            path.name.removeprefix("step-") for path in self.folder.glob("step-*") if _is_real_folder(path)
        )
        return sorted(int(name) for name in names if name.isdecimal() and name == f"{int(name):09d}")

    def best(self) -> int | None:
        """Return the step with the highest score, the latest if several are equal; None without scores.

        Raises:
            DataError: A checkpoint is damaged.
        """
        return _best({step: self.about(step)["score"] for step in self.steps()})

    def best_or_newest(self) -> int | None:
        """Return the best step, or without scores the newest; None without checkpoints."""
        best = self.best()
        return max(self.steps(), default=None) if best is None else best

    def about(self, step: int) -> dict[str, Any]:
        """Return the content of ``about.json`` of a checkpoint.

        It has ``step``, ``score`` (None without one), ``leaves`` with their current names, and ``files`` with their
        checksums (absent in checkpoints of former versions).

        Raises:
            DataError: The checkpoint is missing, damaged or edited.
        """
        path, available = self._path(step), ", ".join(map(str, self.steps()))
        if not path.is_dir():
            cure = f"available steps: {available or 'none'}"
            raise DataError(f"no checkpoint of step {step}", file=self.folder, cure=cure)
        about = read_json(path / ABOUT, _RETRAIN)
        with explain_damage(path / ABOUT, _RETRAIN):
            crc = about.pop("crc", None)
            if (crc is not None or "files" in about) and crc != _checksum(about):
                raise ValueError("checksum mismatch")
            if about["step"] != step:
                raise ValueError(f"it is of step {about['step']}")
            _check_types(about)
            for leaf in about["leaves"]:
                leaf["name"] = _current_name(leaf["name"])
        return about

    def save(self, step: int, state: Any, score: float | Sequence[float] | None = None) -> Path:
        """Write a checkpoint as :meth:`write` does, and delete superseded ones."""
        path = self.write(step, state, score)
        self.delete_superseded()
        return path

    def write(self, step: int, state: Any, score: float | Sequence[float] | None = None) -> Path:
        """Store a pytree of numbers and JAX or NumPy arrays, and return its folder once it is on disk.

        Higher scores are better; sequences are compared lexicographically. A score with a NaN counts as none.
        """
        arrays, leaves = _describe(state)
        score = None if score is None or np.isnan(score).any() else np.asarray(score, float).tolist()
        folder = self._path(step)
        size_bytes = sum(array.nbytes for array in arrays.values())
        with replace_folder(folder, size_bytes) as partial:
            if arrays:
                _save_arrays(partial / _ARRAYS, arrays)
            about = {"step": step, "score": score, "leaves": leaves, "files": _sync(partial)}
            write_text(partial / ABOUT, json.dumps({**about, "crc": _checksum(about)}, indent=1))
        sync_folder(self.folder.parent)
        return folder

    def delete_superseded(self) -> None:
        """Delete all but the checkpoints to keep; a damaged checkpoint counts as one without a score."""
        steps, scores = self.steps(), dict[int, Any]()
        for step in steps:
            with contextlib.suppress(DataError):
                scores[step] = self.about(step)["score"]
        kept_steps = {*steps[-self.keep :], *([_best(scores)] if self.keep_best else [])}
        for step in steps:
            if step not in kept_steps:
                self._delete(step)

    def drop_after(self, step: int) -> None:
        """Delete what an interrupted run left: checkpoints after ``step`` and hidden folders; delete links, too."""
        for other in self.steps():
            if other > step:
                self._delete(other)
        links = filter(Path.is_symlink, self.folder.glob("step-*"))
        for leftover in (*self.folder.glob(".step-*"), *links):
            remove(leftover)

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
            cure = "start the training again, with --overwrite and without --resume"
            raise DataError("no checkpoint found", file=self.folder, cure=cure)
        about, path = self.about(step), self._path(step)
        stored_leaves = about["leaves"]
        requested_leaves = [
            (part + name, leaf)
            for part, template in templates.items()
            for name, leaf in _named_leaves(template)
        ]
        part_leaves = [leaf for leaf in stored_leaves if is_part(leaf["name"], templates)]
        _compare(path, part_leaves, requested_leaves, cure)
        most = _MOST_ITEM_BYTES * sum(math.prod(leaf["shape"]) for leaf in stored_leaves) + _MOST_OTHER_BYTES
        _check_files(path, about.get("files", {}), most)
        arrays = _load_arrays(path, stored_leaves, dict(requested_leaves))
        values = iter([_rebuild(arrays[name], leaf) for name, leaf in requested_leaves])
        return {part: jax.tree.map(lambda _: next(values), template) for part, template in templates.items()}

    def _path(self, step: int) -> Path:
        return self.folder / f"step-{step:09d}"

    def _delete(self, step: int) -> None:
        # Rename it first, so that a partially deleted folder does not look like a checkpoint.
        hidden_folder = self.folder / f".step-{step}.old-{os.getpid()}"
        remove(hidden_folder)
        self._path(step).rename(hidden_folder)
        remove(hidden_folder)


def _is_real_folder(path: Path) -> bool:
    """Return whether a path is a folder, not a link by which an untrusted run could write or delete anywhere."""
    return path.is_dir() and not path.is_symlink()


def _best(scores: Mapping[int, Any]) -> int | None:
    """Return the step with the highest score, the latest if several are equal; None without scores."""
    ranked = [(tuple(np.atleast_1d(score)), step) for step, score in scores.items() if score is not None]
    return max(ranked)[1] if ranked else None


def is_part(leaf: str, parts: Iterable[str]) -> bool:
    """Return whether the name of a leaf lies in one of the parts of a state (``.critics`` not in ``.critic``)."""
    # A part ends where the leaf does, or before an attribute or index.
    return any(leaf.startswith(part) and (leaf + ".")[len(part)] in ".[" for part in parts)


def _current_name(leaf: str) -> str:
    """Return the name of a leaf with the current names of renamed fields."""
    return re.sub(r"\.(\w+)", lambda field: f".{_RENAMED_FIELDS.get(field[1], field[1])}", leaf)


def _checksum(about: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(about, sort_keys=True).encode())


def _sync(folder: Path) -> dict[str, int]:
    """Flush the contents of a folder to disk, and return the CRC-32 of each file by its relative path."""
    checksums = {}
    for path in sorted(folder.rglob("*")):
        if path.is_dir():
            sync_folder(path)
            continue
        with path.open("rb") as file:
            checksums[path.relative_to(folder).as_posix()] = _file_crc(file)
            os.fsync(file.fileno())
    return checksums


def _file_crc(file: IO[bytes]) -> int:
    crc = 0
    while chunk := file.read(_CHUNK_BYTES):
        crc = zlib.crc32(chunk, crc)
    return crc


def _check_types(about: Mapping[str, Any]) -> None:
    """Raise ValueError if ``about.json`` has other types than :meth:`Checkpoints.write` writes."""
    score, files = about["score"], about.get("files", {})
    scores = score if isinstance(score, list) else [score or 0.0]
    if not all(isinstance(number, int | float) for number in scores) or not isinstance(files, dict):
        raise ValueError("scores or files of other types")
    for leaf in about["leaves"]:
        types = {name: type(leaf[name]) for name in ("name", "type", "shape", "crc")}
        is_shape = all(type(size) is int and size >= 0 for size in leaf["shape"])
        if types != {"name": str, "type": str, "shape": list, "crc": int} or not is_shape:
            raise ValueError("a leaf of other types")


def _check_files(path: Path, checksums: Mapping[str, int], most: int) -> None:
    """Raise DataError for the first file of a checkpoint that is missing, damaged, a link, or not a regular file.

    Files of more than ``most`` bytes are refused unread, because their checksums might take forever.
    """
    entries = {entry.relative_to(path): entry for entry in sorted(path.rglob("*"))}
    for name in entries:
        inside(path, *name.parts)
    files = {name.as_posix(): entry for name, entry in entries.items() if not entry.is_dir()}
    for file in files.values():
        check_regular(file, _RETRAIN)
    for name, expected in checksums.items():
        with explain_damage(path / name, _RETRAIN):
            if name not in files:  # An untrusted checkpoint may name files outside.
                raise FileNotFoundError
            check_size(files[name], _RETRAIN, most)
            with files[name].open("rb") as file:
                crc = _file_crc(file)
            if crc != expected:
                raise ValueError("checksum mismatch")


def pack(file: Path, tree: Any) -> None:
    """Write a pytree of arrays atomically to an ``.npz`` file, which can be read with NumPy alone."""
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree)}
    with atomic_write(file, sum(array.nbytes for array in arrays.values())) as out:
        np.savez_compressed(out, **arrays)


def unpack(file: Path, template: State) -> State:
    """Return the pytree that :func:`pack` wrote, given a template with its structure and shapes.

    Raises:
        DataError: The file is damaged, edited, or does not match the template.
    """
    check_seal(file)
    requested_leaves = _named_leaves(template)
    # Every array has a header and an entry in the archive's directory.
    most = _check_size(file, [leaf for _, leaf in requested_leaves]) + 4096 * (len(requested_leaves) + 1)

    def check(types: Mapping[str, ArrayType]) -> None:
        stored_leaves = [
            {"name": name, "type": str(dtype), "shape": shape} for name, (shape, dtype) in types.items()
        ]
        _compare(file, stored_leaves, requested_leaves, _CURE)

    arrays = read_arrays(file, "use another copy", most, check)
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
        # A random key is stored as an array of another type and shape.
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
    """Return a leaf as an array; for a random key, its data."""
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

    with _silence_writers(), ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(path.resolve(), arrays)


@contextlib.contextmanager
def _silence_writers() -> Iterator[None]:
    """Only raise the first error of a write: Orbax and asyncio also log it, and TensorStore prints each array's.

    After an error, they stay silenced: their threads fail later, and their tasks are deleted at any time.
    """
    loggers, report_hook = [logging.getLogger(name) for name in ("absl", "asyncio")], sys.unraisablehook

    def is_other(record: logging.LogRecord) -> bool:
        return record.levelno < logging.ERROR or "orbax" not in f"{record.pathname} {record.getMessage()}"

    def report_other(unraisable: sys.UnraisableHookArgs) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            report_hook(unraisable)

    for logger in loggers:
        logger.addFilter(is_other)
    sys.unraisablehook = report_other
    yield
    for logger in loggers:
        logger.removeFilter(is_other)
    if sys.unraisablehook is report_other:
        sys.unraisablehook = report_hook


def _load_arrays(
    path: Path, leaves: list[dict[str, Any]], templates: Mapping[str, Any]
) -> dict[str, np.ndarray[Any, Any]]:
    """Read the arrays of the template's leaves by name, and verify their checksums.

    Memory depends only on the template, since an untrusted checkpoint may state any size.
    """
    import orbax.checkpoint as ocp

    _check_size(path, templates.values())
    numbers = {leaf["name"]: f"{number:05d}" for number, leaf in enumerate(leaves)}
    arrays = {name: np.zeros(*_stored_type(leaf)) for name, leaf in templates.items()}
    nonempty = {numbers[name]: array for name, array in arrays.items() if array.size}
    restored_arrays: dict[str, Any] = {}
    try:
        if nonempty:
            folder, types = (path / _ARRAYS).resolve(), ocp.checkpoint_utils.construct_restore_args(nonempty)
            with ocp.PyTreeCheckpointer() as checkpointer:
                _check_shapes(checkpointer.metadata(folder).item_metadata.tree, nonempty)
                request = ocp.args.PyTreeRestore(nonempty, types, partial_restore=True)
                restored_arrays = checkpointer.restore(folder, args=request)
    except Exception as error:
        raise DataError(f"arrays cannot be read ({error})", file=path, cure=_RETRAIN) from error
    arrays = {name: np.asarray(restored_arrays.get(numbers[name], array)) for name, array in arrays.items()}
    for leaf in leaves:
        if (name := leaf["name"]) in arrays and zlib.crc32(arrays[name].tobytes()) != leaf["crc"]:
            raise DataError(f"checksum mismatch in {name}", file=path, cure=_RETRAIN)
    return arrays


def _stored_type(leaf: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type in which a leaf is stored."""
    if _is_key(leaf):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    return np.shape(leaf), np.dtype(getattr(leaf, "dtype", type(leaf)))


def _check_size(path: Path, leaves: Iterable[Any]) -> int:
    """Return the bytes of leaves; raise DataError if the memory of this machine or process cannot hold them."""
    size = sum(math.prod(shape) * dtype.itemsize for shape, dtype in map(_stored_type, leaves))
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    memory = memory if limit == resource.RLIM_INFINITY else min(memory, limit)
    if size > memory:
        problem = f"states {format_bytes(size)} of arrays, more than the {format_bytes(memory)} of memory"
        raise DataError(problem, file=path, cure="use another checkpoint, or a machine with more memory")
    return size


def _check_shapes(stored_arrays: Mapping[str, Any], arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Raise ValueError for the first array that is stored in another shape or in chunks that are larger than it."""
    for number, array in arrays.items():
        stored_array = stored_arrays[number]
        if tuple(stored_array.shape) != array.shape:
            raise ValueError(f"array {number} has shape {stored_array.shape}, not {array.shape}")
        if math.prod(stored_array.storage.chunk_shape) > array.size:
            raise ValueError(
                f"array {number} has {array.size} values, but chunks of {stored_array.storage.chunk_shape}"
            )


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
