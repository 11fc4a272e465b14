"""What people write in a configuration is answered in its own words: quotes, names, addresses, hosts and paths."""

import importlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from shearloop.cli.config_schema import MODELS, schema_of
from shearloop.daemon.config import load_daemon_config
from shearloop.drivers import name_look_up
from shearloop.drivers.errors import DriverError
from shearloop.drivers.hosts import why_no_address, why_no_host
from shearloop.drivers.ur.settings import read_settings
from shearloop.errors import UserError
from shearloop.models import as_model

PORT = "{path: port}"


def refusal(folder: Path, text: str) -> str:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError) as refused:
        load_daemon_config(path)
    return str(refused.value)


@pytest.mark.parametrize("written", ["12345670", "8551E10", "012345670", "1e5", ".5", "yes", "no", "on"])
def test_a_text_without_quotes_is_quoted_as_it_was_written(written, tmp_path):
    said = refusal(tmp_path, f"load_cell: {{device: {{serial_number: {written}}}}}\n")
    assert said.startswith(f"{tmp_path}/config.yaml:1: load_cell.device.serial_number: {written} without quotes is ")
    assert said.endswith(f'put it in quotes: "{written}"')


@pytest.mark.parametrize("written", ["yes", "true", "off"])
@pytest.mark.parametrize("section", ["loop: {kp: %s}", "load_cell: {device: {path: port}, rate_hz: %s}"])
def test_a_boolean_is_refused_where_a_number_is_expected(section, written, tmp_path):
    said = refusal(tmp_path, f"{section % written}\n")
    assert "is true or false, which YAML also reads from yes and no; write a number" in said


def test_a_boolean_for_a_number_hides_no_other_mistake(tmp_path):
    said = refusal(tmp_path, "load_cell: {device: {path: port}, rate_hz: 10}\nloop:\n  kp: yes\n  kq: 1\n  ki: -1\n")
    assert [line.rpartition("config.yaml:")[2].split(": ")[:2] for line in said.splitlines()] == [
        ["3", "loop.kp"], ["4", "loop.kq"], ["5", "loop.ki"],
    ]  # fmt: skip


def with_true(schema: Any, section: Any) -> Iterator[Any]:
    """Yield the content of a section with true in the place of one number, for each number."""
    if "$ref" in section:
        section = schema["$defs"][section["$ref"].rpartition("/")[2]]
    if section.get("type") in ("number", "integer"):
        yield True
    for one in (*section.get("anyOf", ()), *section.get("oneOf", ())):
        yield from with_true(schema, one)
    keys = dict(section.get("properties", {}))
    for described in section.get("patternProperties", {}).values():
        keys["name"] = described
    kind = {"do": keys["do"]["const"]} if "do" in keys else {}
    for key, described in keys.items():
        for value in with_true(schema, described):
            yield {**kind, key: value}
    for number, entry in enumerate(section.get("prefixItems") or filter(None, [section.get("items")])):
        for value in with_true(schema, entry):
            yield [0] * number + [value]


@pytest.mark.parametrize("kind", MODELS)
def test_every_number_of_a_file_refuses_true(kind):
    schema = schema_of(kind)
    contents = list(with_true(schema, schema))
    assert len(contents) > 5
    module, name = MODELS[kind]
    for content in contents:
        with pytest.raises(ValidationError) as refused:
            as_model(content, getattr(importlib.import_module(module), name))
        assert any(mistake["input"] == "true" for mistake in refused.value.errors()), content


@pytest.mark.parametrize("key", ["publish", "commands"])
@pytest.mark.parametrize("written", ["127.0.0.1:7762", "tcp://127.0.0.1:77620", "tcp://*:7762"])
def test_an_address_is_mended_by_the_one_that_is_named(key, written, tmp_path):
    said = refusal(tmp_path, f"load_cell: {{device: {{path: port}}}}\n{key}: {written}\n")
    (named,) = re.findall(r"tcp://127\.0\.0\.1:\d+", said.replace(f": {written}", ""))
    path = tmp_path / "config.yaml"
    path.write_text(f"load_cell: {{device: {{path: port}}}}\n{key}: {named}\n")
    assert getattr(load_daemon_config(path), key) == named


@pytest.mark.parametrize("written", ["no", "on", "True"])
def test_a_name_without_quotes_is_quoted_as_it_was_written(written, tmp_path):
    said = refusal(tmp_path, f"fingertips:\n  right: {{device: {PORT}}}\n  {written}: {{device: {PORT}}}\n")
    assert f"config.yaml:3: fingertips: the key {written} without quotes is " in said
    assert said.endswith("put it in quotes")


@pytest.mark.parametrize(
    ("written", "hint"), [("Right", "did you mean right?"), ("r t", "did you mean r_t?"), ("1", "")]
)
def test_the_form_of_a_name_is_said(written, hint, tmp_path):
    said = refusal(tmp_path, f'fingertips: {{"{written}": {{device: {PORT}}}}}\n')
    assert f"{written!r} is no name of a fingertip: a name is a lower-case letter, then up to 31" in said
    assert said.endswith(hint)


@pytest.mark.parametrize("key", ["publish", "commands"])
@pytest.mark.parametrize(
    ("address", "part"),
    [
        ("tcp://localhost:7761", "names localhost, and a socket is bound to an address: write 127.0.0.1"),
        (f"ipc:///tmp/{'a' * 120}", "has a path of 125 bytes, and a socket's has at most 107"),
        (f"ipc:///tmp/{'ä' * 60}", "has a path of 125 bytes"),
    ],
)
def test_an_address_that_cannot_be_bound_is_refused_with_the_cause(key, address, part, tmp_path):
    said = refusal(tmp_path, f"{key}: {address}\nload_cell: {{device: {PORT}}}\n")
    assert part in said
    assert "network" not in said


@pytest.mark.parametrize(
    "host",
    [
        "192.168.1.300",
        "192.168.1",
        "1.2.3.4.5",
        "",
        " ",
        "a..b",
        "192.168.1.10:30004",
        "http://arm",
        "arm ",
        "[::1]",
        "a b",
    ],
)
def test_a_host_that_is_no_address_is_refused_everywhere(host, tmp_path):
    assert why_no_host(host)
    gripper = {
        "gripper": {"model": "2F-140", "socket": {"host": host}},
        "robot": "ur.yaml",
        "load_cell": {"device": {"path": "port"}},
    }
    assert "gripper.socket.host: " in refusal(tmp_path, yaml.safe_dump(gripper))


@pytest.mark.parametrize("host", ["192.168.1.30", "robot", "robot-2.lab.example", "3com", "10.0.0.1", "::1"])
def test_names_and_addresses_are_hosts(host):
    assert why_no_host(host) == ""


@pytest.mark.parametrize("host", ["192.168.1.30", "localhost", "LocalHost.", "::1", "fe80::1%eth0"])
def test_an_address_names_one_device(host):
    assert why_no_address(host) == ""


def answer_with(*addresses: str) -> Callable[..., list[tuple[Any, ...]]]:
    """Return a look-up whose every name has these addresses."""

    def answer(*_: object, **__: object) -> list[tuple[Any, ...]]:
        if not addresses:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in addresses]

    return answer


@pytest.mark.parametrize(
    ("addresses", "cure"),
    [
        (["192.168.0.10", "192.168.0.10"], "tomorrow: write 192.168.0.10, which 'ur5.lab' means now"),
        (["192.168.0.10", "::1"], "tomorrow: write 192.168.0.10 or 127.0.0.1, which 'ur5.lab' means now"),
        ([], "tomorrow, and it cannot be looked up now: write the device's address"),
    ],
)
def test_a_robot_and_its_gripper_are_not_given_by_a_name(addresses, cure, tmp_path, monkeypatch, ran):
    monkeypatch.setattr(name_look_up.socket, "getaddrinfo", answer_with(*addresses))
    name = "is a name, which can mean another device"
    content = yaml.safe_dump({"gripper": {"model": "2F-140", "socket": {"host": "ur5.lab"}}, "robot": "ur.yaml"})
    assert f"gripper.socket.host: 'ur5.lab' {name} {cure}" in refusal(tmp_path, content)
    robot = tmp_path / "ur.yaml"
    robot.write_text(Path("config/ur.yaml").read_text().replace("host: 192.168.1.10", "host: ur5.lab"))
    with pytest.raises(DriverError, match=re.escape(f"`host` {name} {cure}")):
        read_settings(robot)
    options = ("--model", "2F-140", "--diameter-mm", 10, "--diameter-mm", 20, "--out", tmp_path / "g.cal")
    said = ran("calibrate", "gripper", "--host", "ur5.lab", *options, status=2).err
    assert f"--host: 'ur5.lab' {name} {cure}" in said


def test_a_name_server_that_does_not_answer_delays_the_message_for_a_moment(monkeypatch):
    answered = threading.Event()

    def answer_late(*_: object, **__: object) -> list[tuple[object, ...]]:
        answered.wait()
        return []

    monkeypatch.setattr(name_look_up.socket, "getaddrinfo", answer_late)
    monkeypatch.setattr(name_look_up, "RESOLVED_WITHIN_S", 0.05)
    try:
        assert why_no_address("ur5.lab").endswith("it cannot be looked up now: write the device's address")
    finally:
        answered.set()
        # Nobody waits for a late answer.
        for asking in [one for one in threading.enumerate() if one.name == "look-up"]:
            asking.join()


def test_check_names_paths_that_are_no_ports_and_no_folders(tmp_path, ran):
    (tmp_path / "file").touch()
    devices = {"right": "/dev/null", "left": str(tmp_path / "file"), "third": str(tmp_path)}
    content = {
        "fingertips": {name: {"device": {"path": path}, "calibration": "a.cal"} for name, path in devices.items()},
        "recording": {"folder": str(tmp_path / "file" / "recordings")},
    }
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    said = ran("check", path, status=2).err
    for part in (
        "`fingertips.right.device.path: /dev/null` is no serial port",
        f"`fingertips.left.device.path: {tmp_path}/file` is a file",
        f"`fingertips.third.device.path: {tmp_path}` is a folder",
        f"`recording.folder: {tmp_path}/file/recordings`: {tmp_path}/file is a file; name a folder",
    ):
        assert part in said
