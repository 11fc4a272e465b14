"""The generated pages match the code, and their programs run."""

import asyncio
import dataclasses
import re
import shutil
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import zmq

from shearloop.cli.config_schema import MODELS, schema_of
from shearloop.cli.docgen import DOCS, pages
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.faults import TABLE
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS
from shearloop.daemon.messaging.keys import load_key_pair
from shearloop.daemon.messaging.messages import TOPICS, EitEstimate, EitFrame
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.daemon.sensing.skin_task import SKIN
from shearloop.daemon.torques import LOAD_CELL, WRENCH
from tests.fixtures.daemons import DEADLINE_S, running_daemon
from tests.sample_messages import sample

PAGES = pages()


def test_the_torque_source_of_an_experiment_names_every_source_that_is_no_fingertip():
    text = ExperimentFile.model_fields["torque_source"].description or ""
    assert all(f"`{source}`" in text for source in (COMBINED, SKIN, LOAD_CELL, WRENCH))


@pytest.fixture(scope="module")
def written() -> dict[str, str]:
    """Return the generated pages by name."""
    return {path.name: text for path, text in PAGES.items()}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_generated_file_is_up_to_date(path):
    assert path.read_text(encoding="utf-8") == PAGES[path], f"{path} is out of date: run `make docs` and commit it"


@pytest.mark.parametrize("kind", MODELS)
def test_every_key_of_a_file_is_described_and_listed(written, kind):
    schema = schema_of(kind)
    for section in (schema, *schema.get("$defs", {}).values()):
        assert section["description"]
        for key, described in section["properties"].items():
            assert described["description"], key
            assert f"| `{key}` |" in written["configuration.md"]


def test_the_schema_of_a_configuration_has_units_ranges_and_defaults():
    loop = schema_of("configuration")["$defs"]["LoopConfig"]["properties"]
    assert loop["wrist_speed_rad_per_s"] == {
        "description": "largest wrist speed of the loop [rad/s]",
        "default": 0.5,
        "exclusiveMinimum": 0,
        "maximum": 3.14,
        "type": "number",
    }


def test_every_topic_and_key_is_listed(written):
    for topic, kind in TOPICS.items():
        assert f"### `{topic}`" in written["messages.md"]
        for key in (item.name for item in dataclasses.fields(kind)):
            assert f"| `{key}` |" in written["messages.md"]


def test_every_row_of_the_safety_table_is_on_the_page(written):
    for rule in TABLE.values():
        assert rule.cure in written["faults.md"]


def test_a_cure_is_right_for_a_reader_on_another_computer():
    assert not [rule.cure for rule in TABLE.values() if "this computer" in rule.cure or "this machine" in rule.cure]


@asynccontextmanager
async def printing(*command: object) -> AsyncIterator[asyncio.StreamReader]:
    """Run a program, and yield what it prints."""
    process = await asyncio.create_subprocess_exec(*map(str, command), stdout=subprocess.PIPE)
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield process.stdout
    finally:
        process.kill()
        await process.communicate()


async def next_line(printed: asyncio.StreamReader, part: bytes) -> bytes:
    """Return the next line with this part."""
    while part not in (line := await printed.readline()):
        assert line, "the program has ended"
    return line


async def subscribed(publisher: Publisher, printed: asyncio.StreamReader, line: bytes) -> None:
    """Publish an estimate of 0.25 N·m until the program has subscribed and prints it as this line."""
    seen = asyncio.create_task(next_line(printed, line))
    while not seen.done():
        publisher.publish(sample(EitEstimate, source="left", torque_nm=0.25))
        await asyncio.wait([seen], timeout=0.05)
    await seen


def program_of(ending: str, folder: Path) -> list[object]:
    """Return the command that runs an example program, with the socket in this folder as the daemon's address."""
    program = (DOCS / f"examples/subscriber.{ending}").read_text()
    script = folder / f"subscriber.{ending}"
    script.write_text(program.replace("tcp://127.0.0.1:7761", f"ipc://{folder}/publish"))
    if ending == "py":
        return [sys.executable, script]
    compiler = shutil.which("g++")
    if compiler is None or not all(Path("/usr/include", name).exists() for name in ("zmq.h", "nlohmann/json.hpp")):
        pytest.skip("needs g++, libzmq and nlohmann-json: `make system-packages` installs them")
    compiled = folder / "subscriber"
    subprocess.run([compiler, script, "-lzmq", "-o", compiled], check=True)
    return [compiled]


@pytest.mark.parametrize("ending", ["py", "cpp"])
async def test_a_subscriber_prints_whose_estimate_it_is_and_why_there_is_none(ending, tmp_path):
    command = program_of(ending, tmp_path)
    with zmq.Context() as context:
        publisher = Publisher(context, f"ipc://{tmp_path}/publish", Clock())
        try:
            async with printing(*command) as printed:
                await subscribed(publisher, printed, b" left 0.25 N\xc2\xb7m\n")
                publisher.publish(
                    sample(EitEstimate, source="right", torque_nm=None, valid=False, reason="the grip is weak")
                )
                assert (await next_line(printed, b" right ")).endswith(b" right no estimate: the grip is weak\n")
                if ending == "py":
                    publisher.publish(sample(EitFrame, source="right"))
                    await next_line(printed, b" right 5.0\n")
        finally:
            await asyncio.sleep(0)
            publisher.close()


async def test_the_subscriber_with_keys_hears_a_daemon_on_the_network(config, keys, tmp_path, monkeypatch):
    folder = tmp_path / "home/.config/shearloop"
    folder.mkdir(parents=True)
    for file in (keys / "ada/client.key_secret", keys / "keys/server.key"):
        shutil.copy(file, folder)
    curve = {"server_key": str(keys / "keys/server.key_secret"), "clients": str(keys / "keys/clients")}
    script = tmp_path / "subscriber.py"
    async with running_daemon(config(publish="tcp://0.0.0.0:*", curve=curve)) as daemon:
        address = daemon.publisher.address.replace("//0.0.0.0:", "//127.0.0.1:")
        program = (DOCS / "examples/subscriber_with_keys.py").read_text()
        script.write_text(program.replace("tcp://lab-pc:7761", address))
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        async with printing(sys.executable, script) as printed:
            await subscribed(daemon.publisher, printed, b" left 0.25\n")


def test_the_key_file_on_the_page_has_the_format_that_keys_writes(keys, written, tmp_path):
    (shown,) = re.findall(r"```text\n(# shearloop: a ZeroMQ CURVE key.*?)```", written["messages.md"], re.DOTALL)
    page = tmp_path / "page.key_secret"
    page.write_text(shown)
    page.chmod(0o600)
    pages, made = load_key_pair(page, ""), load_key_pair(keys / "ada/client.key_secret", "")
    text = (keys / "ada/client.key_secret").read_text()
    assert (
        text.replace(made.public.decode(), pages.public.decode()).replace(made.secret.decode(), pages.secret.decode())
        == shown
    )
    # Each line is explained, and a public file has the same lines but for the secret.
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.*) \|$", written["messages.md"], re.MULTILINE))
    words = [line.split()[0] for line in text.splitlines()]
    assert set(words) - {"#"} <= set(rows)
    assert [line.split()[0] for line in (keys / "ada/client.key").read_text().splitlines()] == words[:-1]
    assert f"{len(made.public)} characters" in rows["public-key"]


@pytest.mark.parametrize("name", ["subscriber.py", "subscriber.cpp", "subscriber.m"])
def test_subscribers_use_existing_topics_and_keys(name):
    """MATLAB is on no machine of ours, so what its subscriber reads is held to the schema of the messages."""
    program = (DOCS / "examples" / name).read_text()
    topics = set(re.findall(r'"((?:eit|load|skin|robot|gripper|loop)\.[a-z]*)"', program))
    assert topics
    assert all(any(topic.startswith(beginning) for topic in TOPICS) for beginning in topics)
    assert f"{PUBLISH_ADDRESS}" in program
    reads = set(re.findall(r'message\["(\w+)"\]|message\.(\w+)', program))
    named = {key.removesuffix("_shape") for pair in reads for key in pair if key}
    assert {"timestamp", "source", "torque_nm", "valid", "reason"} <= named
    known = {item.name for topic in ("eit.estimate", "eit.frame") for item in dataclasses.fields(TOPICS[topic])}
    assert named - {"timestamp", "seq"} <= known


@pytest.mark.parametrize("name", ["subscriber.py", "subscriber.cpp", "subscriber.m"])
def test_subscribers_are_short(name):
    lines = (DOCS / "examples" / name).read_text().splitlines()
    code = [line for line in lines if line.strip() and not line.lstrip().startswith(("//", "%", '"""', "#", "import"))]
    assert len(code) <= 15
    assert "eit." in "".join(code)
