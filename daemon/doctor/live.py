"""A daemon that runs: what its own counters say, and what it publishes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import zmq

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.doctor.devices import channels_finding, rate_finding
from shearloop.daemon.doctor.finding import Finding, good, note, trouble
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import decode
from shearloop.daemon.messaging.request import request

ANSWER_TIMEOUT_S = 1.0


@dataclass(slots=True)
class Heard:
    """What came of one topic and source."""

    times_ns: list[int] = field(default_factory=list)
    latest: Mapping[str, Any] = field(default_factory=dict)
    saturated: int = 0
    dead: int = 0

    @property
    def rate_hz(self) -> float | None:
        """How often it came, by the times that the messages speak of."""
        if len(self.times_ns) < 2 or self.times_ns[-1] == self.times_ns[0]:
            return None
        return (len(self.times_ns) - 1) * 1e9 / (self.times_ns[-1] - self.times_ns[0])


def tasks_of_daemon(address: str) -> Mapping[str, Mapping[str, Any]] | None:
    """Return what a daemon says of its tasks; None where none answers at this address."""
    try:
        reply = request(address, {"command": "status"}, ANSWER_TIMEOUT_S)
    except UserError:
        return None
    tasks = reply.get("tasks")
    return tasks if isinstance(tasks, dict) else {}


def listen(address: str, seconds: float) -> dict[tuple[str, str], Heard]:
    """Return what is published at an address of this machine in some seconds, by topic and source."""
    import time

    heard: dict[tuple[str, str], Heard] = {}
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(address)
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            if not socket.poll(int(left_s * 1000) + 1):
                continue
            topic, payload = socket.recv_multipart()[:2]
            content = decode(payload)
            one = heard.setdefault((topic.decode(), str(content.get("source"))), Heard())
            one.times_ns.append(int(content["t_mono_ns"]))
            one.latest = content
            one.saturated = max(one.saturated, int(content.get("saturated") or 0))
            one.dead = max(one.dead, int(content.get("dead") or 0))
    return heard


def examine_daemon(
    config: DaemonConfig, tasks: Mapping[str, Mapping[str, Any]], heard: Mapping[tuple[str, str], Heard]
) -> Iterator[Finding]:
    """Judge a running daemon by its tasks and by what it publishes."""
    for name, facts in tasks.items():
        yield task_finding(name, facts)
    for (topic, source), rate_hz in expected_rates(config).items():
        yield rate_finding(f"rate of {topic} {source}", heard.get((topic, source), Heard()).rate_hz, rate_hz)
    for name in config.fingertips:
        one = heard.get(("eit.frame", name))
        if one is not None:
            yield channels_finding(name, one.saturated, one.dead, len(one.times_ns))
        estimate = heard.get(("eit.estimate", name))
        if estimate is not None and estimate.latest.get("why"):
            yield note(f"estimate of {name}", "not valid", str(estimate.latest["why"]), "see docs/troubleshooting.md")
    loop = heard.get(("loop.state", "loop"))
    if loop is not None and loop.latest.get("reasons"):
        yield note("loop", str(loop.latest.get("phase")), str(loop.latest["reasons"]), "see docs/safety.md")


def task_finding(name: str, facts: Mapping[str, Any]) -> Finding:
    """Judge one task by what it counts."""
    subject = f"task {name}"
    errors = {kind: count for kind, count in (facts.get("errors") or {}).items() if count}
    counted = ", ".join(f"{count} × {kind}" for kind, count in errors.items())
    said = str(facts.get("trouble") or facts.get("last_loss") or "")
    if facts.get("alive") is False:
        return trouble(
            subject,
            f"dead, {facts.get('restarts', 0)} restarts",
            str(facts.get("last_error", "")),
            "read the daemon's log; report it when it comes back",
        )
    if facts.get("connected") is False:
        return trouble(subject, "its device is not connected", said, "see its port, cable and power")
    if facts.get("restarts"):
        return note(
            subject,
            f"alive after {facts['restarts']} restarts",
            str(facts.get("last_error", "")),
            "read the daemon's log; report it when it comes back",
        )
    if errors:
        return note(
            subject, f"alive; refused: {counted}", said or "what was refused is not used", "see docs/troubleshooting.md"
        )
    return good(subject, "alive")


def expected_rates(config: DaemonConfig) -> dict[tuple[str, str], float]:
    """Return how often each message that the configuration asks for should come."""
    rates = {("health", "daemon"): 1.0}
    for name, fingertip in config.fingertips.items():
        rates["eit.frame", name] = 1.0 / fingertip.frame_period_s
    if config.load_cell is not None:
        rates["load.torque", "load_cell"] = config.load_cell.rate_hz
    if config.skin is not None:
        rates["skin.shear", "skin"] = config.skin.daq.rate_hz
    if config.robot is not None:
        rates["robot.state", "robot"] = 25.0
    if config.gripper is not None:
        rates["gripper.state", "gripper"] = 10.0
    return rates
