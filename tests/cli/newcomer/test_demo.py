"""The demo of the README: what it prepares, and its run under the eyes of the live page."""

import asyncio
import json
import re
from typing import Any

import pytest

from tests.cli.newcomer.conftest import PROGRAM, readme_commands
from tests.fixtures.daemons import DEADLINE_S

# On a busy computer the commands take several times as long.
pytestmark = pytest.mark.timeout(240)
FIGURES = re.compile(r"run/(\S+): root mean square errors (\S+) N·m .*; (\d+)% of .*, (\d+)% of torques lie")


def test_the_demo_prepares_all_that_its_configuration_names(tree, ran, monkeypatch):
    printed = tree.shell(f"{PROGRAM} demo --folder . --prepare").stdout
    figures = {name: list(map(float, values)) for name, *values in FIGURES.findall(printed)}
    assert set(figures) == {"rig.cal", "rig-right.cal", "rig-left.cal"}
    for rmse_nm, valid, covered in figures.values():
        assert rmse_nm < 0.05
        assert valid > 70
        assert covered > 85
    assert figures["rig.cal"][0] < 0.01
    monkeypatch.chdir(tree.root)
    assert "config/demo.yaml is in order" in ran("check", "config/demo.yaml").out
    assert not ran("demo", "--folder", ".", "--prepare").out, "what is there is kept"


async def seen_on_the_page(address: str, topics: set[str]) -> dict[str, Any]:
    """Return the latest message of each topic, as the page is sent them, the estimate being a valid one."""
    import aiohttp

    latest: dict[str, Any] = {}
    async with asyncio.timeout(2 * DEADLINE_S), aiohttp.ClientSession() as http:
        async with http.get(address) as page:
            assert "<html" in await page.text()
        async with http.ws_connect(f"{address}stream") as stream:
            async for batch in stream:
                for message in batch.json()["messages"]:
                    if message["topic"] != "eit.estimate" or message["content"]["valid"]:
                        latest[message["topic"]] = message["content"]
                if topics <= set(latest):
                    break
    return latest


@pytest.mark.real_time
def test_the_demo_holds_a_torque_and_its_page_shows_it(prepared_tree):
    pytest.importorskip("aiohttp", reason="the live view needs the extra `view`")
    tree, run = prepared_tree, readme_commands()[0]
    view = f"{PROGRAM} view --connect ipc://{tree.root}/publish --commands ipc://{tree.root}/commands --port 0 --json"
    with tree.started(run) as demo, tree.started(view) as viewer:
        address = json.loads(viewer.stdout.readline())["url"]
        wanted = {"eit.estimate", "load.torque", "robot.state", "gripper.state", "loop.state", "health"}
        seen = asyncio.run(seen_on_the_page(address, wanted))
        assert demo.wait() == 0, tree.log.read_text()
    assert seen["loop.state"]["experiment"] == "hold 0.10 N·m"
    assert "phase=done reason=" in tree.log.read_text()
