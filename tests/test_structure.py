"""The shape of the code: what a reader may rely on without looking."""

import ast
import graphlib
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import grimp

FOLDERS = ("bank", "estimation", "drivers", "emulators", "daemon", "tools", "studies", "cli")
LONGEST_FUNCTION = 60
# Objects of libraries are set up by assignment.
OF_LIBRARIES = ("parser", "action", "config", "interruption", "tqdm", "sys")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def modules() -> dict[Path, ast.Module]:
    """Return the syntax trees of all modules."""
    return {path: ast.parse(path.read_text()) for folder in FOLDERS for path in sorted(Path(folder).rglob("*.py"))}


@cache
def nodes() -> list[tuple[Path, ast.AST]]:
    """Return the nodes of all modules' syntax trees."""
    return [(path, node) for path, tree in modules().items() for node in ast.walk(tree)]


def of_kind(kind: type | tuple[type, ...]) -> Iterator[tuple[Path, ast.AST]]:
    return ((path, node) for path, node in nodes() if isinstance(node, kind))


def body_lines(function: Function) -> int:
    """Return the lines of a function without its docstring."""
    documented = ast.get_docstring(function) is not None
    docstring = function.body[0]
    documented_lines = (docstring.end_lineno or 0) - docstring.lineno + 1 if documented else 0
    return function.end_lineno - function.lineno + 1 - documented_lines


def attributes(node: ast.ClassDef) -> set[str]:
    """Return the attributes that a class sets on its objects."""
    own = {
        each.target.id for each in node.body if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    }
    for each in ast.walk(node):
        if isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store) and ast.unparse(each.value) == "self":
            own.add(each.attr)
    return own


def test_functions_are_short():
    functions = [(path, node) for path, node in of_kind((ast.FunctionDef, ast.AsyncFunctionDef))]
    long = [f"{path}:{node.lineno} {node.name}" for path, node in functions if body_lines(node) > LONGEST_FUNCTION]
    assert long == []


def test_an_object_is_complete_after_its_construction():
    """Attributes are set by the object itself, or on a record of state that the same package defines."""
    fields: dict[Path, set[str]] = {}
    for path, node in of_kind(ast.ClassDef):
        if isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(each) for each in node.decorator_list):
            fields.setdefault(path.parent, set()).update(attributes(node))
    foreign = []
    for path, node in of_kind(ast.Attribute):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            owner = ast.unparse(node.value)
            own = owner in ("self", "cls", *OF_LIBRARIES) or node.attr in fields.get(path.parent, ())
            if not own and "emulators" not in path.parts:
                foreign.append(f"{path}:{node.lineno} {owner}.{node.attr}")
    assert foreign == []


def test_no_two_modules_import_each_other():
    graph = grimp.build_graph("shearloop", cache_dir=None)
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    graphlib.TopologicalSorter(imported).prepare()


def test_no_room_holds_more_than_three_tenths_of_the_lines():
    lines = Counter[str]()
    for path in modules():
        lines[path.parts[0]] += len(path.read_text().splitlines())
    assert max(lines.values()) <= 0.3 * lines.total(), lines


def test_no_test_reads_what_is_private():
    """Neither of the package nor of a library; pytest has no public name for two things that `conftest.py` needs."""
    private = []
    texts = {path: path.read_text() for path in sorted(Path("tests").rglob("*.py"))}
    # Few files have such an attribute as text, and only theirs need to be parsed.
    for path, text in [(path, text) for path, text in texts.items() if re.search(r"\.\s*_", text)]:
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Attribute) or not node.attr.startswith("_") or node.attr.startswith("__"):
                continue
            if ast.unparse(node.value) not in ("self", "cls", "os", "super()") and path.name != "conftest.py":
                private.append(f"{path}:{node.lineno} {ast.unparse(node)}")
    assert private == []
