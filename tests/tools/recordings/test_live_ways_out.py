"""What `shearloop listen --json` prints and `shearloop view` sends to its page is what a running daemon recorded."""

import asyncio
from pathlib import Path

import pytest

from shearloop.daemon.web.message_store import CHARTED
from tests.fixtures.daemons import emulated_kit, played_at, running_daemon, shearloop
from tests.tools.recordings.every_message import Published, Recorded, latest_recording
from tests.tools.recordings.watching import Watched, watching

LAST_FRAME = 24
LISTENED = {"eit.frame", "eit.estimate", "eit.heatmap", "load.torque", "health", "daemon.end"}
# The page takes no raw frames.
NOT_PAGED = {"eit.frame"}


async def run_watched(config: Path, folder: Path) -> tuple[Published, Watched]:
    """Return what a daemon of two emulated boards published, and what was heard of it."""
    published = Published()
    async with watching(folder) as watched:
        async with running_daemon(config) as daemon:
            daemon.publisher.add_listener(lambda topic, content: published.append((topic, content)))
            await asyncio.gather(watched.listened.until("health"), watched.paged.until("health"))
            load = ("--paper-sketch", "--torque-nm", "0.08", "--speed", "5", "--link", str(folder / "load-cell"))
            async with (
                emulated_kit(folder, LAST_FRAME + 1, "--once"),
                shearloop("emulate", "hx711", *load, stdin=asyncio.subprocess.PIPE),
            ):
                await watched.listened.until("eit.estimate", frame=LAST_FRAME)
                await watched.listened.until("load.torque", seq=10)
            # A page that is opened later begins with the last minute.
            await watched.paged.until("eit.estimate", frame=LAST_FRAME)
            await watched.open_later("eit.estimate", frame=LAST_FRAME)
        await watched.until_ended()
    return published, watched


@pytest.mark.long
def test_listen_and_the_page_give_what_was_recorded(config, tmp_path):
    path = config(
        right=played_at(20),
        load_cell={"device": {"path": "load-cell"}},
        recording={"folder": str(tmp_path / "recordings")},
    )
    sent, watched = asyncio.run(run_watched(path, tmp_path))
    watched.check(Recorded(latest_recording(tmp_path / "recordings"), sent), LISTENED, NOT_PAGED)
    assert watched.listened.numbers()["eit.estimate", "right"] == [*range(LAST_FRAME + 1)]
    assert {topic for topic, _ in watched.history} == {"eit.estimate", "load.torque"}
    for topic, sample in watched.history:
        keys = ("source", "timestamp", *CHARTED[topic])
        # Readings that came in one read may be a nanosecond apart, and have one time in seconds.
        assert sample in [{key: one[key] for key in keys} for name, one in sent if name == topic], topic
