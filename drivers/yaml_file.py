"""Reading a YAML file, in which every key is given once."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from shearloop.drivers.errors import DriverError


class _UniqueKeyLoader(yaml.SafeLoader):
    """A SafeLoader that refuses a key given twice, where YAML would silently take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key `{key}` is given twice", key_node.start_mark
                )
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Return what a YAML file holds; DriverError, naming the file, for one that is missing, empty or not YAML."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise DriverError(f"{path}: the configuration cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DriverError(f"{path}: the configuration is not UTF-8 text (byte {error.start})") from error
    try:
        content = yaml.load(text, _UniqueKeyLoader)  # noqa: S506 - it is a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise DriverError(f"{path}: {where}{error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise DriverError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise DriverError(f"{path}: the configuration is nested too deeply") from error
    if content is None:
        raise DriverError(f"{path}: the configuration is empty")
    return content
