"""The part of YAML that files may have: bounded, without type tags, and of two equal keys none."""

import re
from collections.abc import Hashable
from typing import Any

import yaml

# Bounds on what a file may cost: its bytes, and its values with every alias written out.
MAX_BYTES, _MAX_VALUES = 1 << 17, 20_000


# Never intended in a key or a value: characters without width, other blanks at an end, typographic quotes around it.
_BLANK = "[\xa0\u1680\u2000-\u200a\u202f\u205f\u3000]"
_MISREAD = re.compile(rf"[\xad\u200b\u2060\ufeff]|^{_BLANK}|{_BLANK}$|^[“”„‟«‘’‚].*[“”‟»‘’]$", re.DOTALL)
MISREAD = "a character looks like another one, or like none"


class Loader(yaml.SafeLoader):
    """A SafeLoader that refuses duplicate keys and type tags, bounds aliases, and knows neither dates nor base 60.

    Of two equal keys YAML would silently keep the last.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        # How many values each node holds, its aliases written out.
        self._sizes: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return the next node, unless it has a type tag or too many values."""
        event: yaml.NodeEvent = self.peek_event()  # type: ignore[no-untyped-call]
        tag = getattr(event, "tag", None)
        if tag not in (None, "!"):
            raise self._refusal(f"the type tag {tag} is not supported", event)
        node = super().compose_node(parent, index)
        if node is None:
            return None
        if isinstance(node, yaml.ScalarNode) and _MISREAD.search(node.value):
            raise self._refusal(MISREAD, event)
        if node not in self._sizes:
            if isinstance(event, yaml.AliasEvent):
                raise self._refusal("an alias stands within its anchor", event)
            pairs = node.value if isinstance(node, yaml.MappingNode) else [node.value]
            inside = [] if isinstance(node, yaml.ScalarNode) else [each for pair in pairs for each in pair]
            self._sizes[node] = 1 + sum(self._sizes[each] for each in inside)
        if self._sizes[node] > _MAX_VALUES:
            raise self._refusal(f"more than {_MAX_VALUES} values, with every alias written out", event)
        return node

    @staticmethod
    def _refusal(problem: str, event: yaml.NodeEvent) -> yaml.MarkedYAMLError:
        mark: Any = event.start_mark  # typed as C's marks too
        return yaml.composer.ComposerError(None, None, problem, mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Return a section's keys and values, unless a key is given twice."""
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable):
                if key in seen:
                    problem = f"the key `{key}` is given twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
                seen.add(key)
        return super().construct_mapping(node, deep)


_INT, _FLOAT, _DATE = (f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp"))
Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_INT, _FLOAT, _DATE)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
Loader.add_implicit_resolver(_INT, re.compile(r"[-+]?(0|[1-9][0-9]{0,30})$"), list("-+0123456789"))
Loader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"(?=.{1,40}$)[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
    ),
    list("-+.0123456789"),
)


def parse_yaml(text: bytes) -> Any:
    """Return the content of a YAML text; raises yaml.YAMLError, ValueError or RecursionError."""
    if len(text) > MAX_BYTES:
        raise ValueError(f"its header is larger than {MAX_BYTES >> 10} kB")
    return yaml.load(text.decode(), Loader)  # noqa: S506 - it is a SafeLoader
