"""The doctor against boards that are played over pseudo-terminals: each verdict is reached, and each cure cures."""

import re
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.config import load_daemon_config
from shearloop.drivers.calibration_files import save_calibration
from shearloop.drivers.eit_kit import ADC_STEP_V, FrameParser
from shearloop.drivers.load_cell import LoadCalibration
from shearloop.emulators.boards import EitKitBoard, EmulatedBoard, Hx711Board, Sketch, format_line
from shearloop.emulators.gripper import Gripper, UrcapSession
from shearloop.emulators.ports import SocketServer
from shearloop.tools.doctor.devices import check_daemon, check_devices, check_task
from shearloop.tools.doctor.findings import Finding
from tests.fixtures.daemons import robot_at
from tests.running import running

PERIOD_S = 0.02
SECONDS = 0.6
ELECTRODE = (PAPER_TABLE.electrodes == 5).any(axis=1)
SKETCH = Sketch()
CALIBRATION = LoadCalibration(tare_counts=SKETCH.tare_counts, scale_n_per_count=1 / (0.035 * SKETCH.counts_per_nm))


def frames(
    still: NDArray[np.bool_] | bool = False, silent: NDArray[np.bool_] | bool = False, every: int = 1, one: bool = False
) -> Iterator[bytes]:
    """Yield lines without end: of noise; some channels still; some 0 in every so manieth frame; or one line only."""
    random, n = np.random.default_rng(0), PAPER_TABLE.n_channels
    steps, number = random.integers(30, 200, n), 0
    while True:
        number += 1
        noise = np.zeros(n, np.int64) if one else random.integers(-2, 3, n)
        values = np.where(still, steps, steps + noise) * ADC_STEP_V
        if number % every == 0:
            values = np.where(silent, 0.0, values)
        yield format_line(PAPER_TABLE.line_of_channels(values))


def texts(*lines: bytes) -> Iterator[bytes]:
    while True:
        yield from lines


def timed(lines: Iterator[bytes], sent_s: list[float]) -> Iterator[bytes]:
    """Yield lines, and note when each is sent: a busy computer slows a played board down."""
    for line in lines:
        sent_s.append(time.monotonic())
        yield line


def rate_of(sent_s: list[float]) -> float:
    return (len(sent_s) - 1) / (sent_s[-1] - sent_s[0])


def mixed(often: bytes) -> Iterator[bytes]:
    """Yield a frame and a line that is refused, in turn."""
    for line in frames():
        yield line + often


def counts(sketch: Sketch = SKETCH, torque_nm: float = 0.0) -> Iterator[bytes]:
    return sketch.lines(texts_nm(torque_nm))


def texts_nm(torque_nm: float) -> Iterator[float]:
    while True:
        yield torque_nm


@pytest.fixture
def rig(config, tmp_path):
    """Return a function that has the doctor examine played boards, by the lines that each sends."""

    async def examine(
        eit: Iterator[bytes] | None = None,
        load: Iterator[bytes] | None = None,
        *,
        path: Path | None = None,
        seconds: float = SECONDS,
        **changes: Any,
    ) -> dict[str, Finding]:
        if path is None:
            right = {"device": {"path": str(tmp_path / "eit-right")}, "frame_period_s": PERIOD_S}
            cell = {"device": {"path": str(tmp_path / "load-cell")}, "rate_hz": 1 / PERIOD_S, **changes}
            path = config(right=right, **({"load_cell": cell} if load is not None else {}))
        async with AsyncExitStack() as boards:
            for lines, kind, name in ((eit, EitKitBoard, "eit-right"), (load, Hx711Board, "load-cell")):
                if lines is not None:
                    board: EmulatedBoard = kind(lines, period_s=PERIOD_S, link=tmp_path / name)
                    await boards.enter_async_context(running(board.run()))
                    await board.port.appearances.get()
            found = await check_devices(load_daemon_config(path), seconds)
        for finding in found:
            assert bool(finding.means) == bool(finding.next_step) == (finding.state != "good"), finding
        return {finding.subject: finding for finding in found}

    return examine


async def test_boards_in_order_are_good(rig, tmp_path):
    save_calibration(tmp_path / "load.yaml", CALIBRATION)
    found = await rig(frames(), counts(), calibration=str(tmp_path / "load.yaml"))
    assert {finding.state for finding in found.values()} <= {"good", "note"}, found
    for subject in ("port of right", "channels of right", "port of load_cell", "signal of load_cell"):
        assert found[subject].state == "good", found[subject]
    assert found["channels of right"].found.startswith("0 saturated and 0 dead of the channels in ")


async def test_a_board_is_heard_before_its_bank_is_built(rig, config, tmp_path):
    device = {"path": str(tmp_path / "eit-right")}
    path = config(right={"device": device, "frame_period_s": PERIOD_S, "bank": str(tmp_path / "no.bank")})
    assert (await rig(frames(), path=path))["channels of right"].state == "good"


@pytest.mark.parametrize("how", ["still", "silent"])
async def test_an_electrode_whose_channels_stand_still_or_read_0_is_dead_and_named(rig, how):
    found = (await rig(frames(**{how: ELECTRODE})))["channels of right"]
    assert found.state == "trouble"
    assert "0 saturated and 112 dead" in found.found
    assert "56 channels of electrode 5 (pin 6)" in found.found
    assert "connector" in found.next_step


async def test_single_dead_channels_are_not_taken_for_a_dead_electrode(rig):
    scattered = np.arange(896) % 97 == 0
    found = (await rig(frames(silent=scattered)))["channels of right"]
    assert (found.state, "10 dead" in found.found, "electrode" in found.found) == ("trouble", True, False)
    found = (await rig(frames(silent=scattered, every=4)))["channels of right"]
    assert found.state == "note"
    assert "10 channels read 0 in some frames" in found.found
    # By chance a channel stands still for many frames.
    assert (await rig(frames(still=scattered)))["channels of right"].state == "good"


async def test_a_board_that_repeats_one_line_is_found(rig):
    found = (await rig(frames(one=True)))["channels of right"]
    assert found.state == "trouble"
    assert "frames are the same" in found.found


@pytest.mark.parametrize("factor", [0.04, 0.5, 25.0])
async def test_a_wrong_period_is_measured_at_the_board_and_the_cure_cures(rig, config, tmp_path, factor):
    """With a period that is much too short, a driver would take the board for silent and open it again and again."""
    eit, load = str(tmp_path / "eit-right"), str(tmp_path / "load-cell")
    right = {"device": {"path": eit}, "frame_period_s": factor * PERIOD_S}
    cell = {"device": {"path": load}, "rate_hz": min(1 / (factor * PERIOD_S), 1000.0)}
    path = config(right=right, load_cell=cell)
    lines = b"0.0100\r\n", b"0.0101\r\n"
    sent_s: dict[str, list[float]] = {"right": [], "load_cell": []}
    found = await rig(timed(frames(), sent_s["right"]), timed(texts(*lines), sent_s["load_cell"]), path=path)
    assert found["rate of right"].state == found["rate of load_cell"].state == "note"
    assert "nothing" not in found["rate of right"].found
    content = yaml.safe_load(path.read_text())
    for subject in ("rate of right", "rate of load_cell"):
        (key, value), *others = re.findall(r"`([a-z_.]+): ([0-9.e+-]+)`", found[subject].next_step)
        assert not others
        *parts, last = key.split(".")
        section = content
        for part in parts:
            section = section[part]
        assert last in section, f"{key} is a key of this device"
        section[last] = float(value)
    path.write_text(yaml.safe_dump(content))
    proposed_hz = {
        "right": 1.0 / content["fingertips"]["right"]["frame_period_s"],
        "load_cell": content["load_cell"]["rate_hz"],
    }
    for name, rate_hz in proposed_hz.items():
        assert rate_hz == pytest.approx(rate_of(sent_s[name]), rel=0.4), name
    again_s: dict[str, list[float]] = {"right": [], "load_cell": []}
    again = await rig(timed(frames(), again_s["right"]), timed(texts(*lines), again_s["load_cell"]), path=path)
    for name, times_s in again_s.items():
        measured_hz = float(again[f"rate of {name}"].found.split()[0])
        assert measured_hz == pytest.approx(rate_of(times_s), rel=0.4), name


async def test_exchanged_ports_are_recognised_by_what_comes(rig):
    found = await rig(counts(), frames())
    eit, load = found["lines of right"], found["lines of load_cell"]
    assert (eit.state, load.state) == ("trouble", "trouble")
    assert "A load cell's board sends such lines" in eit.found
    assert "An EIT-kit sends such lines" in load.found
    assert "shearloop ports" in eit.next_step
    assert "shearloop ports" in load.next_step
    assert "nothing was received" not in eit.found + load.found


@pytest.mark.parametrize(
    ("lines", "quoted", "who", "cure"),
    [
        (b"0,091\r\n", "'0,091'", "A program with a decimal comma", "firmware/hx711_torque"),
        (b"torque: 0.091\r\n", "'torque: 0.091'", "words beside the number", "firmware/hx711_torque"),
        (b"nan\r\n", "'nan'", "divides by zero", "wires"),
        (b"\xf8\x80\xfe\r\n", r"'\xf8\x80\xfe'", "another baud rate", "115200"),
    ],
)
async def test_lines_that_are_refused_are_quoted_with_sender_and_cure(rig, lines, quoted, who, cure):
    found = (await rig(load=texts(lines)))["lines of load_cell"]
    assert found.state == "trouble"
    assert quoted in found.found
    assert who in found.found
    assert cure in found.next_step
    assert "power" not in found.next_step


async def test_an_eit_kit_with_its_stock_library_is_recognised(rig):
    found = (await rig(texts(b"0.1234\n", b"0.0000\n")))["lines of right"]
    assert "an EIT-kit with its stock library" in found.found
    assert "in one line" in found.next_step


async def test_a_few_refused_lines_among_good_ones_are_a_note(rig):
    found = (await rig(mixed(b"0.1234, 0.1\n")))["lines of right"]
    assert found.state == "note"
    assert "were left out of" in found.found
    assert "'0.1234, 0.1'" in found.found


@pytest.mark.parametrize(
    ("value", "cure"),
    [
        (b"0; 1. 2", "replace the USB cable if more of them come"),
        (b"nan", "restart the board so that it calibrates again"),
    ],
)
async def test_what_a_board_sends_is_never_taken_for_the_cure(value, cure, rig):
    """Marks between cause and cure stood in the quoted bytes."""
    whole = next(frames())
    first, rest = whole.split(b", ", 1)
    assert len(first) == 6
    found = (await rig(texts(value + b", " + rest)))["lines of right"]
    assert f"refused {repr(value)[1:]} at value 1: a value that is " in found.found
    assert found.next_step == cure


async def test_bytes_without_a_line_end_are_quoted(rig):
    found = (await rig(texts(b"0.1234, "), seconds=0.2))["lines of right"]
    assert found.state == "trouble"
    assert "bytes without a line end came" in found.found
    assert "0.1234, 0.1234" in found.found


async def test_a_silent_board_and_a_too_short_check_have_their_own_cures(rig):
    found = await rig(texts(b""))
    assert "nothing was received in 0.6 s" in found["rate of right"].found
    assert "power" in found["rate of right"].next_step
    assert "--seconds 6" in found["rate of right"].next_step
    found = await rig(frames(), seconds=1.5 * PERIOD_S)
    assert "listen longer" in found["rate of right"].next_step


@pytest.mark.parametrize(
    ("load", "calibrated", "part", "cure"),
    [
        (texts(b"8388607\r\n"), True, "at the converter's limit", "four wires"),
        (texts(b"81250\r\n"), True, "are exactly 81250", "SCK"),
        (counts(), False, "the last reading is 81", "`shearloop calibrate load`"),
        (counts(torque_nm=3.0), True, "beyond the cell's capacity", "tare"),
    ],
)
async def test_a_fault_of_the_load_cells_signal_is_named_with_its_cure(rig, tmp_path, load, calibrated, part, cure):
    save_calibration(tmp_path / "load.yaml", CALIBRATION)
    changes = {"calibration": str(tmp_path / "load.yaml")} if calibrated else {}
    found = (await rig(load=load, **changes))["signal of load_cell"]
    assert found.state == "trouble"
    assert part in found.found
    assert cure in found.next_step


async def test_a_board_of_torques_with_a_calibration_of_counts_has_its_cure(rig, tmp_path):
    save_calibration(tmp_path / "load.yaml", CALIBRATION)
    found = (await rig(load=texts(b"0.0123\r\n", b"0.0119\r\n"), calibration=str(tmp_path / "load.yaml")))[
        "signal of load_cell"
    ]
    assert found.state == "trouble"
    assert "sends N·m" in found.means
    assert "take the key `calibration` out" in found.next_step


async def test_counts_are_cured_by_the_calibration(rig, tmp_path):
    save_calibration(tmp_path / "load.yaml", CALIBRATION)
    found = (await rig(load=counts()))["signal of load_cell"]
    assert "`load_cell.calibration`" in found.next_step
    again = await rig(load=counts(), calibration=str(tmp_path / "load.yaml"))
    assert again["signal of load_cell"].state == "good"


async def test_a_port_that_is_in_use_or_no_terminal_has_a_cure_of_its_own(rig, config, tmp_path):
    (tmp_path / "eit-right").write_text("a file")
    found = await rig(path=config(right={"device": {"path": str(tmp_path / "eit-right")}}))
    assert "cannot be opened" in found["port of right"].found
    assert "correct the file" not in found["port of right"].next_step
    assert "shearloop ports" in found["port of right"].next_step


def test_a_running_daemon_is_judged_by_its_frames(config):
    """The daemon opens a board again that it takes for silent; the pauses are no periods."""
    parser = FrameParser(PAPER_TABLE.zero_slots)
    lines = frames(silent=ELECTRODE)
    told = [parser.feed(next(lines), 540_000_000 * n)[0] for n in range(20)]
    received = [
        {"t_mono_ns": 540_000_000 * (n + 9 * (n // 5)), "channels": one.channels.astype(np.float32), "saturated": 0}
        for n, one in enumerate(told)
    ]
    rig_config = load_daemon_config(config(right={"frame_period_s": 0.1}))
    found = {one.subject: one for one in check_daemon(rig_config, {}, {"right": received})}
    assert "`fingertips.right.frame_period_s: 0.54`" in found["rate of right"].next_step
    assert "112 dead" in found["channels of right"].found
    (single, *_) = [*check_daemon(rig_config, {}, {"right": received[:1]})]
    assert single.subject == "channels of right"


def test_a_task_that_refuses_lines_has_the_cure_of_the_lines():
    refusal = "refused '0,091': not a number. A program with a decimal comma sends such lines; load the sketch"
    found = check_task("load_cell", {"alive": True, "connected": True, "errors": {"not a number": 3}, "error": refusal})
    assert "'0,091'" in found.found
    assert found.next_step == "load the sketch"
    lost = {"alive": True, "connected": False, "last_loss": f"/dev/x has sent nothing of use for 4 s: {refusal}"}
    found = check_task("load_cell", lost)
    assert (found.state, found.next_step) == ("trouble", "load the sketch")


async def test_a_gripper_that_is_not_activated_moves_before_its_next_motion_and_not_at_the_daemons_start(tmp_path):
    """The start of the daemon activates nothing."""
    server = SocketServer(UrcapSession(Gripper()))
    await server.restore()
    path = tmp_path / "rig.yaml"
    cell = {"device": {"path": str(tmp_path / "absent")}}
    gripper = {"model": "Hand-E", "socket": {"host": "127.0.0.1", "port": server.port}}
    robot_at("127.0.0.9", tmp_path)
    path.write_text(yaml.safe_dump({"load_cell": cell, "robot": "ur.yaml", "gripper": gripper}))
    try:
        found = {one.subject: one for one in await check_devices(load_daemon_config(path), SECONDS)}
    finally:
        await server.disconnect()
    assert "next motion" in found["gripper"].means
    assert "first grip" in found["gripper"].next_step
