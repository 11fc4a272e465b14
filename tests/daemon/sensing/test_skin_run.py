"""The skin in the daemon: real drivers, played instruments over ports and sockets, and everything that can go wrong."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from shearloop.daemon.app import Daemon
from shearloop.daemon.config import SkinConfig
from shearloop.daemon.control.action_executor import tare_all
from shearloop.daemon.sensing.skin_task import SkinTask, zero_timeout_s
from shearloop.emulators.skin import SkinInstruments
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.errors import ActionError
from tests.fixtures.daemons import ask, collector, running_daemon
from tests.running import running

CALIBRATION = Path(__file__).parents[3] / "config" / "calibrations" / "skin_demo.yaml"
RATE_HZ = 200.0


class Played:
    """The skin, its instruments, and the daemon that reads them."""

    def __init__(self, daemon: Daemon, skin: SyntheticSkin, instruments: SkinInstruments) -> None:
        self.daemon, self.skin, self.instruments = daemon, skin, instruments
        self.shear = collector(daemon, "skin.shear")

    @property
    def refused_lines(self) -> int:
        skin = self.daemon.sensors.tasks["skin"]
        errors = skin.diagnostics()["errors"]
        return int(errors.get("not a number", 0))

    async def until(self, condition: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        while True:
            content = await self.shear.get()
            if condition(content):
                return content

    async def says(self, why: str) -> dict[str, Any]:
        said: set[str] = set()
        try:
            async with asyncio.timeout(20):
                return await self.until(lambda content: said.add(content["reason"]) or why in content["reason"])
        except TimeoutError:
            pytest.fail(f"nothing says {why!r}; said was {said}")

    async def valid(self) -> dict[str, Any]:
        return await self.until(lambda content: content["valid"])

    async def command(self, name: str, **arguments: Any) -> dict[str, Any]:
        return await ask(self.daemon, name, **arguments)

    def fresh(self) -> None:
        while not self.shear.empty():
            self.shear.get_nowait()


def section(daq: dict[str, Any], **changes: Any) -> dict[str, Any]:
    content = {
        "source": {"serial": {"path": "skin-source"}},
        "daq": {**daq, "rate_hz": RATE_HZ},
        "calibration": str(CALIBRATION),
        "tool_radius_mm": 15,
    }
    return {**content, **changes}


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "skin.yaml"
    addresses = {"publish": f"ipc://{folder}/publish", "commands": f"ipc://{folder}/commands"}
    path.write_text(yaml.safe_dump({**addresses, **content}))
    return path


ADC = {"adc": {"device": {"path": "skin-daq"}}}


@contextlib.asynccontextmanager
async def played(
    folder: Path, *, socket: bool = False, average_s: float = 0.0, daemon: dict[str, Any] | None = None, **changes: Any
) -> AsyncIterator[Played]:
    skin = SyntheticSkin()
    instruments = SkinInstruments(
        skin, folder / "skin-source", ("127.0.0.1", 0) if socket else folder / "skin-daq", speed=RATE_HZ / 10
    )
    async with running(instruments.run()):
        await instruments.source_port.get()
        place = await instruments.daq_port.get()
        daq = ADC
        if socket:
            host, port = place.split(":")
            daq = {"scanner": {"socket": {"host": host, "port": int(port)}}}
        skin_section = section({**daq, "average_s": average_s}, **changes)
        async with running_daemon(written(folder, {**(daemon or {}), "skin": skin_section})) as run:
            yield Played(run, skin, instruments)


@pytest.mark.parametrize("socket", [False, True])
async def test_a_shear_force_is_streamed_from_either_daq(tmp_path, socket):
    async with played(tmp_path, socket=socket) as bench:
        content = await bench.until(lambda content: "taking the zero" in content["reason"])
        assert content["shear_n"] is None
        await bench.valid()
        for number in range(80):
            bench.skin.push(0.8 * number / 79)
            content = await bench.shear.get()
        content = await bench.until(lambda content: content["valid"] and content["response"] > 0.0603)
        assert content["shear_low_n"] - 0.02 <= 0.8 <= content["shear_high_n"] + 0.02
        assert content["torque_nm"] == pytest.approx(content["shear_n"] * 0.015)
        ends = [content[f"torque_{end}_nm"] / content[f"shear_{end}_n"] for end in ("low", "high")]
        assert ends == pytest.approx([0.015, 0.015])
        assert content["response"] == pytest.approx(content["response_1"] - content["response_2"])
        assert content["r1_ohm"] == pytest.approx(24.6 * (1 + content["response_1"]), rel=1e-3)
        assert not content["deadband"]
        assert content["direction"] in ("loading", "unknown")
        assert content["source"] == "skin"
        status = (await bench.command("status"))["tasks"]
        assert status["skin"]["connected"]
        assert status["skin.source"]["connected"]
        assert "MODEL 6430" in status["skin.source"]["instrument"]
        assert "source_lost" not in status["skin"]["errors"], "a start is no loss"


BAD = [
    ("open 1", "gauge 1 is open"),
    ("short 2", "gauge 2 is shorted"),
    ("reversed 1", "the sense wires of gauge 1 are reversed"),
    ("leads 500", "in compliance"),
    ("swapped", "the wires of the gauges are swapped"),
    ("source unplug", "the current source does not answer"),
]


async def test_no_bad_input_stops_the_daemon_and_each_is_named(tmp_path):
    async with played(tmp_path) as bench:
        await bench.valid()
        for fault, why in BAD:
            bench.instruments.command(fault)
            content = await bench.says(why)
            assert content["shear_n"] is None
            bench.instruments.command("normal")
            await bench.valid()
        for fault in ("daq garbage", "daq missing", "daq torn"):
            bench.instruments.command(fault)
        # The next opening leaves a line out, which must not be one of these.
        await bench.until(lambda _: bench.refused_lines >= 2)
        bench.instruments.command("daq unplug 0.05")
        assert (await bench.until(lambda content: content["missed"] > 3))["direction"] == "unknown"
        await bench.valid()
        tasks = (await bench.command("status"))["tasks"]
        assert {"open_1", "short_2", "reversed_1", "compliance", "source_lost"} <= set(tasks["skin"]["errors"])
        assert "load cell" not in tasks["skin"]["error"]
        assert (tasks["skin"]["restarts"], tasks["skin.source"]["restarts"]) == (0, 0)


async def test_tare_takes_the_zero_anew_and_refuses_a_loaded_one(tmp_path):
    async with played(tmp_path) as bench:
        await bench.valid()
        bench.skin.push(0.8)
        await bench.until(lambda content: (content["torque_nm"] or 0.0) > 0.01)
        # A working load of this skin, which another sensor would count as drift.
        refused = await bench.command("tare", source="skin")
        assert refused["reason"].startswith("skin measures +0.01")
        assert "--yes" not in refused["reason"], "it would cost the good zero"
        await bench.until(lambda content: content["valid"] and content["torque_nm"] > 0.01)
        # Beyond the calibrated curve there is no torque, and all the more a load.
        bench.skin.push(6.0)
        await bench.until(lambda content: "beyond the calibrated curve" in content["reason"])
        refused = await bench.command("tare", source="skin")
        assert refused["reason"].startswith("skin is loaded: R₁ ")
        assert "would look like that, which would become the zero; take the load off" in refused["reason"]
        assert "--yes" not in refused["reason"]
        bench.skin.push(0.8)
        await bench.until(lambda content: content["valid"] and content["torque_nm"] > 0.01)
        assert await bench.command("tare", source="skin", confirmed=True) == {"ok": True, "taring": ["skin"]}
        await bench.says("the zero was refused and is taken again")
        with pytest.raises(ActionError, match="the skin's zero was refused"):
            await tare_all(bench.daemon.sensors.tareable.values())
        bench.skin.push(0.0)
        bench.fresh()
        await bench.valid()
        await tare_all(bench.daemon.sensors.tareable.values())
        refused = await bench.command("tare", source="left")
        assert refused == {"ok": False, "reason": "there is no sensor 'left' to tare; there are skin"}


async def test_a_skin_without_a_radius_is_no_more_tared_under_load_than_one_with_a_radius(tmp_path):
    async with played(tmp_path, tool_radius_mm=None) as bench:
        await bench.valid()
        bench.skin.push(0.8)
        await bench.until(lambda content: (content["shear_n"] or 0.0) > 0.7)
        refused = await bench.command("tare", source="skin")
        assert refused["reason"].startswith("skin measures +0."), "a force in newtons"
        assert " N, which would become the zero; take the load off" in refused["reason"]
        await bench.valid()
        bench.skin.push(0.0)
        await bench.until(lambda content: content["valid"] and abs(content["shear_n"]) < 0.1)
        assert await bench.command("tare", source="skin") == {"ok": True, "taring": ["skin"]}


async def test_a_zero_that_cannot_be_taken_says_why_in_time(tmp_path, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.sensing.skin_task.ZERO_TIMEOUT_S", 0.3)
    async with played(tmp_path) as bench:
        await bench.valid()
        bench.instruments.command("open 2")
        await bench.says("gauge 2 is open")
        with pytest.raises(ActionError, match=r"could not be taken within 0\.3 s.*gauge 2 is open"):
            await tare_all(bench.daemon.sensors.tareable.values())
        bench.instruments.command("normal")
        await bench.says("no zero: it took too long")


async def test_a_zero_that_the_operator_asked_for_is_not_taken_at_the_load_of_a_later_hour(tmp_path, monkeypatch, log):
    monkeypatch.setattr("shearloop.daemon.sensing.skin_task.ZERO_TIMEOUT_S", 0.3)
    async with played(tmp_path) as bench:
        await bench.valid()
        skin = bench.daemon.sensors.tareable["skin"]
        bench.instruments.command("open 2")
        await bench.says("gauge 2 is open")
        assert (await bench.command("tare", source="skin"))["ok"]
        assert skin.taring
        await bench.until(lambda _: not skin.taring)
        bench.instruments.command("normal")
        await bench.says("no zero: it took too long")
        # The source may report its own limit first: an open gauge interrupts its current.
        (why,) = (said for said in log.said if said.startswith("the skin's zero could not be taken within 0.3 s: "))
        assert "gauge 2 is open" in why
        assert (await bench.command("tare", source="skin"))["ok"]
        await bench.valid()


async def test_a_zero_that_no_sample_comes_for_ends_in_log_and_status(log):
    config = SkinConfig.model_validate(section(ADC))
    clock = SimpleNamespace(t_ns=10**9)
    clock.now_ns = lambda: clock.t_ns
    skin = SkinTask(config, SimpleNamespace(), clock)
    skin.tare()
    assert skin.diagnostics()["error"] == ""
    clock.t_ns += round(zero_timeout_s(config) * 1e9) + 1
    why = f"the skin's zero could not be taken within {zero_timeout_s(config):.3g} s: nothing came"
    for _ in range(2):
        assert skin.diagnostics()["error"] == why
    assert log.said == [why]


async def test_a_drift_that_two_zeros_show_is_said_in_status_and_log(tmp_path, monkeypatch, log):
    monkeypatch.setattr("shearloop.daemon.sensing.skin_drift.SHORTEST_S", 0.0)
    async with played(tmp_path) as bench:
        await bench.valid()
        bench.skin.push(0.22)
        await bench.until(lambda content: content["valid"] and content["response"] > 0.015)
        assert (await bench.command("tare", source="skin"))["ok"]
        await bench.until(lambda content: content["valid"] and abs(content["response"]) < 0.005)
        skin = (await bench.command("status"))["tasks"]["skin"]
        assert skin["drift_per_hour"] > 0.001
        assert skin["error"].startswith("the skin drifts, or a zero was taken under load")
        assert skin["error"] in "\n".join(log.said)


async def test_one_daemon_carries_a_fingertip_and_a_skin(config):
    async with running_daemon(config(skin=section(ADC))) as daemon:
        health = collector(daemon, "health")
        tasks = (await health.get())["tasks"]
        assert all(tasks[name]["alive"] for name in ("right", "skin", "skin.source"))
        assert "There is no serial port" in tasks["skin"]["last_loss"], "without its instruments the daemon runs on"


SCANNER = {"scanner": {"socket": {"host": "127.0.0.1", "port": 5025}}}
SOCKET = {"socket": {"host": "127.0.0.1", "port": 5025}}
SOURCE = {"serial": {"path": "skin-source"}}
HOLDS = str(Path(__file__).parents[3] / "config" / "experiments" / "skin_hold_shear.yaml")
ROBOT = str(Path(__file__).parents[3] / "config" / "demo_ur.yaml")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({}, "nothing is measured: give `fingertips`, a `skin` or a `load_cell`"),
        ({"skin": section({**ADC, **SCANNER})}, "skin.daq: give either scanner or adc, with a value, and not both"),
        ({"skin": section({})}, "skin.daq: give either scanner or adc, with a value, and not both"),
        ({"skin": section(ADC, source={})}, "skin.source: give either socket or serial"),
        ({"skin": section(ADC, source={"serial": {}})}, "skin.source.serial: give either serial_number or path"),
        ({"skin": section(ADC, source={"socket": {"host": "a"}})}, "skin.source.socket.port: is missing"),
        ({"skin": section(ADC, normal_n=-1)}, "skin.normal_n: -1 is too small"),
        ({"skin": section(ADC, normal_N=1)}, "skin.normal_N: is not a known key; did you mean normal_n?"),
        ({"skin": section(ADC, tool_radius_mm=-15)}, "skin.tool_radius_mm: -15 is too small"),
        ({"skin": section(ADC, source={**SOURCE, "current_ma": 50})}, "skin.source.current_ma: 50 is too large"),
        (
            {"skin": section(ADC, source={**SOURCE, "current_ma": 7})},
            "`skin.source.current_ma`: 7 mA warm a gauge of 25.3 Ω by 5.9 K, more than the 5 K that are allowed",
        ),
        (
            {"skin": section(ADC, source={**SOURCE, "current_ma": 0.001})},
            "0.001 mA make 0.025 mV of a gauge at rest, less than the 3 mV that can be read well enough; take 5",
        ),
        (
            {"skin": section(ADC, normal_n=100)},
            "`skin.normal_n`: 100 N hide 6.7 N of shear by friction, and the calibration ends at 5.2 N; give the",
        ),
        (
            {"skin": section(ADC, source={**SOURCE, "compliance_v": 0.2})},
            "5 mA need 0.31 V at the end of the calibration, and `skin.source.compliance_v` is 0.2",
        ),
        (
            {"skin": section({"adc": {**ADC["adc"], "full_scale_v": 0.15}})},
            "5 mA make 0.19 V of a gauge at the end of the calibration, and `skin.daq.adc.full_scale_v` is 0.15",
        ),
        (
            {"skin": section({"scanner": {**SCANNER["scanner"], "range_v": 0.1}})},
            "5 mA make 0.19 V of a gauge at the end of the calibration, and `skin.daq.scanner.range_v` is 0.1",
        ),
        (
            {"skin": section({"scanner": {**SCANNER["scanner"], "channels": [101, 101]}})},
            "skin.daq.scanner: gives both gauges the channel 101",
        ),
        (
            {"skin": section({"adc": {"device": {"path": "./skin-source"}}})},
            "`skin.source.serial` and `skin.daq.adc.device` are both the port FOLDER/skin-source; each device",
        ),
        (
            {"skin": section(SCANNER, source=SOCKET)},
            "`skin.source.socket` and `skin.daq.scanner.socket` are both 127.0.0.1:5025",
        ),
        (
            {"skin": section(ADC), "load_cell": {"device": {"path": "skin-daq"}}},
            "`skin.daq.adc.device` and `load_cell.device` are both the port FOLDER/skin-daq",
        ),
        (
            {"skin": section(ADC, tool_radius_mm=None), "robot": ROBOT, "experiment": HOLDS},
            "torque_source: `skin` has no torque without a radius: add `skin.tool_radius_mm`; no other can drive",
        ),
        ({"skin": section(ADC, calibration="none.yaml")}, "none.yaml: the calibration cannot be read: No such file"),
        ({"skin": section(ADC, calibration=ROBOT)}, "is not a calibration as `shearloop skin calibrate` writes it: it"),
    ],
)
def test_a_mistake_in_the_skin_s_section_is_one_sentence_and_status_2(tmp_path, content, sentence, mistake, request):
    if "experiment" in content:
        request.getfixturevalue("ur_rtde")
    path = written(tmp_path, content)
    for command in ("check", "run"):
        said = mistake(command, path)
        assert sentence.replace("FOLDER", str(tmp_path)) in said
        assert said.count("\n") == 1, "one line"
