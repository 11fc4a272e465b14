"""Public faces of packages. A name is imported at its first use, so that the command line answers at once."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def importer(package: str, names: dict[str, Any], homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's `__getattr__`; `names` are its globals, `homes` the `module:name` of each public name."""

    def import_name(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, attribute = homes[name].partition(":")
        value = names[name] = getattr(importlib.import_module(module), attribute)
        return value

    return import_name
