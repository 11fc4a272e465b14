"""What every test is held to: no task, thread, child process or file handle is left over."""

import asyncio
import functools
import gc
import inspect
import io
import itertools
import os
import sys
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest
import structlog

# Test helpers are imported as `tests.…` and measurements as `benchmarks.…`, without the repository's root on the path:
# there `bank`, `daemon` and `drivers` could be imported beside `shearloop.bank`, `shearloop.daemon` and the rest.
_ROOT = Path(__file__).resolve().parents[1]
for _name in ("tests", "benchmarks"):
    if _name not in sys.modules:
        _package = types.ModuleType(_name)
        _package.__path__ = [str(_ROOT / _name)]
        sys.modules[_name] = _package

# The fixtures that several rooms share.
pytest_plugins = [
    "tests.fixtures.physics",
    "tests.fixtures.daemons",
    "tests.fixtures.recordings",
    "tests.fixtures.rigs",
]

# Before numpy is imported, as the command line and the Makefile do: threads that wait for a busy machine's other
# processor make a calibration twenty times as slow.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes on a busy machine says nothing about what is tested.
hypothesis.settings.register_profile("shearloop", deadline=None)
hypothesis.settings.load_profile("shearloop")

# Files of more than some five seconds, the longest first (`make test PYTEST_ARGS=--durations=60` shows them). First
# those of the tests in real time, then those of the others, then the long ones.
LONGEST = (
    "test_client.py", "test_restarts.py", "test_commission.py", "test_every_way_out.py", "test_adapt_in_loop.py",
    "test_twist_and_hold.py", "test_rehearsal.py", "test_stops_and_unlocking.py", "test_measurements.py",
    "test_doctor.py", "test_ends.py", "test_recorded_rig.py",
    "test_page_controls.py", "test_run.py", "test_procedure.py", "test_calibrate.py", "test_session.py",
    "test_page.py", "test_sign.py", "test_grips.py", "test_replay.py", "test_parallel.py", "test_docs.py",
    "test_boards.py", "test_skin_run.py", "test_other_fingertips.py", "test_calibration.py", "test_archive.py",
    "test_under_systemd.py", "test_set_clock.py", "test_load_delay.py", "test_server.py", "test_refused_exports.py",
    "test_flood.py", "test_pruned_matching.py", "test_skin_drift.py", "test_mad_client.py", "test_control_loop.py",
    "test_printable.py", "test_cli_recordings.py", "test_emulate.py", "test_skin_replay.py", "test_recorder.py",
    "test_no_drop_unasked.py", "test_cylinders.py", "test_wrist_controller.py", "test_bank_design.py", "test_cli.py",
    "test_turns.py",
    "test_skin_estimator.py", "test_line_clock.py", "test_design.py", "test_keys.py", "test_live_ways_out.py",
    "test_shared_recordings.py", "test_skin.py", "test_demo.py", "test_runner_any_order.py", "test_finite_strain.py",
    "test_leave_out.py", "test_adapt.py", "test_cli_reproduce.py", "test_plane_strain.py", "test_dead_channels.py",
    "test_walk.py", "test_speed_accuracy_chart.py", "test_own_calibration.py", "test_soak.py", "test_replay_rig.py",
    "test_stop_times.py",
)  # fmt: skip
_TESTS = _ROOT / "tests"
# What only computes: nothing there waits, or depends on how long it takes.
COMPUTING = tuple(
    _TESTS / path
    for path in (
        "bank", "estimation", "test_structure.py",
        *("benchmarks/test_grip_strength.py", "benchmarks/test_stability_map.py"),
        *("daemon/test_config_file.py", "daemon/test_settings.py"),
        *(f"daemon/control/test_{name}.py" for name in (
            "control_loop", "experiment", "identify", "margins", "runner", "safety", "torque_controller", "turns",
            "wrist_controller",
        )),
        *(f"daemon/sensing/test_{name}.py" for name in ("frame_pairing", "sessions", "skin_drift", "skin_estimator")),
        *(f"drivers/test_{name}.py" for name in ("frame_clock", "frame_parser", "line_clock", "load_cell")),
        *(f"drivers/ur/test_{name}.py" for name in ("handler_any_order", "layers", "limits", "mad_client", "script")),
        *("tools/commission/test_judgement.py", "tools/commission/test_procedure.py"),
        *(f"tools/test_{name}.py" for name in ("bank_config", "bank_design", "creep", "evaluate")),
        *(f"tools/recordings/test_{name}.py" for name in (
            "cli_recordings", "matlab_recordings", "message_content", "set_clock",
        )),
    )
)  # fmt: skip
# `make test-long` runs these files and folders, and single tests with the mark `long`, such as those that take a second
# of a processor or more; `make test` runs all others.
LONG = tuple(
    _TESTS / path
    for path in (
        # Endurance: many experiments, every order of events, every pace, other clocks.
        "benchmarks/test_soak.py", "daemon/control/test_no_command_beyond_limits.py",
        "daemon/control/test_runner_any_order.py", "drivers/ur/test_script_any_order.py",
        "tools/recordings/test_replay_combined.py", "tools/recordings/test_replay_rig.py",
        "tools/recordings/test_rig_with_set_clock.py",
        # Every topic without each of its keys, through every way out.
        "tools/recordings/test_other_versions.py",
        # A newcomer's first hour, with the commands of the README.
        "cli/newcomer", "tools/commission/test_walk.py",
        # Figures: of the papers, of estimators on real recordings, of independent solutions.
        "benchmarks/test_adaptation.py", "benchmarks/test_step_response.py", "benchmarks/test_stop_times.py",
        "benchmarks/test_stability_map.py", "cli/test_leave_out.py", "cli/test_skin.py",
        "daemon/test_adapt_in_loop.py", "daemon/test_other_fingertips.py",
        "estimation/skin/test_plane_strain.py", "estimation/test_dead_channels.py", "studies",
        "tools/recordings/test_adapt.py", "tools/recordings/test_shared_recordings.py", "tools/test_leave_out.py",
    )
)  # fmt: skip
SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of reference data, where there is one."""
    if not SHARED.is_dir():
        pytest.skip("needs the reference data in ../shared, which is not on this machine")
    return SHARED


@pytest.fixture(scope="session")
def state_homes(tmp_path_factory) -> Iterator[Path]:
    """Numbered folders for the state of each test; pytest's own would look through all that are there for each."""
    folder = tmp_path_factory.mktemp("states")
    return (folder / str(number) for number in itertools.count())


@pytest.fixture(autouse=True)
def state_home(state_homes, monkeypatch) -> None:
    """A state folder of its own for every test: a stop is remembered there for the next daemon of the same robot."""
    folder = next(state_homes)
    folder.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))


@pytest.fixture(scope="session")
def fonts() -> None:
    """Have matplotlib open its fonts, which it keeps open, before any test is watched for open files."""
    from matplotlib.figure import Figure

    figure = Figure()
    figure.text(0, 0, "σ − · $x^{-2}$ $\\times 10$")
    figure.savefig(io.BytesIO(), format="png")
    figure.savefig(io.BytesIO(), format="svg")


@pytest.fixture(scope="session")
def tiny_bank(tmp_path_factory) -> Path:
    """A bank of 8 × 8 random signals: scored in a millisecond."""
    from benchmarks.stop_times import write_random_bank

    path: Path = tmp_path_factory.mktemp("bank") / "tiny.bank"
    write_random_bank(path)
    return path


def pytest_configure() -> None:
    """Refuse lists that a renamed file has left behind."""
    if missing := [str(path) for path in (*COMPUTING, *LONG) if not path.exists()]:
        raise pytest.UsageError(f"Not there, but in a list of tests/conftest.py: {', '.join(missing)}.")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """For a part of the tests do not import the files and the folders that have none of it, in each worker."""
    for term in config.getoption("markexpr").split(" and "):
        if term in PARTS and not PARTS[term](collection_path):
            return True
    return None


def _has_mark(mark: str, path: Path) -> bool:
    files = path.rglob("test_*.py") if path.is_dir() else [path]
    return any(file.match("test_*.py") and f"pytest.mark.{mark}" in file.read_text(encoding="utf-8") for file in files)


# Asked once for each test; a worker has thousands of them.
@functools.cache
def _is_in(path: Path, part: tuple[Path, ...]) -> bool:
    return any(path.is_relative_to(one) for one in part)


def _leads_to(path: Path, part: tuple[Path, ...]) -> bool:
    return _is_in(path, part) or any(one.is_relative_to(path) for one in part)


# Of the terms by which the Makefile selects a part: whether a file or folder may have tests of it.
PARTS: dict[str, Callable[[Path], bool]] = {
    "real_time": functools.partial(_has_mark, "real_time"),
    "computes": lambda path: _leads_to(path, COMPUTING),
    "not computes": lambda path: not _is_in(path, COMPUTING),
    "long": lambda path: _leads_to(path, LONG) or _has_mark("long", path),
    "not long": lambda path: not _is_in(path, LONG),
}


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark the tests that only compute, and the long ones."""
    if _is_in(item.path, COMPUTING) and item.get_closest_marker("real_time") is None:
        item.add_marker("computes")
    if _is_in(item.path, LONG):
        item.add_marker("long")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files and the tests that take longest: what is shared out last ends alone."""

    def turn(item: pytest.Item) -> tuple[bool, int]:
        place = LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST)
        return item.get_closest_marker("timeout") is None, place

    items.sort(key=turn)


def pytest_collection_finish() -> None:
    """Exempt all modules and tests from garbage collections, which otherwise take a quarter of a second each.

    What tests make is collected less often than by default, which saves a twentieth of their time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 50, 1000)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test in an event loop of its own, and fail it for every task that it leaves behind.

    pytest-asyncio cancels such tasks silently when it closes its loop. No fixture is a coroutine, so that these lines
    do all that its plugin would.
    """
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def checked() -> None:
        await pyfuncitem.obj(**arguments)
        left = asyncio.all_tasks() - {asyncio.current_task()}
        assert not left, f"tasks left over: {left}"

    asyncio.run(checked())
    return True


def _open_files() -> dict[str, str]:
    found = {}
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            found[descriptor] = os.readlink(f"/proc/self/fd/{descriptor}")
        except FileNotFoundError:  # the listing's own descriptor
            continue
    # Matplotlib keeps its fonts open.
    return {descriptor: path for descriptor, path in found.items() if not path.endswith(".ttf")}


@pytest.fixture(autouse=True)
def nothing_left_over(request) -> Iterator[None]:
    """Fail a test that leaves threads or file handles; session fixtures requested here are made beforehand."""
    for name in request.fixturenames:
        if name != "nothing_left_over" and _is_shared(request, name):
            request.getfixturevalue(name)
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    threads, files = set(threading.enumerate()), _open_files()
    yield
    if os.getpriority(os.PRIO_PROCESS, 0) < niceness:
        # A daemon that root runs takes a place before all others, from the tests beside it too.
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
    # A command under test sets the log up with the error stream of its test, which is closed in the next one.
    structlog.reset_defaults()
    if _left(threads, files) != ([], {}):
        # What hangs in a cycle is no leak; looking for cycles after each of a thousand tests would double their time.
        gc.collect()
        # To look through all that was imported takes a quarter of a second, each time.
        gc.freeze()
        for ending in _left(threads, files)[0]:
            # asyncio's own for a child process ends just after it; any other that still runs was left over.
            if ending.name.startswith("asyncio-waitpid"):
                ending.join(timeout=1.0)
    new_threads, new_files = _left(threads, files)
    assert not new_threads, f"threads left over: {new_threads}"
    assert not new_files, f"file handles left over: {new_files}"


def _left(threads: set[threading.Thread], files: dict[str, str]) -> tuple[list[threading.Thread], dict[str, str]]:
    """Return the threads and the open files that have come since."""
    new_threads = [thread for thread in threading.enumerate() if thread not in threads]
    return new_threads, {n: target for n, target in _open_files().items() if files.get(n) != target}


def _is_shared(request: pytest.FixtureRequest, name: str) -> bool:
    definitions = request._fixturemanager.getfixturedefs(name, request.node)
    return bool(definitions) and definitions[-1].scope in ("session", "module", "package")
