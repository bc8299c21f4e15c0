"""The compiled library, if installed: its stamp, and calls of its kernels through XLA's foreign function interface.

``native/build.py`` runs this file by its path to append the stamp, which says what the library was built for and is
checked before loading: this module needs only JAX, NumPy and the standard library.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import re
import stat
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.ffi
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap, sequential_vmap
from jax.sharding import AxisType, PartitionSpec

#: Major version of XLA's foreign function interface, in its header.
_VERSION = re.compile(r"#define XLA_FFI_API_MAJOR (\d+)")
#: ``make native`` and the wheels for Linux on x86-64 put it here. Loading it runs its code: no variable overrides it.
PATH = Path(__file__).parent / "libdrivax.so"
#: Its sources, in a checkout.
SOURCES = Path(__file__).parents[3] / "native"
#: ``0``: no kernels; ``sse4.2`` or ``avx2``: at most this target; anything else, or not set: the best one.
VARIABLE = "DRIVAX_NATIVE"

#: Whether programs may call kernels. JAX traces and compiles again when it changes.
_allowed = jax.make_user_context(True)


def stamp(sources: Path) -> dict[str, str]:
    """Return platform, major version of XLA's foreign function interface, and hash of the sources if they exist."""
    header = Path(jax.ffi.include_dir(), "xla", "ffi", "api", "c_api.h")
    values = {"platform": sysconfig.get_platform(), "XLA FFI": "".join(_VERSION.findall(header.read_text()))}
    if (sources / "build.py").is_file():
        digest = hashlib.sha256()
        for path in sorted([*sources.glob("*.cc"), *sources.glob("*.h"), sources / "build.py"]):
            if not path.name.startswith("."):  # files of editors
                digest.update(path.read_bytes())
        values["sources"] = digest.hexdigest()[:12]
    return values


def append_stamp(library: bytes, values: dict[str, str]) -> bytes:
    """Return a library with its stamp and, as the last line, the SHA-256 of everything before it."""
    stamped = library + b"\n" + json.dumps(values).encode()
    return stamped + b"\n" + hashlib.sha256(stamped).hexdigest().encode()


def read_stamp(library: bytes) -> dict[str, str] | None:
    """Return the stamp of a library; None if it has none or is incomplete."""
    stamped, _, digest = library.rpartition(b"\n")
    if hashlib.sha256(stamped).hexdigest().encode() != digest:
        return None
    return json.loads(stamped.rpartition(b"\n")[2])


@cache
def _load() -> ctypes.CDLL | str:
    """Load the library and register its kernels; return it, or the reason for not using it."""
    if os.environ.get(VARIABLE) == "0":
        return f"none, since {VARIABLE}=0"
    cure = "make native" if (SOURCES / "build.py").is_file() else "install drivax again"
    if not PATH.exists():
        return f"none: {cure} (on Linux x86-64)"
    try:
        if problem := _access_problem():
            return f"none: {PATH} or its folder {problem}"
        problem = _build_problem()
        return f"none: {PATH} {problem}: {cure}" if problem else _register()
    except (OSError, AttributeError, ValueError, RuntimeError) as error:
        message = str(error).partition("\n")[0]
        return f"none: {PATH} does not load here ({message}): {cure}"


def _access_problem() -> str | None:
    """Return an error with a cure if more users can write the library than the package's own code, else None."""
    own_status = Path(__file__).stat()
    for path in (PATH.resolve(), PATH.resolve().parent, PATH.parent):
        status = path.stat()
        if status.st_mode & ~own_status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return f"is writable by other users: chmod go-w {path}"
        if status.st_uid not in {0, os.getuid(), own_status.st_uid}:
            return f"belongs to another user: chown {os.getuid()} {path}"
    return None


def _build_problem() -> str | None:
    """Return an error if the library, not yet loaded, was not built for this package and machine, else None."""
    if not PATH.is_file():
        return "is not a regular file"
    built = read_stamp(PATH.read_bytes())
    if built is None:
        return "is incomplete, damaged or not a drivax library"
    for name, value in stamp(SOURCES).items():
        if built.get(name) != value:
            return f"was built for {name} {built.get(name)}, this is {value}"
    # Loading a library with sanitizers ends a process without them.
    if "sanitize" in built.get("options", "") and "asan" not in os.environ.get("LD_PRELOAD", ""):
        return "is for tests with sanitizers"
    return None


def _register() -> ctypes.CDLL:
    # Start the backend first: a later start would raise errors of registration, such as of XLA's version, and fail.
    jax.default_backend()
    library = ctypes.CDLL(str(PATH))
    for name in ("drivax_kernels", "drivax_target", "drivax_hash"):
        getattr(library, name).restype = ctypes.c_char_p
    for name in library.drivax_kernels().decode().split():
        function = jax.ffi.pycapsule(getattr(library, f"drivax_{name}"))
        jax.ffi.register_ffi_target(_target_name(library, name), function, platform="cpu")
    return library


def _target_name(library: ctypes.CDLL, kernel: str) -> str:
    """Return a name with the hash of the build, because cached programs outlive builds."""
    return f"drivax_{kernel}_{library.drivax_hash().decode()}"


def state() -> str:
    """Describe the library in use, or the reason for using none, for ``drivax doctor``."""
    library = _load()
    if isinstance(library, str):
        return library
    build = f"{library.drivax_target().decode()}, build {library.drivax_hash().decode()}"
    return build if in_use() else f"none: {build} is for float32 on CPUs"


def in_use() -> bool:
    """Return whether programs that are traced now call native kernels: in float32 on CPUs, if the library loads."""
    is_float32 = jax.dtypes.canonicalize_dtype(float) == jnp.float32
    is_loaded = not isinstance(_load(), str)
    return _allowed.value and is_float32 and is_loaded and jax.default_backend() == "cpu"


def without_kernels() -> contextlib.AbstractContextManager[None]:
    """Trace programs of this thread without native kernels: for other machines, and for comparisons."""
    return _allowed(False)


def with_reference(native: Callable[..., Any], reference: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``native`` with the derivatives of ``reference``, which computes the same values from the same arrays."""
    function = jax.custom_jvp(native)

    @function.defjvp
    def derive(primals: Any, tangents: Any) -> tuple[Any, Any]:
        with without_kernels():
            return jax.jvp(reference, primals, tangents)

    return function


def constants(values: Mapping[str, float]) -> dict[str, Any]:
    """Return attributes of a kernel: booleans, 32-bit integers and floats."""
    types = {bool: bool, int: np.int32, float: np.float32}
    return {
        name: next(types[kind] for kind in types if isinstance(value, kind))(value)
        for name, value in values.items()
    }


def call(
    kernel: str, results: Sequence[jax.ShapeDtypeStruct], common: Sequence[Any], batched: Sequence[Any] = (),
    axes: int = 0, attributes: Mapping[str, Any] | None = None, sums: bool = False,
) -> list[Any]:  # fmt: skip
    """Call a kernel on a batch, or on one sample that ``jax.vmap`` makes a batch.

    Args:
        kernel: Its name.
        results: Shapes of the results of one sample.
        common: Arguments that all samples share, such as weights. A ``vmap`` over them becomes a loop of calls.
        batched: The other arguments; each has the batch's axes first.
        axes: Number of the batch's axes.
        attributes: Constants.
        sums: Whether the results are sums over the batch. Then, too, a ``vmap`` becomes a loop of calls.

    Returns:
        The results, with the batch's axes first unless they are sums. A batch is sharded over the devices of the
        current mesh.
    """
    library = _load()
    assert not isinstance(library, str), "callers ask in_use() first"
    name = _target_name(library, kernel)

    @custom_vmap
    def run(common: Any, batched: Any) -> list[Any]:
        return _shard(run_share, lead(batched), sums)(common, batched)

    def run_share(common: Any, batched: Any) -> list[Any]:
        axes_shape = () if sums else lead(batched)
        shapes = [jax.ShapeDtypeStruct((*axes_shape, *result.shape), result.dtype) for result in results]
        return list(jax.ffi.ffi_call(name, shapes)(*common, *batched, **(attributes or {})))

    def lead(batched: Any) -> tuple[int, ...]:
        return batched[0].shape[:axes] if axes else ()

    @run.def_vmap
    def run_batch(size: int, is_batched: Any, common: Any, batched: Any) -> tuple[list[Any], list[bool]]:
        outputs = [True] * len(results)
        if sums or any(is_batched[0]):
            in_axes = tuple([0 if flag else None for flag in flags] for flags in is_batched)
            return jax.vmap(sequential_vmap(run), in_axes)(common, batched), outputs
        batched = [
            value if is_array_batched else jnp.broadcast_to(value, (size, *value.shape))
            for value, is_array_batched in zip(batched, is_batched[1], strict=True)
        ]
        return call(kernel, results, common, batched, axes + 1, attributes), outputs

    return run(list(common), list(batched))


def _shard(function: Any, lead: tuple[int, ...], sums: bool) -> Any:
    """Shard a batch over the devices of the current mesh, along the first axis that their number divides."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1 or AxisType.Manual in mesh.axis_types:
        return function
    axis = next((number for number, size in enumerate(lead) if size % mesh.size == 0), None)
    if axis is None:
        return function

    def add(*arguments: Any) -> Any:
        return jax.lax.psum(function(*arguments), mesh.axis_names)

    spec = PartitionSpec(*[None] * axis, mesh.axis_names)
    share, out_specs = (add, PartitionSpec()) if sums else (function, spec)
    return jax.shard_map(share, in_specs=(PartitionSpec(), spec), out_specs=out_specs, check_vma=False)
