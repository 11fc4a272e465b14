"""The package: public names, what a wheel holds, and no bare imports of the folders at the top."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import shearloop

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("bank", "cli", "daemon", "drivers", "emulators", "estimation", "studies", "tools")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("name", shearloop.__all__)
def test_every_public_name_can_be_imported_and_is_documented(name):
    assert getattr(shearloop, name).__doc__


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


def test_no_module_imports_the_folders_at_the_top_by_themselves():
    bare = []
    for path in (p for folder in (*FOLDERS, "benchmarks", "tests", "src") for p in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            bare += [f"{path.relative_to(ROOT)}: {name}" for name in names if name.split(".")[0] in FOLDERS]
    assert not bare


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


def test_the_pages_become_a_site_without_a_warning(tmp_path):
    pytest.importorskip("material", reason="the site needs the extra `docs`")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(
        command, cwd=ROOT, env={"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "site" / "configuration" / "index.html").exists()
