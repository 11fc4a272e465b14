"""States of parsers and estimators as text, exact to the last bit: a recording may begin in the middle of a run.

A snapshot names classes and attributes and holds no code: restoring one runs no constructor. It fits the code that made
it. Parts that follow from the configuration, such as a calibration, are named and not stored: both sides have them.
"""

import base64
import json
import re
import sys
from collections import Counter, deque
from collections.abc import Collection, Mapping
from enum import Enum
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

# Objects of these rooms have a state. The bank's are large, and follow from the configuration.
_ROOMS = (
    *("shearloop.bank.", "shearloop.estimation.", "shearloop.drivers.", "shearloop.daemon.sensing."),
    # Why a parser has refused its last line.
    "shearloop.errors",
)
_PLAIN = (bool, int, float, str, type(None))
_CONTAINERS = (list, dict, tuple, deque, Counter)
# The key of a value that is not plain JSON.
_KIND = "$"


class SnapshotError(Exception):
    """A state cannot be stored, or a snapshot does not fit this code."""


def snapshot(state: Mapping[str, object], fixed: Mapping[str, object]) -> bytes:
    """Return the state's objects as ASCII text; `fixed` are the parts that follow from the configuration, by name.

    Raises SnapshotError for an object that has no stored form.
    """
    names = {id(part): name for name, part in _parts(fixed).items()}
    return json.dumps(_Encoder(names).value(dict(state))).encode("ascii")


def restored(text: bytes, fixed: Mapping[str, object], like: Mapping[str, object]) -> dict[str, Any]:
    """Return the objects of a snapshot, in place of objects `like` them that have just been made.

    Raises SnapshotError for one that does not fit, also where it lacks an attribute that these objects have: another
    version has written it.
    """
    known = {type(part): _attributes(part).keys() for part in _parts(like).values()}
    try:
        found = _Decoder(_parts(fixed), known).value(json.loads(text))
    # Another version's snapshot, or a spoilt one, raises many types of exceptions.
    except Exception as error:
        raise SnapshotError(f"the state does not fit this version: {error!r}") from error
    if not isinstance(found, dict):
        raise SnapshotError("the state does not fit this version: it is no mapping")
    return found


def _parts(fixed: Mapping[str, object]) -> dict[str, object]:
    """Return the fixed objects and arrays, and all inside them, by their paths."""
    found: dict[str, object] = {}
    seen: set[int] = set()
    waiting = list(fixed.items())
    while waiting:
        path, part = waiting.pop()
        if isinstance(part, _PLAIN) or id(part) in seen:
            continue
        if isinstance(part, np.ndarray) or not isinstance(part, _CONTAINERS):
            found[path] = part
            seen.add(id(part))
        waiting += ((f"{path}.{name}", inside) for name, inside in _inside(part))
    return found


def _inside(part: object) -> list[tuple[str, object]]:
    if isinstance(part, dict):
        return [(str(key), value) for key, value in part.items()]
    if isinstance(part, list | tuple | deque):
        return [(str(number), value) for number, value in enumerate(part)]
    return list(_attributes(part).items()) if type(part).__module__.startswith(_ROOMS) else []


def _attributes(part: object) -> dict[str, object]:
    """Return the attributes that an object has, in its slots or not."""
    slots = [slot for kind in type(part).__mro__ for slot in _slots(kind)]
    names = dict.fromkeys(slot for slot in slots if hasattr(part, slot))
    found = {**{name: getattr(part, name) for name in names}, **getattr(part, "__dict__", {})}
    # `typing` notes the types of a generic class there.
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _slots(kind: type) -> tuple[str, ...]:
    slots = kind.__dict__.get("__slots__", ())
    names = (slots,) if isinstance(slots, str) else tuple(slots)
    return tuple(name for name in names if name not in ("__dict__", "__weakref__"))


class _Encoder:
    """Turns values into JSON; an object that was met before is named by its number, so that it stays one object."""

    def __init__(self, fixed: Mapping[int, str]) -> None:
        self._fixed = fixed
        self._numbers: dict[int, int] = {}
        # Keeps them alive: the number of an object that is gone could be another's.
        self._met: list[object] = []

    def mapping(self, values: Mapping[Any, object]) -> dict[str, Any]:
        return {_KIND: "dict", "items": [[self.value(key), self.value(one)] for key, one in values.items()]}

    def value(self, value: object) -> Any:
        if type(value) in _PLAIN:
            return value
        if (name := self._fixed.get(id(value))) is not None:
            return {_KIND: "fixed", "name": name}
        if (number := self._numbers.get(id(value))) is not None:
            return {_KIND: "met", "number": number}
        if isinstance(value, Enum):
            return {_KIND: "enum", "class": _class_name(type(value)), "name": value.name}
        if isinstance(value, bytes):
            return {_KIND: "bytes", "text": value.decode("latin-1")}
        if isinstance(value, re.Pattern):
            return {_KIND: "pattern", "text": self.value(value.pattern), "flags": value.flags}
        if isinstance(value, tuple):
            return self._tuple(value)
        self._numbers[id(value)] = len(self._met)
        self._met.append(value)
        return self._mutable(value)

    def _tuple(self, value: tuple[object, ...]) -> dict[str, Any]:
        items = [self.value(one) for one in value]
        if type(value) is tuple:
            return {_KIND: "tuple", "items": items}
        return {_KIND: "named tuple", "class": _class_name(type(value)), "items": items}

    def _mutable(self, value: object) -> dict[str, Any]:
        match value:
            case np.ndarray() | np.generic():
                return _encoded_array(value)
            case deque():
                return {_KIND: "deque", "items": [self.value(one) for one in value], "maxlen": value.maxlen}
            case list():
                return {_KIND: "list", "items": [self.value(one) for one in value]}
            case Counter():
                return {**self.mapping(value), _KIND: "counter"}
            case dict():
                return self.mapping(value)
        attributes = {name: self.value(one) for name, one in _attributes(value).items()}
        return {_KIND: "object", "class": _class_name(type(value)), "attributes": attributes}


class _Decoder:
    """Turns JSON into values, in their order."""

    def __init__(self, fixed: Mapping[str, object], known: Mapping[type, Collection[str]]) -> None:
        self._fixed = fixed
        # The attributes that objects of a class begin with.
        self._known = known
        self._met: list[Any] = []

    def value(self, form: Any) -> Any:
        if not isinstance(form, dict):
            return form
        match form[_KIND]:
            case "fixed":
                return self._fixed[form["name"]]
            case "met":
                return self._met[form["number"]]
            case "enum":
                return _class(form)[form["name"]]
            case "bytes":
                return form["text"].encode("latin-1")
            case "pattern":
                return re.compile(self.value(form["text"]), form["flags"])
            case "tuple":
                return tuple(self.value(one) for one in form["items"])
            case "named tuple":
                return _class(form)._make(self.value(one) for one in form["items"])
            case "array":
                return self._meet(_decoded_array(form))
            case "list":
                items = self._meet([])
                items.extend(self.value(one) for one in form["items"])
                return items
            case "deque":
                row = self._meet(deque(maxlen=form["maxlen"]))
                row.extend(self.value(one) for one in form["items"])
                return row
            case "dict" | "counter" as kind:
                found = self._meet(Counter() if kind == "counter" else {})
                found.update({self.value(key): self.value(one) for key, one in form["items"]})
                return found
            case "object":
                return self._object(_class(form), form["attributes"])
            case unknown:
                raise SnapshotError(f"the state has a {unknown!r}")

    def _object(self, kind: Any, attributes: Mapping[str, Any]) -> Any:
        if missing := [name for name in self._known.get(kind, ()) if name not in attributes]:
            raise SnapshotError(f"{kind.__name__} has no {', '.join(missing)}")
        # A pydantic model also needs the values that pydantic keeps outside its attributes.
        is_model = issubclass(kind, BaseModel)
        made = self._meet(kind.model_construct() if is_model else kind.__new__(kind))
        for name, one in attributes.items():
            object.__setattr__(made, name, self.value(one))
        return made

    def _meet(self, value: Any) -> Any:
        self._met.append(value)
        return value


def _encoded_array(value: Any) -> dict[str, Any]:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise SnapshotError(f"an array of {array.dtype} has no stored form")
    # The order of the elements in memory decides the last bit of sums and products.
    order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    data = base64.b64encode(array.tobytes(order)).decode("ascii")
    scalar = isinstance(value, np.generic)
    return {
        _KIND: "array",
        "dtype": array.dtype.str,
        "shape": array.shape,
        "order": order,
        "scalar": scalar,
        "data": data,
    }


def _decoded_array(form: Mapping[str, Any]) -> Any:
    flat = np.frombuffer(base64.b64decode(form["data"]), np.dtype(form["dtype"]))
    array = flat.reshape(form["shape"], order=form["order"]).copy(order=form["order"])
    return array[()] if form["scalar"] else array


def _class_name(kind: type) -> str:
    if not kind.__module__.startswith(_ROOMS) or "<" in kind.__qualname__:
        raise SnapshotError(f"{kind.__module__}.{kind.__qualname__} has no stored form")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(form: Mapping[str, Any]) -> Any:
    """Return a class of this program that is already imported."""
    module, _, name = str(form["class"]).partition(":")
    if not module.startswith(_ROOMS):
        raise SnapshotError(f"the state has a {form['class']!r}")
    found: Any = sys.modules[module]
    for part in name.split("."):
        found = vars(found)[part]
    if not isinstance(found, type):
        raise SnapshotError(f"the state has a {form['class']!r}, which is no class")
    return found
