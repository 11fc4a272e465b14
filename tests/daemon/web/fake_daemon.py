"""A daemon's sockets as a process of their own: says the same messages again and again, and answers commands.

What is changed in the messages stands in a file beside the sockets; what was asked is written into another.
"""

import asyncio
import dataclasses
import json
import os
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zmq
import zmq.asyncio

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.command_server import CommandRefusedError, CommandServer
from shearloop.daemon.messaging.keys import Refusals
from shearloop.daemon.messaging.messages import (
    EitEstimate,
    EitHeatmap,
    GripperStateMessage,
    Health,
    LoadTorque,
    LoopState,
    Message,
    RobotStateMessage,
    SkinShear,
)
from shearloop.daemon.messaging.publisher import Publisher

# Estimates and heatmaps come twice a second, all else ten times.
PUMP_S, SLOW_TURNS = 0.1, 5
SLOW = ("eit.estimate", "eit.heatmap")
REASONS = (
    "the torque estimate is not valid: right says nothing. Wait for the next valid estimate. "
    "a device's state is out of date: the gripper last reported its state 0.6 s ago. It goes on by itself."
)


def scores() -> np.ndarray:
    """A heatmap that is bright at high k and low sigma, its maximum in row 90 and column 10, and blank in a corner."""
    k, sigma = np.mgrid[0:100, 0:100]
    bright = 0.5 + 0.4 * np.exp(-((k - 90) ** 2 + (sigma - 10) ** 2) / 300)
    bright[70, 30] = 0.88
    bright[:8, -8:] = np.nan
    return np.asarray(bright)


MESSAGES: Mapping[str, Mapping[str, Any]] = {
    "estimate": {
        "kind": EitEstimate,
        "source": "right",
        "torque_nm": 0.09876,
        "torque_low_nm": 0.07123,
        "torque_high_nm": 0.12629,
        "diameter_mm": 20.43,
        "diameter_low_mm": 18.21,
        "diameter_high_mm": 22.65,
        "k": 3.514,
        "sigma": 1.627,
        "score": 0.93412,
        "runner_up": 0.92187,
        "valid": True,
        "reason": "",
        "frame": 417,
        "latency_s": 0.0124,
    },
    "heatmap": {
        "kind": EitHeatmap,
        "source": "right",
        "scores": scores(),
        "k_low": 0.1,
        "k_high": 4.4,
        "sigma_low": 0.1,
        "sigma_high": 4.4,
        "model": "gaussian_derivative",
        "frame": 417,
    },
    "load": {
        "kind": LoadTorque,
        "source": "load_cell",
        "torque_nm": 0.10123,
        "raw": 8123.0,
        "saturated": False,
        "spike": False,
        "valid": True,
        "reason": "",
    },
    "shear": {
        "kind": SkinShear,
        "source": "skin",
        "shear_n": -1.2346,
        "shear_low_n": -1.3511,
        "shear_high_n": -1.1182,
        "torque_nm": None,
        "response": -0.10864,
        "response_1": 0.0,
        "response_2": 0.1086,
        "r1_ohm": 25.123,
        "r2_ohm": 27.846,
        "deadband": False,
        "direction": "loading",
        "valid": True,
        "reason": "",
        "sample": 9,
        "missed": 0,
        "latency_s": 0.001,
    },
    "robot": {
        "kind": RobotStateMessage,
        "source": "robot",
        "joints_rad": (0.0,) * 6,
        "tcp_pose": (-0.4921, -0.1333, 0.4876, 0.0, 0.0, 0.0),
        "wrench": (0.0,) * 6,
        "wrist_rad": 0.1476,
        "wrist_speed_rad_per_s": -0.0124,
        "wrist_torque_nm": -0.1023,
        "robot_mode": 7,
        "safety_mode": 1,
        "speed_scaling": 0.75,
        "protective_stop": False,
        "emergency_stop": False,
        "blocked": "",
        "age_s": 0.002,
    },
    "gripper": {
        "kind": GripperStateMessage,
        "source": "gripper",
        "width_mm": 19.68,
        "diameter_mm": 19.68,
        "diameter_std_mm": 3.04,
        "current_ma": 270.0,
        "object": "contact closing",
        "fault": 0,
        "fault_text": "",
    },
    "loop": {
        "kind": LoopState,
        "source": "loop",
        "phase": "running",
        "experiment": "hold 0.10 N·m",
        "step": 6,
        "steps": 7,
        "activity": "holding",
        "progress": 0.62,
        "remaining_s": 38.4,
        "torque_source": "right",
        "torque_nm": 0.0988,
        "set_point_nm": 0.1,
        "ramp_nm": 0.0875,
        "expected_nm": 0.098,
        "speed_command_rad_per_s": 0.0312,
        "speed_sent_rad_per_s": 0.0201,
        "response": "note",
        "reasons": "",
    },
    "health": {
        "kind": Health,
        "source": "daemon",
        "tasks": {
            "right": {
                "alive": True,
                "restarts": 2,
                "last_error": "",
                "rate_hz": 1.8479,
                "expected_hz": 1.85,
                "errors": {"wrong length": 3, "not a number": 1},
                "error": "look at the cable",
            },
            "loop": {"alive": False, "done": False, "restarts": 1, "last_error": "RuntimeError: a bug"},
            "experiment": {"alive": False, "done": True, "restarts": 0, "last_error": ""},
        },
        "loop_lag_s": 0.0013,
        "memory_mb": 142.3,
        "cpu_percent": 6.04,
    },
}


COMMANDS = ("tare", "start", "pause", "resume", "unlock", "stop")


def made(given: Mapping[str, Any]) -> Message:
    """Return the message of these values; keys that the page does not show are left empty."""
    kind: type[Message] = given["kind"]
    # A replay speaks of a while ago.
    values = {**given, "t_mono_ns": given["t_mono_ns"] - round(given.get("ago_s", 0.0) * 1e9)}
    return kind(**{item.name: values.get(item.name) for item in dataclasses.fields(kind)})


def said(folder: Path) -> list[Message]:
    """Return what is to be said now: all MESSAGES with their changes, without those that are changed to nothing."""
    changed = json.loads((folder / "changed").read_text())["messages"]
    now_ns = Clock().now_ns()
    # A name that MESSAGES has not is one more estimate.
    given = {**dict.fromkeys(changed, MESSAGES["estimate"]), **MESSAGES}
    return [
        made({"t_mono_ns": now_ns, **values, **changed.get(name, {})})
        for name, values in given.items()
        if changed.get(name, {}) is not None
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
    """Accept every command, or refuse it with the sentence that stands in the file."""

    def handler(name: str) -> Callable[[Mapping[str, Any]], Any]:
        async def handle(_: Mapping[str, Any]) -> dict[str, Any]:
            with (folder / "asked").open("a") as asked:
                asked.write(f"{name}\n")
            refusal = json.loads((folder / "changed").read_text())["refusal"]
            if refusal:
                raise CommandRefusedError(refusal)
            return {"stopped": "hold 0.10 N·m"} if name == "stop" else {}

        return handle

    with zmq.asyncio.Context() as context:
        await CommandServer(
            context, f"ipc://{folder}/commands", {name: handler(name) for name in COMMANDS}, Refusals()
        ).run()


if __name__ == "__main__":
    place = Path(sys.argv[1])
    threading.Thread(target=pump, args=(place,), daemon=True).start()
    asyncio.run(serve(place))
