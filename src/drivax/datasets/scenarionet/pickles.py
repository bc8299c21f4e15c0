"""Pickles read as data, without running code: numbers, texts, containers and NumPy arrays; and checks of their values.

Refusing names (``Unpickler.find_class``) is not enough: the memo of Python's unpickler grows to any index in the file,
arrays are allocated before their data is read, and deeply nested keys overflow the stack. So the operations, split by
the standard library's disassembler, are carried out here, each checked against the size of the file.
"""

from __future__ import annotations

import contextlib
import math
import pickletools
import re
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivax.errors import DataError

Array = np.ndarray[Any, Any]

SKIP = "skip this file, or generate it again"
#: Maximum number of rows of a value, and of numbers in a map.
MOST_NUMBERS = 4_000_000
_NUMBER = (int, float)
#: Recorded scenarios have 0.6 to 10 MB.
MOST_BYTES = 64 << 20
MOST_OPERATIONS = 4_000_000
MOST_AXES = 4
#: Types of keys, and limits of integer keys and of parts of tuple keys: beyond them many could have the same hash.
_PLAIN = (str, int, float, bytes, type(None))
_LARGEST_KEY, _MOST_PARTS = 1 << 60, 4
_DAMAGED = "copy or generate the file again"
_DISTRUST = "do not open this file with pickle: it could run anything"
_TYPE_CODE = re.compile(r"[<>|=]?([biu]1|[iu][248]|f[248]|[SU]\d{1,4}|O8?)")
#: Present names of modules of Python 2 and of NumPy before 2.0, by their old name.
_MODULES = {"__builtin__": "builtins", "numpy.core.multiarray": "numpy._core.multiarray",
            "numpy.core.numeric": "numpy._core.numeric"}  # fmt: skip


def load(data: bytes) -> Any:
    """Return the content of a pickle of any protocol that holds data only.

    Arrays are views of the file's bytes (those of booleans as uint8); arrays of objects with one axis become lists,
    NumPy scalars Python numbers, ordered and default dictionaries plain ones.

    Raises:
        DataError: The pickle is damaged, too large, or names anything but data.
    """
    if len(data) > MOST_BYTES:
        raise DataError(f"a pickle of {len(data) >> 20} MB", cure=f"drivax reads up to {MOST_BYTES >> 20} MB")
    machine = _Machine()
    try:
        for number, (operation, argument, _) in enumerate(pickletools.genops(data)):
            if number > MOST_OPERATIONS:
                raise DataError("a pickle of too many parts", cure=_DAMAGED)
            machine.run(operation.name, argument)
        (result,) = machine.stack
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise DataError(f"is a damaged pickle ({reason})", cure=_DAMAGED) from error
    return result


@dataclass(frozen=True)
class _Global:
    """A function or class that a pickle names: its module and name."""

    name: str


@dataclass
class _Unbuilt:
    """An array or array type whose state follows in a later operation, and its indices in the memo."""

    finish: Callable[[Any], Any]
    indices: list[int] = field(default_factory=list)


class _Machine:
    """A stack, a memo and the operations of pickles that build data."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        #: Stacks below the marks: each mark begins a new stack.
        self._below: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._argument_size = 0

    def run(self, name: str, argument: Any) -> None:
        """Carry out one operation."""
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _MAKE_OPERATIONS:
            count, make = _MAKE_OPERATIONS[name]
            items = self._take(count)
            self.stack.append(make(items))
        elif name in _ADD_OPERATIONS:
            count, kind, add = _ADD_OPERATIONS[name]
            items = self._take(count)
            if type(self.stack[-1]) is not kind:
                raise ValueError(f"a {kind.__name__} was expected")
            add(self.stack[-1], items)
        elif name in _OPERATIONS:
            _OPERATIONS[name](self, argument)
        elif name not in _SKIPPED_OPERATIONS:
            problem = f"uses the pickle operation {name}, which data does not need"
            raise DataError(problem, cure=_DISTRUST)

    def _take(self, count: int | None) -> list[Any]:
        """Remove and return the last items of the stack; all above the mark if ``count`` is None."""
        if count is None:
            items, self.stack = self.stack, self._below.pop()
            return items
        if len(self.stack) < count:
            raise IndexError("the stack is empty")
        items = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return items

    def _mark(self, argument: Any) -> None:
        """MARK: begin a sequence of items."""
        self._below.append(self.stack)
        self.stack = []

    def _pop(self, argument: Any) -> None:
        """POP: drop the last item."""
        self._take(1 if self.stack else None)  # on an empty stack POP removes the mark below it

    def _put(self, index: Any) -> None:
        """PUT and MEMOIZE: store the last item in the memo, at the next index if none is given."""
        index = len(self._memo) if index is None else index
        self._memo[index] = top = self.stack[-1]
        if isinstance(top, _Unbuilt):
            top.indices.append(index)

    def _global(self, argument: str | None) -> None:
        """GLOBAL and STACK_GLOBAL: push a name, which must be that of a constructor of data."""
        module, name = self._take(2) if argument is None else argument.partition(" ")[::2]
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("a name that is not text")
        path = f"{_MODULES.get(module, module)}.{name}"
        if path not in _NAMES and path not in _FUNCTIONS:
            raise DataError(f"names {path[:100]}, which is not data", cure=_DISTRUST)
        self.stack.append(_Global(path))

    def _call(self, argument: Any) -> None:
        """REDUCE: call a constructor."""
        function, arguments = self._take(2)
        make = _FUNCTIONS.get(function.name) if isinstance(function, _Global) else None
        if make is None or not isinstance(arguments, tuple):
            raise ValueError("a call of an object that is not a constructor")
        # Calls copy their arguments, and the memo can repeat the same argument: bound what all calls copy.
        self._argument_size += sum(len(part) for part in arguments if isinstance(part, Sized))
        if self._argument_size > MOST_BYTES:
            raise ValueError("calls with more than the file contains")
        try:
            self.stack.append(make(*arguments))
        except (TypeError, AttributeError) as error:
            raise ValueError(f"invalid arguments for {function.name}") from error

    def _build(self, argument: Any) -> None:
        """BUILD: finish an array or array type with its state, on the stack and in the memo."""
        (state,) = self._take(1)
        unbuilt = self.stack[-1]
        if not isinstance(unbuilt, _Unbuilt):
            raise ValueError("a state for an object that has none")
        self.stack[-1] = result = unbuilt.finish(state)
        for index in unbuilt.indices:
            self._memo[index] = result


def _fill(container: dict[Any, Any], items: Sequence[Any]) -> dict[Any, Any]:
    """Add alternating keys and values to a dictionary."""
    container.update((_check_key(key), value) for key, value in zip(items[::2], items[1::2], strict=True))
    return container


_LITERALS = frozenset((
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES",
    "BINBYTES8", "BYTEARRAY8",
))  # fmt: skip
#: Operations that make a value from the last N items, or (None) from those above the mark.
_MAKE_OPERATIONS: dict[str, tuple[int | None, Callable[[list[Any]], Any]]] = {
    "NONE": (0, lambda items: None), "NEWTRUE": (0, lambda items: True), "NEWFALSE": (0, lambda items: False),
    "EMPTY_LIST": (0, list), "EMPTY_TUPLE": (0, tuple), "EMPTY_DICT": (0, dict), "EMPTY_SET": (0, set),
    "TUPLE1": (1, tuple), "TUPLE2": (2, tuple), "TUPLE3": (3, tuple), "TUPLE": (None, tuple), "LIST": (None, list),
    "DICT": (None, lambda items: _fill({}, items)),
    "FROZENSET": (None, lambda items: frozenset(map(_check_key, items))),
}  # fmt: skip
#: Operations that add items to a container of a type.
_ADD_OPERATIONS: dict[str, tuple[int | None, type[Any], Callable[[Any, list[Any]], Any]]] = {
    "APPEND": (1, list, list.extend), "APPENDS": (None, list, list.extend),
    "SETITEM": (2, dict, _fill), "SETITEMS": (None, dict, _fill),
    "ADDITEMS": (None, set, lambda members, items: members.update(map(_check_key, items))),
}  # fmt: skip
_OPERATIONS: dict[str, Callable[[_Machine, Any], Any]] = {
    "MARK": _Machine._mark, "POP": _Machine._pop, "POP_MARK": lambda machine, _: machine._take(None),
    "DUP": lambda machine, _: machine.stack.append(machine.stack[-1]),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine._put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda self, index: self.stack.append(self._memo[index])),
    "GLOBAL": _Machine._global, "STACK_GLOBAL": _Machine._global, "REDUCE": _Machine._call, "BUILD": _Machine._build,
}  # fmt: skip
_SKIPPED_OPERATIONS = frozenset(("PROTO", "FRAME", "STOP"))


def _check_key(key: Any) -> Any:
    """Check a key or a member of a set, which must be a plain value or a short flat tuple of them; return it.

    Hashing deep tuples ends the process. Keys of one hash take quadratic time: large integers, tuples of many parts
    or of floats.
    """
    if type(key) is str:
        return key
    is_flat = type(key) is tuple and len(key) <= _MOST_PARTS and float not in map(type, key)
    for part in key if is_flat else (key,):
        if not isinstance(part, _PLAIN) or (isinstance(part, int) and abs(part) >= _LARGEST_KEY):
            raise ValueError(f"a key of type {type(key).__name__}, or one too large")
    return key


def _members(items: Any = ()) -> list[Any]:
    """Return the items of a container."""
    if not isinstance(items, list | tuple | set | frozenset):
        raise ValueError("a container of an object without items")
    return list(items)


def _new_dictionary(*arguments: Any) -> dict[Any, Any]:
    """Return a plain dictionary for an ordered or a default one, whose factory (the first argument) is dropped."""
    pairs = [argument for argument in arguments if not isinstance(argument, _Global) and argument is not None]
    return {_check_key(key): value for items in pairs for key, value in _members(items)}


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """Return bytes, which protocols up to 2 store as a text in Latin-1."""
    if not isinstance(text, str):
        raise ValueError("bytes of an object that is not text")
    return text.encode("latin1")


def _array_type(code: Any, align: Any = False, copy: Any = False) -> _Unbuilt:
    """Return an unfinished array type, from arguments of ``numpy.dtype``; the state adds the byte order."""
    if not isinstance(code, str) or not _TYPE_CODE.fullmatch(code):
        raise ValueError(f"arrays of type {code[:20]!r}" if isinstance(code, str) else "arrays of no type")
    dtype = np.dtype(code)

    def finish(state: Any) -> np.dtype[Any]:
        """Apply the byte order of the state; refuse fields, shapes and metadata."""
        is_plain = isinstance(state, tuple) and state[2:5] == (None, None, None)
        if not is_plain or state[1] not in ("<", ">", "|", "="):
            raise ValueError("an array type with fields")
        return dtype.newbyteorder(state[1])

    return _Unbuilt(finish)


def _empty_array(kind: Any, shape: Any, code: Any) -> _Unbuilt:
    """Return an unfinished array; the state adds shape, type and content."""

    def finish(state: Any) -> Any:
        """Build the array from its state: version, shape, type, order and content."""
        if not isinstance(state, tuple) or len(state) != 5:
            raise ValueError("an array without content")
        _, shape, dtype, fortran, content = state
        return _array(content, dtype, shape, "F" if fortran else "C")

    return _Unbuilt(finish)


def _array(content: Any, dtype: Any, shape: Any, order: Any = "C") -> Any:
    """Return a list of objects, or an array over bytes of the file: no shape can ask for more memory than it has."""
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple) or len(shape) > MOST_AXES:
        raise ValueError("an array of invalid shape or type")
    if any(type(size) is not int or not 0 <= size <= MOST_BYTES for size in shape):
        raise ValueError("an array of invalid shape")
    count = math.prod(shape)
    if dtype.kind == "O":
        if len(shape) != 1 or not isinstance(content, list) or len(content) != count:
            raise ValueError("an array of objects with several axes, or whose length differs from its shape")
        return content
    if not isinstance(content, bytes | bytearray) or len(content) != count * dtype.itemsize:
        raise ValueError("an array whose length differs from its shape")
    if count == 0:
        return np.zeros(shape, dtype)
    # A damaged boolean may be neither 0 nor 1, which NumPy does not expect.
    flat = np.frombuffer(content, np.uint8 if dtype.kind == "b" else dtype)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: Any, content: Any = b"") -> Any:
    """Return a NumPy scalar as a Python value."""
    array = _array(content, dtype, (1,))
    value = array[0] if isinstance(array, list) else array[0].item()
    return bool(value) if dtype.kind == "b" else value


#: Names that may occur uncalled.
_NAMES = frozenset((
    "numpy.ndarray", "builtins.int", "builtins.long", "builtins.float", "builtins.str", "builtins.unicode",
    "builtins.bool", "builtins.list", "builtins.dict", "builtins.tuple",
))  # fmt: skip
#: Constructors that may be called, and their substitutes.
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "numpy._core.multiarray._reconstruct": _empty_array,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _array,
    "numpy.dtype": _array_type,
    "collections.defaultdict": _new_dictionary,
    "collections.OrderedDict": _new_dictionary,
    "builtins.set": lambda items=(): set(map(_check_key, _members(items))),
    "builtins.frozenset": lambda items=(): frozenset(map(_check_key, _members(items))),
    "builtins.bytearray": lambda content=b"", encoding="latin1": _content(content),
    "builtins.bytes": lambda content=b"": _content(content),
    "_codecs.encode": _encode,
}


def _content(content: Any) -> bytes:
    """Return bytes of a bytes-like value or a text in Latin-1; refuse an integer, which would allocate that many."""
    if isinstance(content, str):
        return _encode(content)
    if not isinstance(content, bytes | bytearray):
        raise ValueError("bytes of an object that has none")
    return bytes(content)


def mapping(parent: Any, name: str, what: str = "the file") -> Mapping[Any, Any]:
    """Return the dictionary under a name."""
    value = parent.get(name) if isinstance(parent, dict) else None
    if not isinstance(value, dict):
        raise DataError(f"{what} has no dictionary {name!r}", cure=SKIP)
    return value


def as_text(value: Any) -> str | None:
    """Return a string or an integer as text that can be written as UTF-8; None for anything else."""
    if not isinstance(value, bool) and isinstance(value, str | int):
        with contextlib.suppress(ValueError):  # a lone surrogate, or an integer of thousands of digits
            return str(value).encode().decode()
    return None


def as_int(value: Any) -> int | None:
    """Return a non-negative integer of up to 18 digits, also from a string; None for anything else."""
    text = as_text(value)
    return int(text) if text and text.isascii() and text.isdigit() and len(text) < 19 else None


def as_float(value: Any) -> float | None:
    """Return a number from -1e15 to 1e15; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, _NUMBER) or abs(value) > 1e15 or value != value:
        return None
    return float(value)


def as_list(value: Any) -> Sequence[Any]:
    """Return the items of a list, tuple, set or one-dimensional array; none for anything else."""
    if isinstance(value, np.ndarray):
        return value.tolist() if value.ndim == 1 else []
    return list(value) if isinstance(value, list | tuple | set) else []


def count_rows(value: Any) -> int:
    """Return the number of rows of a list, tuple or array; 0 for anything else."""
    has_rows = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim)
    return len(value) if has_rows else 0


def extent(value: Any) -> int:
    """Return the size of an array or the number of items of a list."""
    return value.size if isinstance(value, np.ndarray) else count_rows(value)


def floats(value: Any, what: str) -> Array:
    """Return numbers, or rows of up to three numbers, as float64 from an array, list or tuple."""
    if count_rows(value) > MOST_NUMBERS:
        raise DataError(f"{what}: {count_rows(value)} rows, more than {MOST_NUMBERS}", cure=SKIP)
    if isinstance(value, np.ndarray):
        narrow = value.ndim == 1 or (value.ndim == 2 and value.shape[1] <= 3)
        if value.dtype.kind in "biuf" and narrow:
            with np.errstate(invalid="ignore"):  # damaged numbers may be signalling NaNs
                return value.astype(np.float64)
    elif isinstance(value, list | tuple):
        try:
            return np.array([_row(row) for row in value], dtype=np.float64)
        except (ValueError, OverflowError, TypeError) as error:
            raise DataError(f"{what} are not rows of numbers", cure=SKIP) from error
    raise DataError(f"{what} are not numbers", cure=SKIP)


def _row(row: Any) -> Any:
    """Return a number, or up to three numbers in a list, tuple or array; refuse anything else."""
    if isinstance(row, _NUMBER):
        return row
    if isinstance(row, np.ndarray) and row.dtype.kind in "biuf" and row.size <= 3:
        return row
    if isinstance(row, list | tuple) and len(row) <= 3 and all(isinstance(part, _NUMBER) for part in row):
        return row
    raise ValueError("not a row of numbers")


class Names:
    """Distinct integers for the names in a file: the names themselves if they are such integers, else their positions.

    Args:
        names: All names, as texts.
        bits: Names of ``2**bits`` or more do not count as integers.
    """

    def __init__(self, names: Sequence[str], bits: int) -> None:
        integers = [n for name in names if (n := as_int(name)) is not None and n < 1 << bits]
        are_ids = len(integers) == len(names) and len(set(integers)) == len(integers)
        numbers = integers if are_ids else range(len(names))
        self._numbers = dict(zip(names, numbers, strict=True))

    def get(self, value: Any) -> int | None:
        """Return the integer of a name; None for one that the file lacks."""
        name = as_text(value)
        return None if name is None else self._numbers.get(name)
