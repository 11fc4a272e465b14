"""The pages name only commands, options, files and pages that there are."""

import ast
import importlib.util
import re
import runpy
import shlex
import textwrap
from pathlib import Path

import pytest
import yaml

import shearloop
from shearloop.bank.models import MODELS
from shearloop.cli.completion import arguments_of, full_parser, parts_of
from shearloop.cli.registry import COMMANDS, command_module
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.experiment_schema import STEP_KINDS
from shearloop.daemon.experiment_files import check_experiment
from shearloop.daemon.torques import TorqueSource
from shearloop.estimation.estimator_names import ESTIMATORS
from shearloop.tools.bank_config import load_bank_plan

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("bank", "estimation", "drivers", "emulators", "daemon", "tools", "studies", "cli")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"(?<!!)\[[^\]]*\]\(([^)#]+)[^)]*\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page):
    parsers = parts_of(full_parser())
    for text in re.findall(r"(?:^ {4}|`)(?:sudo )?(?:[./\w-]*/)?shearloop ([^`\n]*)", page.read_text(), re.MULTILINE):
        words = shlex.split(text.split(" #")[0].split(";")[0], comments=False) if text.count("'") % 2 == 0 else []
        if not words or not re.fullmatch(r"[a-z]+", words[0]):
            continue
        assert words[0] in COMMANDS, f"{page.name}: shearloop {text}"
        known = _options(parsers[words[0]])
        for word in words[1:]:
            if word.startswith("--"):
                assert word.rstrip(",.").split("=")[0] in known, f"{page.name}: shearloop {text}"


def blocks(text: str) -> list[str]:
    """Return the indented blocks of a page or a docstring."""
    found = re.findall(r"^ {4}.*\n(?:\n* {4}.*\n)*", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{n}") for page in PAGES for n, block in enumerate(blocks(page.read_text()))
]
SYSTEM_PROGRAMS = {"cd", "git", "sudo", "apt", "pip", "uvx", "ssh", "dask", "docker", "systemctl", "journalctl"}


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_is_valid(block, tmp_path):
    if re.match(r"\w+:(\s|$)", block):
        check_yaml(block, tmp_path)
    elif block.startswith("import "):
        compile(block, "block", "exec")
    elif block.startswith("#"):
        (schema,) = re.findall(r"\$schema=(\S+)", block)
        assert (ROOT / "config" / schema).exists()
    elif "─" not in block and "drivers/connection.py" not in block:
        for line in block.splitlines():
            for command in re.split(r" && | & ", re.sub(r" +#.*| &$", "", line)):
                check_command(command)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_benchmarks_command_has_its_required_arguments(page):
    for name, given in re.findall(r"python -m benchmarks\.(\w+)([^`\n]*)", page.read_text()):
        doc = ast.get_docstring(ast.parse((ROOT / "benchmarks" / f"{name}.py").read_text())) or ""
        (usage,) = re.findall(rf"^ *python -m benchmarks\.{name}(.*)$", doc, re.MULTILINE)[:1]
        required = [word for word in re.sub(r"\[.*?\]", "", usage).split() if word.startswith("--") or word.isupper()]
        missing = {word for word in required if word.startswith("--") or word == "RECORDINGS"} - {*given.split()}
        assert not missing, f"{page.name}: {name}{given}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_imports_the_recordings_that_it_judges_and_builds_the_banks_of_its_commands(page):
    """A file that a command reads by name is made on the page, or on the page that it links to."""
    text = page.read_text()
    linked = [(page.parent / one).read_text() for one in re.findall(r"\]\(((?!http)[^)#]+\.md)", text)]
    made = re.findall(r"--out (\S+)", "\n".join([text, *linked]))
    # The demo's folder has its own bank.
    made += ["run/demo.bank"]
    for block in blocks(text):
        for name in re.findall(r"(?<=\s)((?:\d+mm_\d|\d{8}_\d{6})\.mcap|run/\w+\.bank)", block):
            assert name in made, f"{page.name}: {name}"


def check_yaml(block: str, folder: Path) -> None:
    """Load a block as the file that its keys show it to be."""
    content = yaml.safe_load(block)
    (folder / "here").mkdir()
    path = folder / "here" / "file.yaml"
    if "steps" in content:
        path.write_text(block)
        names = ("right", "left", "combined", "load_cell")
        sources = {name: TorqueSource(name=name, period_s=0.5, has_gain=name != "load_cell") for name in names}
        demo = load_daemon_config(ROOT / "config/demo.yaml").model_copy(update={"experiment": path})
        assert check_experiment(demo, sources) is not None
    elif "model" in content:
        (folder / "fingertips").symlink_to(ROOT / "config/fingertips")
        path.write_text(block)
        assert load_bank_plan(path)
    else:
        rest = {"fingertips": {"right": {"device": {"path": "port"}}}}
        path.write_text(yaml.safe_dump({**rest, **content}))
        load_daemon_config(path)


def check_command(line: str) -> None:
    """Parse a shearloop command with its own parser; of others check that there is such a program."""
    program, *arguments = shlex.split(line.removeprefix("sudo "))
    if program.endswith("shearloop"):
        module = command_module(arguments[0])
        expand = getattr(module, "expand_default_command", list)
        full_parser().parse_args([arguments[0], *expand(arguments[1:])])
    elif program == "make":
        assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "python":
        assert arguments[0] == "-m"
        assert importlib.util.find_spec(arguments[1])
    elif not re.fullmatch(r"\[\w+\]|\w+=.*", program):
        assert program.split("/")[-1] in {*SYSTEM_PROGRAMS, "python3", "usermod"}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "docs/first-recording.ipynb"], ids=lambda page: page.name)
def test_a_page_installs_in_a_clone_and_not_from_an_index_where_shearloop_is_not(page):
    text = page.read_text()
    assert re.findall(r"(?:install|--from) '?shearloop\b", text) == []
    assert not re.search(r"pip install (?:-e )?'?\.", text) or "clone of " in text


def test_readme_and_index_lead_to_every_page():
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md"}
    readme = re.findall(r"\]\(docs/([\w-]+\.md)", (ROOT / "README.md").read_text())
    index = re.findall(r"\]\(([\w-]+\.md)", (ROOT / "docs/index.md").read_text())
    assert set(readme) == set(index) == pages


def test_the_readmes_recordings_are_ignored_by_git():
    folders = {Path(one).parts[0] for one in re.findall(r"--record (\S+)", (ROOT / "README.md").read_text())}
    assert folders
    assert {f"/{folder}/" for folder in folders} <= set((ROOT / ".gitignore").read_text().splitlines())


def test_pages_list_every_command_step_estimator_and_basis_model():
    for page, names in {
        "README.md": COMMANDS,
        "docs/writing-an-experiment.md": STEP_KINDS,
        "docs/estimators.md": ESTIMATORS,
        "docs/glossary.md": [*ESTIMATORS, *MODELS],
    }.items():
        text = (ROOT / page).read_text()
        assert [name for name in names if f"`{name}`" not in text] == [], page


@pytest.mark.parametrize("page", ["architecture", "where-to-add", "calibrations", "estimators"])
def test_files_classes_and_functions_that_a_page_names_exist(page):
    folders = (*ROOMS, "src", "config", "tests", "benchmarks")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    code = [path for path in files if path.suffix == ".py" and "tests" not in path.relative_to(ROOT).parts]
    words = {word for path in code for word in re.findall(r"\w+", path.read_text())}
    paths = [f"/{path.relative_to(ROOT)}" for path in files]
    text = re.sub(r"```.*?```", "", (ROOT / f"docs/{page}.md").read_text(), flags=re.DOTALL)
    missing = []
    not_ours = {"drivers/NAME", "calibration.yaml", ".npz", "torque_slices/", "diameter_slices/"}
    for name in set(re.findall(r"`([\w./-]+)`", text)) - not_ours:
        if "/" in name or name.endswith((".py", ".js", ".yaml")):
            found = (ROOT / name).exists() or any(path.endswith(f"/{name}") for path in paths)
        else:
            found = words.issuperset(re.findall(r"\w+", name))
        missing += [] if found else [name]
    assert missing == []


def program_texts() -> list[str]:
    """Return the string literals of the code, with `…` in place of each formatted value."""

    def text(node: ast.AST) -> str:
        match node:
            case ast.Constant(value=str(value)):
                return re.sub(r"\{\w+\}", "…", value)
            case ast.JoinedStr(values=parts):
                return "".join(text(part) for part in parts)
            case _:
                return "…"

    return [
        text(node)
        for folder in (*ROOMS, "src")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
    ]


def test_every_message_of_the_troubleshooting_page_exists_in_the_code():
    quoted = re.findall(r'^\| "(.*?)" \||\("(.*?)"\)', (ROOT / "docs/troubleshooting.md").read_text(), re.MULTILINE)
    messages = ["".join(pair) for pair in quoted]
    texts = program_texts()
    assert len(messages) >= 30
    assert [message for message in messages if not any(message in text for text in texts)] == []


def _options(parser) -> set[str]:
    found = {option for action in arguments_of(parser) for option in action.option_strings}
    return found.union(*(_options(below) for below in parts_of(parser).values()))


@pytest.mark.parametrize("page", PAGES[1:], ids=lambda page: page.name)
def test_a_page_is_in_the_site_and_leads_to_the_glossary(page):
    text = page.read_text()
    assert "(glossary.md)" in text or page.name == "glossary.md"
    assert f"- {page.name}\n" in (ROOT / "mkdocs.yml").read_text()


def test_the_readme_is_short_and_begins_with_what_for_whom_and_why():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 170
    first_screen = "\n".join(lines[:45])
    for part in ("**What.**", "**For whom.**", "**Why.**", "](docs/images/overview.gif)", "shearloop demo"):
        assert part in first_screen
    start = blocks((ROOT / "README.md").read_text())[0].splitlines()
    assert [line.split(" #")[0].strip() for line in start] == ["make demo", "make test"]


@pytest.fixture(scope="module")
def notebook_run(tmp_path_factory) -> dict[str, str]:
    """Runs the notebook; its results as text by the name that each shows."""
    nbclient = pytest.importorskip("nbclient", reason="running a notebook needs nbclient")
    for needed in ("ipykernel", "matplotlib", "pandas"):
        pytest.importorskip(needed, reason="the notebook needs the extra `notebook`")
    text = (ROOT / "docs/first-recording.ipynb").read_text(encoding="utf-8")
    notebook = importlib.import_module("nbformat").reads(text, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == [n + 1 for n in range(len(code))], "run it: see CONTRIBUTING.md"
    assert not any(one.output_type in ("error", "stream") for cell in code for one in cell.outputs)
    folder = tmp_path_factory.mktemp("notebook")
    nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(folder)}}).execute()
    shown = [cell for cell in code if cell.outputs]
    return {re.split(r"\W", cell.source.splitlines()[-1])[0]: cell.outputs[-1].data["text/plain"] for cell in shown}


@pytest.mark.long
def test_the_notebook_compares_estimators_on_loaded_frames(notebook_run):
    rows = re.findall(r"^.*(?:fingertips?|right)  +(\d+)\.0 +(\S+) +(\S+)", notebook_run["loaded"], re.MULTILINE)
    assert len(rows) == 3
    assert all(int(n) > 100 and float(rmse) < 0.3 * float(zero) for n, rmse, zero in rows)


# test_publisher tests the subscriber, which needs a daemon.
PROGRAMS = [
    one
    for one in blocks((ROOT / "docs/python.md").read_text())
    if "import shearloop" in one and "Subscriber" not in one
]
# The examples of `help(shearloop)` use one another's names, and the files that the programs have made.
EXAMPLES = "".join(one for one in blocks(f"{shearloop.__doc__}\n") if "Subscriber" not in one)
PROGRAMS.append(EXAMPLES.replace("twists.mcap", "rig-20mm.mcap"))


@pytest.fixture(scope="module")
def empty_folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("programs")


@pytest.mark.long
@pytest.mark.parametrize("program", PROGRAMS, ids=["record", "read", "calibrate", "estimate", "match", "help"])
def test_the_programs_of_the_python_page_and_of_help_run_one_after_another(program, empty_folder, monkeypatch, capsys):
    if ".frame(" in program:
        pytest.importorskip("pandas", reason="frames need the extra `notebook`")
    monkeypatch.chdir(empty_folder)
    Path("program.py").write_text(program)
    runpy.run_path("program.py")
    printed = capsys.readouterr().out
    assert float(printed) < 0.02 if "rmse_nm" in program else printed
