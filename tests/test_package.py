"""The package: public names, what a wheel holds, and no bare imports of the folders at the top."""

import ast
import importlib
from pathlib import Path

import pytest

import shearloop

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("bank", "daemon", "drivers")


@pytest.mark.parametrize("name", shearloop.__all__)
def test_every_public_name_can_be_imported_and_is_documented(name):
    assert getattr(shearloop, name).__doc__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'banks'"):
        _ = shearloop.banks


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_folders_at_the_top_cannot_be_imported_by_themselves(folder):
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(folder)


def test_no_module_imports_the_folders_at_the_top_by_themselves():
    bare = []
    for path in (p for folder in (*FOLDERS, "benchmarks", "tests", "src") for p in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            bare += [f"{path.relative_to(ROOT)}: {name}" for name in names if name.split(".")[0] in FOLDERS]
    assert not bare
