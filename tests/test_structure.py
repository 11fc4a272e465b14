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
MOST_ATTRIBUTES = 12
MOST_CALLABLES = 0.05
# Models of configuration and messages are tables: they have as many columns as users need.
TABLES = ("BaseModel", "ConfigModel", "Message", "NamedTuple")
# Plain values that are made in one place, and whose parts are not used on their own.
WIDE_VALUES = {"ControllerSettings", "Estimate", "RtdeOutputs"}
# Objects of libraries are set up by assignment.
OF_LIBRARIES = ("parser", "action", "config", "tqdm", "sys")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def modules() -> dict[Path, ast.Module]:
    """Return the syntax trees of all modules."""
    return {path: ast.parse(path.read_text()) for folder in FOLDERS for path in sorted(Path(folder).rglob("*.py"))}


def of_kind(kind: type | tuple[type, ...]) -> Iterator[tuple[Path, ast.AST]]:
    return ((path, node) for path, tree in modules().items() for node in ast.walk(tree) if isinstance(node, kind))


def body_lines(function: Function) -> int:
    """Return the lines of a function without its docstring."""
    documented = ast.get_docstring(function) is not None
    docstring = function.body[0]
    documented_lines = (docstring.end_lineno or 0) - docstring.lineno + 1 if documented else 0
    return function.end_lineno - function.lineno + 1 - documented_lines


def is_table(node: ast.ClassDef) -> bool:
    """Return whether a class is a model, or one of the wide values."""
    return node.name in WIDE_VALUES or any(ast.unparse(base).split("[")[0] in TABLES for base in node.bases)


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


def test_objects_have_few_attributes():
    classes = [(path, node) for path, node in of_kind(ast.ClassDef) if isinstance(node, ast.ClassDef)]
    large = {
        f"{path}: {node.name}"
        for path, node in classes
        if len(attributes(node)) > MOST_ATTRIBUTES and not is_table(node)
    }
    assert large == set()


def test_few_constructor_arguments_are_callables():
    arguments = [
        ast.unparse(argument.annotation)
        for _, node in of_kind(ast.FunctionDef)
        if isinstance(node, ast.FunctionDef) and node.name == "__init__"
        for argument in (*node.args.args[1:], *node.args.kwonlyargs)
        if argument.annotation is not None
    ]
    aliases = {
        ast.unparse(target)
        for _, node in of_kind((ast.Assign, ast.AnnAssign))
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if node.value is not None and ast.unparse(node.value).startswith("Callable[")
    }
    callables = [each for each in arguments if (aliases | {"Callable"}) & set(re.findall(r"\w+", each))]
    assert len(callables) <= MOST_CALLABLES * len(arguments), callables


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
