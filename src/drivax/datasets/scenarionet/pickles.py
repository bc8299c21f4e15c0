"""Pickles read as data: numbers, texts, containers and NumPy arrays; whatever else one names is refused.

Python's own unpickler runs what a pickle asks for. Refusing names (``Unpickler.find_class``) is not enough: its memo
grows to whatever index a damaged file holds, arrays are allocated before their data is seen, and deeply nested keys
overflow the stack of the interpreter. So the operations, split by the standard library's disassembler, are carried
out here, those that build data only, each checked against what the file really holds.
"""

from __future__ import annotations

import math
import pickletools
import re
from collections.abc import Callable, Sized
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivax.errors import DataError

#: More than this is no recorded scenario (real ones take 0.6 to 10 MB).
MOST_BYTES = 64 << 20
MOST_OPERATIONS = 4_000_000
MOST_AXES = 4
_DAMAGED = "copy or generate the file again"
_TYPE_CODE = re.compile(r"[<>|=]?([biu]1|[iu][248]|f[248]|[SU]\d{1,4}|O8?)")
#: Modules by their name today: Python 2 and NumPy before 2.0 used others.
_MODULES = {"__builtin__": "builtins", "numpy.core.multiarray": "numpy._core.multiarray",
            "numpy.core.numeric": "numpy._core.numeric"}  # fmt: skip


def load(data: bytes) -> Any:
    """The content of a pickle of any protocol that holds data only.

    Arrays are views of the file's bytes (those of booleans as uint8), arrays of objects with one axis become lists,
    NumPy scalars Python numbers, and ordered or default dictionaries plain ones.
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
        raise DataError(f"is a damaged pickle ({_one_line(error)})", cure=_DAMAGED) from error
    return result


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:100] or type(error).__name__


@dataclass(frozen=True)
class _Global:
    """Something that a pickle names."""

    name: str


@dataclass
class _Unbuilt:
    """An array or array type of which a later operation brings the rest, and where it was noted until then."""

    finish: Callable[[Any], Any]
    places: list[int] = field(default_factory=list)


def _global(module: str, name: str) -> _Global:
    full = f"{_MODULES.get(module, module)}.{name}"
    if full not in _NAMED and full not in _CALLED:
        raise DataError(
            f"names {full[:100]}, which is no data",
            cure="do not open this file with pickle: it could run anything",
        )
    return _Global(full)


class _Machine:
    """A stack, a memo and the operations of pickles that build data."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._below: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._called_with = 0

    def run(self, name: str, argument: Any) -> None:
        """Carry out one operation."""
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _FRESH:
            self.stack.append(_FRESH[name]())
        elif name in _SKIPPED:
            return
        elif name in _OPERATIONS:
            _OPERATIONS[name](self, argument)
        else:
            raise DataError(
                f"uses the pickle operation {name}, which data does not need",
                cure="do not open this file with pickle: it could run anything",
            )

    def _mark(self, argument: Any) -> None:
        self._below.append(self.stack)
        self.stack = []

    def _from_mark(self) -> list[Any]:
        items, self.stack = self.stack, self._below.pop()
        return items

    def _pop_mark(self, argument: Any) -> None:
        self._from_mark()

    def _pop(self, argument: Any) -> None:
        # On an empty stack POP removes the mark below it.
        if self.stack:
            self.stack.pop()
        else:
            self._from_mark()

    def _duplicate(self, argument: Any) -> None:
        self.stack.append(self.stack[-1])

    def _put(self, index: Any) -> None:
        place = len(self._memo) if index is None else index
        self._memo[place] = top = self.stack[-1]
        if isinstance(top, _Unbuilt):
            top.places.append(place)

    def _get(self, index: Any) -> None:
        self.stack.append(self._memo[index])

    def _last(self, count: int) -> tuple[Any, ...]:
        if len(self.stack) < count:
            raise IndexError("the stack is empty")
        items = tuple(self.stack[-count:])
        del self.stack[-count:]
        return items

    def _tuple(self, argument: Any) -> None:
        items = tuple(self._from_mark())
        self.stack.append(items)

    def _tuple_1(self, argument: Any) -> None:
        self.stack.append(self._last(1))

    def _tuple_2(self, argument: Any) -> None:
        self.stack.append(self._last(2))

    def _tuple_3(self, argument: Any) -> None:
        self.stack.append(self._last(3))

    def _list(self, argument: Any) -> None:
        items = self._from_mark()
        self.stack.append(items)

    def _dictionary(self, argument: Any) -> None:
        items = self._from_mark()
        self.stack.append({})
        self._set(items)

    def _frozen_set(self, argument: Any) -> None:
        items = self._from_mark()
        self.stack.append(frozenset(map(_key, items)))

    def _append(self, argument: Any) -> None:
        (item,) = self._last(1)
        self._top(list).append(item)

    def _appends(self, argument: Any) -> None:
        items = self._from_mark()
        self._top(list).extend(items)

    def _set_item(self, argument: Any) -> None:
        self._set(self._last(2))

    def _set_items(self, argument: Any) -> None:
        self._set(self._from_mark())

    def _set(self, items: Any) -> None:
        container = self._top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            container[_key(key)] = value

    def _add_items(self, argument: Any) -> None:
        items = self._from_mark()
        self._top(set).update(map(_key, items))

    def _top(self, kind: type[Any]) -> Any:
        if type(self.stack[-1]) is not kind:
            raise ValueError(f"a {kind.__name__} was expected")
        return self.stack[-1]

    def _name(self, argument: str) -> None:
        module, _, name = argument.partition(" ")
        self.stack.append(_global(module, name))

    def _name_from_stack(self, argument: Any) -> None:
        module, name = self._last(2)
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("a name that is no text")
        self.stack.append(_global(module, name))

    def _call(self, argument: Any) -> None:
        named, arguments = self._last(2)
        make = _CALLED.get(named.name) if isinstance(named, _Global) else None
        if make is None or not isinstance(arguments, tuple):
            raise ValueError("a call of something else than a constructor")
        # Calls copy what they are given, and the memo can give them the same thing again and again.
        self._called_with += sum(len(part) for part in arguments if isinstance(part, Sized))
        if self._called_with > MOST_BYTES:
            raise ValueError("calls with more than the file holds")
        try:
            self.stack.append(make(*arguments))
        except (TypeError, AttributeError) as error:
            raise ValueError(f"odd arguments for {named.name}") from error

    def _build(self, argument: Any) -> None:
        (state,) = self._last(1)
        unbuilt = self.stack[-1]
        if not isinstance(unbuilt, _Unbuilt):
            raise ValueError("a state for something that has none")
        self.stack[-1] = built = unbuilt.finish(state)
        for place in unbuilt.places:
            self._memo[place] = built


_OPERATIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine._mark, "POP": _Machine._pop, "POP_MARK": _Machine._pop_mark, "DUP": _Machine._duplicate,
    "PUT": _Machine._put, "BINPUT": _Machine._put, "LONG_BINPUT": _Machine._put, "MEMOIZE": _Machine._put,
    "GET": _Machine._get, "BINGET": _Machine._get, "LONG_BINGET": _Machine._get,
    "TUPLE": _Machine._tuple, "TUPLE1": _Machine._tuple_1, "TUPLE2": _Machine._tuple_2,
    "TUPLE3": _Machine._tuple_3, "LIST": _Machine._list, "DICT": _Machine._dictionary,
    "FROZENSET": _Machine._frozen_set, "APPEND": _Machine._append, "APPENDS": _Machine._appends,
    "SETITEM": _Machine._set_item, "SETITEMS": _Machine._set_items, "ADDITEMS": _Machine._add_items,
    "GLOBAL": _Machine._name, "STACK_GLOBAL": _Machine._name_from_stack, "REDUCE": _Machine._call,
    "BUILD": _Machine._build,
}  # fmt: skip
_LITERALS = frozenset((
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES",
    "BINBYTES8", "BYTEARRAY8",
))  # fmt: skip
_FRESH: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False, "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict, "EMPTY_SET": set,
}  # fmt: skip
_SKIPPED = frozenset(("PROTO", "FRAME", "STOP"))


def _key(key: Any) -> Any:
    """A key or a member of a set: a plain value, or a flat tuple of them. Hashing deep tuples ends the process."""
    plain = (str, int, float, bytes, type(None))
    if isinstance(key, plain) or (type(key) is tuple and all(isinstance(part, plain) for part in key)):
        return key
    raise ValueError(f"a key of type {type(key).__name__}")


def _items(items: Any = ()) -> list[Any]:
    if not isinstance(items, list | tuple | set | frozenset):
        raise ValueError("a container of something else than items")
    return list(items)


def _new_dictionary(*arguments: Any) -> dict[Any, Any]:
    """Of an ordered dictionary, or of a default dictionary, whose first argument makes defaults."""
    pairs = [argument for argument in arguments if not isinstance(argument, _Global) and argument is not None]
    return {_key(key): value for items in pairs for key, value in _items(items)}


def _encoded(text: Any, encoding: Any = "latin1") -> bytes:
    """How protocols up to 2 hold bytes."""
    if not isinstance(text, str):
        raise ValueError("bytes of something else")
    return text.encode("latin1")


def _type(code: Any, align: Any = False, copy: Any = False) -> _Unbuilt:
    """An array type; the order of its bytes follows with its state."""
    plain = _checked_type(code)

    def finish(state: Any) -> np.dtype[Any]:
        if (
            not isinstance(state, tuple)
            or state[2:5] != (None, None, None)
            or state[1] not in ("<", ">", "|", "=")
        ):
            raise ValueError("an array type with fields")
        return plain.newbyteorder(state[1])

    return _Unbuilt(finish)


def _checked_type(code: Any) -> np.dtype[Any]:
    if not isinstance(code, str) or not _TYPE_CODE.fullmatch(code):
        raise ValueError(f"arrays of type {code[:20]!r}" if isinstance(code, str) else "arrays of no type")
    return np.dtype(code)


def _empty_array(kind: Any, shape: Any, code: Any) -> _Unbuilt:
    """An array whose shape, type and content follow with its state."""

    def finish(state: Any) -> Any:
        if not isinstance(state, tuple) or len(state) != 5:
            raise ValueError("an array without content")
        _, shape, dtype, fortran, content = state
        return _array(content, dtype, shape, "F" if fortran else "C")

    return _Unbuilt(finish)


def _array(content: Any, dtype: Any, shape: Any, order: Any = "C") -> Any:
    """An array over bytes that are there, so that no shape can ask for more memory than the file has."""
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple) or len(shape) > MOST_AXES:
        raise ValueError("an array of odd shape or type")
    if any(type(size) is not int or not 0 <= size <= MOST_BYTES for size in shape):
        raise ValueError("an array of odd shape")
    count = math.prod(shape)
    if dtype.kind == "O":
        if len(shape) != 1 or not isinstance(content, list) or len(content) != count:
            raise ValueError("an array of objects with several axes, or of another length than it says")
        return content
    if not isinstance(content, bytes | bytearray) or len(content) != count * dtype.itemsize:
        raise ValueError("an array of another length than it says")
    if count == 0:
        return np.zeros(shape, dtype)
    # A damaged boolean may be neither 0 nor 1, which NumPy does not expect.
    flat = np.frombuffer(content, np.uint8 if dtype.kind == "b" else dtype)
    return flat.reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: Any, content: Any = b"") -> Any:
    """A NumPy scalar as a Python value."""
    array = _array(content, dtype, (1,))
    value = array[0] if isinstance(array, list) else array[0].item()
    return bool(value) if dtype.kind == "b" else value


#: What a pickle may name without calling it.
_NAMED = frozenset((
    "numpy.ndarray", "builtins.int", "builtins.long", "builtins.float", "builtins.str", "builtins.unicode",
    "builtins.bool", "builtins.list", "builtins.dict", "builtins.tuple",
))  # fmt: skip
#: What a pickle may call, and what is done instead.
_CALLED: dict[str, Callable[..., Any]] = {
    "numpy._core.multiarray._reconstruct": _empty_array,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _array,
    "numpy.dtype": _type,
    "collections.defaultdict": _new_dictionary,
    "collections.OrderedDict": _new_dictionary,
    "builtins.set": lambda items=(): {_key(item) for item in _items(items)},
    "builtins.frozenset": lambda items=(): frozenset(_key(item) for item in _items(items)),
    "builtins.bytearray": lambda content=b"", encoding="latin1": bytes(_content(content)),
    "builtins.bytes": lambda content=b"": _content(content),
    "_codecs.encode": _encoded,
}


def _content(content: Any) -> bytes:
    """The bytes of a bytes-like value; an integer, which would allocate that many, is refused."""
    if isinstance(content, str):
        return _encoded(content)
    if not isinstance(content, bytes | bytearray):
        raise ValueError("bytes of something else")
    return bytes(content)
