"""Finds, in the source, every sentence that an operator may read, with what it says is to be done."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# Mistakes in calls of our own functions, and ends that are no news to anybody: their sentences reach no operator.
_NOT_FOR_OPERATORS = frozenset({"TypeError", "KeyError", "AssertionError", "NotImplementedError", "StopIteration"})
_FEWEST_WORDS = 3


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence; what varies in it is in angle quotes. `cure` is empty where it names none itself."""

    said: str
    cure: str


def raised(path: Path) -> Iterator[Sentence]:
    """Yield what the errors say that a module raises, or makes for others to raise, in the order of the source."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = {node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)}
    calls |= {node for node in ast.walk(tree) if isinstance(node, ast.Call) and _name(node.func).endswith("Error")}
    for call in sorted(calls, key=lambda node: (node.lineno, node.col_offset)):
        if _name(call.func) not in _NOT_FOR_OPERATORS:
            for argument in call.args:
                text = _text(argument)
                words = text.split()
                if len(words) >= _FEWEST_WORDS and not all(word.startswith("‹") for word in words):
                    yield split(text)


def told(path: Path) -> Iterator[Sentence]:
    """Yield what the functions of a module return or yield as sentences, and texts that its tables hold."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    documented = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    found: list[tuple[int, str]] = []
    _sentences_in(tree, documented, found)
    for _, text in sorted(found):
        yield split(text)


def split(text: str) -> Sentence:
    """Return a sentence parted into what happened and what to do: the cure follows the last semicolon or colon."""
    text = " ".join(text.split()).rstrip(".")
    for mark in ("; ", ": "):
        said, found, cure = text.rpartition(mark)
        if found and len(cure.split()) >= _FEWEST_WORDS and _asks_for_something(cure):
            return Sentence(said, cure)
    said, found, cure = text.rpartition(". ")
    if found and _asks_for_something(cure):
        return Sentence(said, cure)
    return Sentence(text, "")


def _asks_for_something(cure: str) -> bool:
    """Return whether a clause tells its reader to do something: it begins with a verb that such clauses begin with."""
    return cure.lower().removeprefix("`").split()[0].rstrip(",") in _VERBS


_VERBS = frozenset(
    """add ask begin build bring calibrate change check choose clear close connect copy did disable end exchange fetch
    fix follow give grip import install leave let log look lower make measure mend move name open plug press put raise
    read record release remove reset restart restore run save say see select send set sort start stop sudo switch take
    tare turn unlock unplug use wait wet widen write""".split()  # noqa: SIM905 - a list of words is read as a text
)


def _sentences_in(node: ast.AST, documented: set[int], found: list[tuple[int, str]]) -> None:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Constant | ast.JoinedStr):
            text = _text(child)
            if id(child) not in documented and len(text.split()) > _FEWEST_WORDS:
                found.append((child.lineno, text))
        elif not (isinstance(child, ast.Raise) or (isinstance(child, ast.Call) and _name(child.func) == "Field")):
            _sentences_in(child, documented, found)


def _text(node: ast.AST) -> str:
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_text(part) for part in parts)
        case ast.FormattedValue(value=value):
            return f"‹{_short(value)}›"
        case _:
            return ""


def _short(value: ast.expr) -> str:
    """Return a name for what is filled in: the last name in it."""
    names = [
        n.id if isinstance(n, ast.Name) else n.attr for n in ast.walk(value) if isinstance(n, ast.Name | ast.Attribute)
    ]
    plain = [name for name in names if name not in _FUNCTIONS]
    return plain[0].lstrip("_").replace("_", " ") if plain else "…"


_FUNCTIONS = frozenset("abs enumerate int join len map max min repr round self sorted str sum type zip".split())  # noqa: SIM905


def _name(function: ast.expr) -> str:
    match function:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
        case _:
            return ""
