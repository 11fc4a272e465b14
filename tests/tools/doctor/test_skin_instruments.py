"""The doctor asks the skin's instruments for their names, on sockets as on serial ports."""

import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import yaml

from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.emulators.ports import SocketServer
from shearloop.emulators.skin import Circuit, EmulatedKeithley6430, EmulatedScanner
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.tools.doctor import devices
from shearloop.tools.doctor.findings import Finding
from tests.fixtures.daemons import free_port
from tests.running import running

CALIBRATION = Path(__file__).parents[3] / "config" / "calibrations" / "skin_demo.yaml"


def config_of(folder: Path, source_port: int, scanner_port: int) -> DaemonConfig:
    source, scanner = ({"socket": {"host": "127.0.0.1", "port": port}} for port in (source_port, scanner_port))
    skin = {"source": source, "daq": {"scanner": scanner}, "calibration": str(CALIBRATION)}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump({"skin": skin}))
    return load_daemon_config(path)


@contextlib.asynccontextmanager
async def two_instruments() -> AsyncIterator[tuple[Circuit, SocketServer, SocketServer]]:
    circuit = Circuit(SyntheticSkin())
    source, scanner = SocketServer(EmulatedKeithley6430(circuit)), SocketServer(EmulatedScanner(circuit))
    async with running(source.run(), scanner.run()):
        for server in (source, scanner):
            await server.appearances.get()
        yield circuit, source, scanner


async def found(config: DaemonConfig) -> dict[str, Finding]:
    return {finding.subject: finding for finding in await devices.check_devices(config, 0.1)}


async def test_instruments_that_answer_are_named_and_no_current_flows(tmp_path):
    async with two_instruments() as (circuit, source, scanner):
        findings = await found(config_of(tmp_path, source.port, scanner.port))
        assert not circuit.output_on
    assert [finding.state for finding in findings.values()] == ["good", "good"]
    assert "MODEL 6430" in findings["skin's source"].found
    assert "34972A" in findings["skin's scanner"].found


async def test_where_nothing_listens_both_are_in_trouble(tmp_path):
    findings = await found(config_of(tmp_path, free_port(), free_port()))
    assert {subject: finding.state for subject, finding in findings.items()} == {
        "skin's source": "trouble",
        "skin's scanner": "trouble",
    }
    assert all("Nothing answers at 127.0.0.1:" in finding.found for finding in findings.values())
    assert all(finding.next_step for finding in findings.values())


@pytest.mark.parametrize("silent", ["source", "scanner"])
async def test_an_instrument_that_accepts_and_says_nothing_is_in_trouble(tmp_path, silent):
    async with two_instruments() as (_, source, scanner):
        {"source": source, "scanner": scanner}[silent].command("silence")
        findings = await found(config_of(tmp_path, source.port, scanner.port))
    assert "has not answered '*IDN?'" in findings[f"skin's {silent}"].found
    assert [finding.state for finding in findings.values()].count("trouble") == 1


async def test_another_instrument_at_the_source_s_address_is_in_trouble(tmp_path):
    async with two_instruments() as (_, source, scanner):
        findings = await found(config_of(tmp_path, scanner.port, source.port))
    assert "says it is 'Agilent" in findings["skin's source"].found
