"""The package: public names, what a wheel holds, and no bare imports of the folders at the top."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
import yaml

import shearloop
from shearloop import estimation

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("bank", "cli", "daemon", "drivers", "emulators", "estimation", "studies", "tools")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize(
    ("package", "name"), [(package, name) for package in (shearloop, estimation) for name in package.__all__]
)
def test_every_public_name_can_be_imported_and_is_documented(package, name):
    assert getattr(package, name).__doc__


def test_importing_the_package_imports_no_library():
    code = "import sys, shearloop; print(sorted({'numpy', 'zmq', 'pydantic', 'pandas', 'yaml'} & set(sys.modules)))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'banks'"):
        _ = shearloop.banks


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_folders_at_the_top_cannot_be_imported_by_themselves(folder):
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(folder)


@cache
def imports() -> list[tuple[str, str]]:
    """Return each module that is imported by its whole name, after the file that imports it."""
    found = []
    for path in (p for folder in (*FOLDERS, "benchmarks", "tests", "src") for p in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [(str(path.relative_to(ROOT)), module) for module in modules]
    return found


def test_no_module_imports_the_folders_at_the_top_by_themselves():
    assert [f"{path}: {module}" for path, module in imports() if module.split(".")[0] in FOLDERS] == []


def test_the_version_and_its_date_are_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    sections = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    newest = next(section for section in sections if section != "Unreleased")
    assert newest == f"{citation['version']} ({citation['date-released']})"
    assert citation["version"] == PROJECT["version"]
    links = PROJECT["urls"].values()
    assert all(f"https://doi.org/{paper['doi']}" in links for paper in citation["references"])


def test_the_checks_run_on_every_supported_python_and_on_both_machines():
    supported = [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if "Python :: 3." in name]
    assert f"for version in {' '.join(supported)}; do" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "checks.yml").read_text(encoding="utf-8"))
    job = workflow["jobs"]["checks"]
    assert job["strategy"]["matrix"] == {"machine": ["ubuntu-24.04", "ubuntu-24.04-arm"]}
    checkout, python, run = job["steps"]
    assert checkout["uses"].startswith("actions/checkout@")
    assert python["with"]["python-version"].split() == supported
    assert run == {"run": ".ci/run"}


@pytest.mark.long
def test_the_pages_become_a_site_without_a_warning(tmp_path):
    pytest.importorskip("material", reason="the site needs the extra `docs`")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(
        command, cwd=ROOT, env={"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "site" / "configuration" / "index.html").exists()


# Imported names whose distribution is called otherwise.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "typing_extensions": "typing-extensions",
    "dask": "distributed",
    "dashboard_client": "ur-rtde",
    "foxglove": "foxglove-sdk",
    "grimp": "import-linter",
    "llvmlite": "numba",
    "material": "mkdocs-material",
    "nbformat": "nbclient",
    "pydantic_core": "pydantic",
    "rerun": "rerun-sdk",
    "rtde_control": "ur-rtde",
    "rtde_receive": "ur-rtde",
    "script_client": "ur-rtde",
    "serial": "pyserial",
    "skfem": "scikit-fem",
    "yaml": "pyyaml",
    "zmq": "pyzmq",
}
# Only a benchmark that reads a dataset back in an environment of its own imports these.
FOREIGN = {"lerobot", "torch"}


def test_every_import_is_declared():
    declared = [*PROJECT["dependencies"], *(one for some in PROJECT["optional-dependencies"].values() for one in some)]
    names = {re.split(r"[<>=;\[ ]", one)[0].lower() for one in declared}
    imported = {module.split(".")[0]: path for path, module in imports()}
    own = {"shearloop", "benchmarks", "tests", "__future__", *sys.stdlib_module_names, *FOREIGN}
    undeclared = {
        name: place
        for name, place in imported.items()
        if name not in own and DISTRIBUTIONS.get(name, name).lower() not in names
    }
    assert undeclared == {}


@pytest.mark.parametrize("record", sorted((ROOT / "docs" / "decisions").glob("*.md")), ids=lambda path: path.stem)
def test_a_decision_has_a_date_and_a_status(record):
    assert re.search(
        r"^Date: \d{4}-\d\d-\d\d\. Status: (accepted|superseded by \d{4})\.", record.read_text(), re.MULTILINE
    )
