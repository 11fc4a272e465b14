"""A daemon's sockets as a process of their own: says the same messages again and again, and answers commands.

What is changed in the messages stands in a file beside the sockets; what was asked is written into another.
"""

import asyncio
import dataclasses
import json
import os
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq
import zmq.asyncio

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.command_server import CommandRefusedError, CommandServer
from shearloop.daemon.messaging.messages import TOPICS, Message
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.messaging.refusals import Refusals

# Estimates and heatmaps come twice a second, all else ten times.
PUMP_S, SLOW_TURNS = 0.1, 5
SLOW = ("eit.estimate", "eit.heatmap")
RARE = ("end", "command")
CAUSE = "the torque estimate is not valid: right says nothing. Wait for the next valid estimate."
REASONS = (
    f"{CAUSE} a device's state is out of date: the gripper last reported its state 0.6 s ago. It goes on by itself. "
    "A third reason can begin with a capital."
)


def scores() -> np.ndarray:
    """A heatmap that is bright at high k and low sigma, its maximum in row 90 and column 10, and blank in a corner."""
    k, sigma = np.mgrid[0:100, 0:100]
    bright = 0.5 + 0.4 * np.exp(-((k - 90) ** 2 + (sigma - 10) ** 2) / 300)
    bright[70, 30] = 0.88
    bright[:8, -8:] = np.nan
    return np.asarray(bright)


def messages() -> dict[str, dict[str, Any]]:
    """Return the values of each message of the page, and its kind, by name."""
    text = (Path(__file__).parents[2] / "data" / "page_messages.yaml").read_text()
    found = {name: {"kind": TOPICS[given.pop("topic")], **given} for name, given in yaml.safe_load(text).items()}
    found["heatmap"]["scores"] = scores()
    for name in ("joints_rad", "tcp_pose", "wrench"):
        found["robot"][name] = tuple(found["robot"][name])
    return found


MESSAGES = messages()
EXPERIMENTS = {"/rig/experiments/hold.yaml": "hold 0.10 N·m", "/rig/experiments/loosen.yaml": "loosen"}
PLAN = [
    "plan of 'loosen', driven by right:",
    "   1  grip  closes the fingers",
    "   2  loosen  clockwise by up to 0.3 N·m",
]
REPLIES = {
    "stop": {"stopped": "hold 0.10 N·m"},
    "tare": {"taring": ["right", "load_cell"], "not_connected": ["left", "combined"]},
}
COMMANDS = ("tare", "start", "pause", "resume", "unlock", "release", "stop")


def made(given: Mapping[str, Any]) -> Message:
    """Return the message of these values; keys that the page does not show are left empty."""
    kind: type[Message] = given["kind"]
    # A replay speaks of a while ago.
    values = {**given, "t_mono_ns": given["t_mono_ns"] - round(given.get("ago_s", 0.0) * 1e9)}
    return kind(**{item.name: values.get(item.name) for item in dataclasses.fields(kind)})


def said(folder: Path) -> list[Message]:
    """Return what is to be said now: all MESSAGES with their changes, without those that are changed to nothing.

    RARE ones are said only where they are changed.
    """
    changed = json.loads((folder / "changed").read_text())["messages"]
    now_ns = Clock().now_ns()
    # A name that MESSAGES has not is one more estimate.
    given = {**dict.fromkeys(changed, MESSAGES["estimate"]), **MESSAGES}
    return [
        made({"t_mono_ns": now_ns, **values, **changed.get(name, {})})
        for name, values in given.items()
        if changed.get(name, {}) is not None and (name not in RARE or name in changed)
    ]


def pump(folder: Path) -> None:
    """Say everything again and again."""
    context = zmq.Context()
    publisher = Publisher(context, f"ipc://{folder}/publish", Clock())
    never, turn = threading.Event(), 0
    try:
        while not never.wait(PUMP_S):
            turn += 1
            for message in said(folder):
                if turn % SLOW_TURNS == 0 or message.topic not in SLOW:
                    publisher.publish(message)
    except BaseException:  # noqa: BLE001 - told, and the end of the process
        traceback.print_exc()
        # Half a daemon would keep every test waiting for its deadline.
        os._exit(1)


async def serve(folder: Path) -> None:
    """Accept every command, or refuse it with the sentence that stands in the file, or for another digest."""

    def handler(name: str) -> Callable[[Mapping[str, Any]], Any]:
        async def handle(request: Mapping[str, Any]) -> dict[str, Any]:
            told = json.loads((folder / "changed").read_text())
            plan = {"plan": PLAN} if name == "start" else {}
            question = {"question": f"Really {name}? The first motion is told.", "digest": told["digest"], **plan}
            if request.get("ask"):
                return question
            asks = ("start", "release", "unlock") if told["drops"] else ("start", "release")
            if name in asks and request.get("digest") != told["digest"]:
                raise CommandRefusedError("the file has changed", **question)
            with (folder / "asked").open("a") as asked:
                subject = str(request.get("stop", "")) or Path(request.get("experiment", "")).stem
                asked.write(" ".join(filter(None, (name, subject))) + "\n")
            if told["refusal"]:
                raise CommandRefusedError(told["refusal"])
            return REPLIES.get(name, {})

        return handle

    async def experiments(_request: Mapping[str, Any]) -> dict[str, Any]:
        if not json.loads((folder / "changed").read_text())["lists"]:
            return {"experiments": [], "configured": "", "unread": "the experiment 'hold' is running"}
        found = [{"path": path, "name": name} for path, name in EXPERIMENTS.items()]
        return {"experiments": found, "configured": next(iter(EXPERIMENTS))}

    async def status(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"tasks": {}}

    handlers = {**{name: handler(name) for name in COMMANDS}, "experiments": experiments, "status": status}
    with zmq.asyncio.Context() as context:
        await CommandServer(context, f"ipc://{folder}/commands", handlers, Refusals()).run()


def run(folder: str) -> None:
    """Say and answer until killed."""
    threading.Thread(target=pump, args=(Path(folder),), daemon=True).start()
    asyncio.run(serve(Path(folder)))
