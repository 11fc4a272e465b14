import asyncio
import errno
import logging
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
import zmq
import zmq.asyncio

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.client import Subscriber, receive_messages
from shearloop.daemon.messaging.messages import TOPICS, EitFrame, LoadTorque, decode, encode
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.errors import UserError
from tests.fixtures.daemons import DEADLINE_S
from tests.sample_messages import sample

Connect = Callable[..., "zmq.Socket[bytes]"]


def until(is_so: Callable[[], bool]) -> None:
    """Wait for what another thread of libzmq brings about."""
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_so():
        assert time.monotonic() < deadline_s
        time.sleep(0.001)


@pytest.fixture
def publisher(tmp_path) -> Iterator[Publisher]:
    with zmq.Context() as context, closing(Publisher(context, f"ipc://{tmp_path}/publish", Clock())) as bound:
        yield bound


@pytest.fixture
def connect(tmp_path) -> Iterator[Connect]:
    """Connects a socket to the publisher, with a subscription."""
    with zmq.Context() as context:

        def connected(*topics: str, kind: int = zmq.SUB) -> "zmq.Socket[bytes]":
            client = context.socket(kind)
            client.setsockopt(zmq.RCVTIMEO, DEADLINE_S * 1000)
            client.connect(f"ipc://{tmp_path}/publish")
            for topic in topics:
                client.subscribe(topic)
            return client

        yield connected


def test_the_publisher_knows_the_subscribed_topics(publisher, connect):
    assert not publisher.has_subscriber("eit.heatmap")
    with connect("eit.") as one, connect("eit.heatmap"):
        until(lambda: publisher.has_subscriber("eit.heatmap") and publisher.has_subscriber("eit.frame"))
        assert not publisher.has_subscriber("health")
        one.unsubscribe("eit.")
        until(lambda: not publisher.has_subscriber("eit.frame"))
        assert publisher.has_subscriber("eit.heatmap")
    until(lambda: not publisher.has_subscriber("eit.heatmap"))


def test_an_unsendable_message_does_not_affect_the_next(publisher, connect):
    with connect("health") as subscriber:
        until(lambda: publisher.has_subscriber("health"))
        with pytest.raises(TypeError):
            publisher.forward("health", {"what": object()})
        publisher.forward("health", {"number": 1})
        topic, *payload = subscriber.recv_multipart()
        assert (topic, list(map(decode, payload))) == (b"health", [{"number": 1}])


def test_subscriptions_to_unknown_topics_are_not_kept(publisher, connect):
    with connect(kind=zmq.XSUB) as stranger:
        for number in range(100):
            stranger.send(b"\x01eit.%d" % number)
        stranger.send(b"no subscription")
        stranger.send(b"\x01health")
        until(lambda: publisher.has_subscriber("health"))
        assert publisher.prefixes == (b"health",)


def test_subscribers_come_and_go_while_messages_are_sent(publisher, connect):
    for _ in range(100):
        publisher.publish(sample(LoadTorque))
    with connect("load.") as one:
        until(lambda: publisher.has_subscriber("load.torque"))
        assert not publisher.has_subscriber("health")
        publisher.publish(sample(LoadTorque))
        topic, payload = one.recv_multipart()
        assert topic == b"load.torque"
        assert decode(payload)["seq"] == 100, "messages without a subscriber are numbered too"
        with connect("health"):
            publisher.publish(sample(LoadTorque))
            until(lambda: publisher.has_subscriber("health"))
        until(lambda: not publisher.has_subscriber("health"))
    until(lambda: not publisher.has_subscribers())


def test_a_subscriber_is_warned_once_and_receives_a_later_daemon(tmp_path, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.messaging.client.QUIET_S", 0.02)
    address, warnings = f"ipc://{tmp_path}/publish", []
    content = {"timestamp": 1.0, "t_mono_ns": 2, "source": "daemon"}
    with zmq.Context() as context, context.socket(zmq.XPUB) as late:
        late.setsockopt(zmq.RCVTIMEO, 10_000)

        def comes(sentence: str) -> None:
            warnings.append(sentence)
            late.bind(address)
            assert late.recv() == b"\x01health"
            for seq in range(2):
                late.send_multipart([b"health", encode({**content, "seq": seq})])

        with closing(receive_messages(address, ["health"], on_quiet=comes)) as heard:
            assert [next(heard)[1]["seq"] for _ in range(2)] == [0, 1]
    assert warnings == [f"no message came from {address} in 0.02 s; waiting. Is a daemon running there?"]


@pytest.mark.parametrize("with_asyncio", [False, True])
def test_a_subscriber_without_a_daemon_says_that_it_waits(with_asyncio, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("shearloop.daemon.messaging.client.QUIET_S", 0.02)
    address = f"ipc://{tmp_path}/publish"
    with zmq.Context() as context, context.socket(zmq.XPUB) as late, Subscriber(address, ["health"]) as subscriber:

        def comes(record: logging.LogRecord) -> bool:
            # asyncio logs too.
            if not record.name.startswith("shearloop"):
                return False
            late.bind(address)
            late.recv()
            content = {"timestamp": 1.0, "t_mono_ns": 2, "source": "daemon", "seq": 0}
            late.send_multipart([b"health", encode(content)])
            return True

        late.setsockopt(zmq.RCVTIMEO, 10_000)
        caplog.handler.addFilter(comes)
        try:
            topic, _ = asyncio.run(anext(subscriber)) if with_asyncio else next(subscriber)
        finally:
            # All tests share the handler.
            caplog.handler.removeFilter(comes)
    assert topic == "health"
    assert [record.getMessage() for record in caplog.records] == [
        f"no message came from {address} in 0.02 s; waiting. Is a daemon running there?"
    ]


async def test_a_subscriber_is_iterated_with_and_without_asyncio(publisher, tmp_path):
    address = f"ipc://{tmp_path}/publish"
    with (
        Subscriber(address, ["health", "load."], DEADLINE_S) as one,
        Subscriber(address, timeout_s=DEADLINE_S) as every,
        Subscriber(address, ["skin."], timeout_s=0.01) as silent,
    ):
        # Only `every` receives frames.
        until(lambda: publisher.has_subscriber("eit.frame") and publisher.prefixes.count(b"load.") == 1)
        for _ in range(2):
            publisher.publish(sample(EitFrame))
            publisher.publish(sample(LoadTorque))
        assert one.wait(DEADLINE_S)
        topic, content = next(one)
        assert (topic, content["seq"], content["torque_nm"]) == ("load.torque", 0, 0.5)
        topic, content = await anext(one)
        assert (topic, content["seq"]) == ("load.torque", 1)
        received = [next(every) for _ in range(2)] + [await anext(every) for _ in range(2)]
        assert [topic for topic, _ in received] == ["eit.frame", "load.torque"] * 2
        assert received[0][1]["channels"].shape == (2, 3)
        with pytest.raises(UserError, match=r"no message came from .* for 0.01 s"):
            next(silent)
        with pytest.raises(UserError, match=r"no message came from .* for 0.01 s"):
            await anext(silent)
    until(lambda: not publisher.has_subscribers())


def test_one_topic_may_be_given_alone_and_nothing_else_is_received(publisher, tmp_path):
    address = f"ipc://{tmp_path}/publish"
    with Subscriber(address, "load.torque", DEADLINE_S) as one, Subscriber(address, "load", DEADLINE_S) as part:
        until(lambda: not publisher.has_subscriber("eit.frame") and {*publisher.prefixes} == {b"load.", b"load.torque"})
        publisher.publish(sample(EitFrame))
        publisher.publish(sample(LoadTorque))
        assert [next(one)[0], next(part)[0]] == ["load.torque"] * 2


def test_no_topic_begins_with_another():
    # ZeroMQ would send both to a subscriber of the shorter one.
    assert [(one, other) for one in TOPICS for other in TOPICS if one != other and other.startswith(one)] == []


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        (["skin.sheer"], "there is no topic 'skin.sheer'; did you mean skin.shear? The topics are eit.frame"),
        ("loa", "there is no topic 'loa'"),
        ("load.torque.x", "there is no topic 'load.torque.x'; did you mean load.torque?"),
        ([""], "there is no topic ''"),
        ([7], "7 is no topic; give the name of one, such as 'eit.frame'"),
        ([b"eit"], "b'eit' is no topic; give the name of one, such as 'eit.frame'"),
        (None, "topics is None; give the name of a topic, such as 'eit.frame', or a list of names, or leave it out"),
        (b"eit", "topics is b'eit'; give the name of a topic, such as 'eit.frame', or a list of names, or leave it"),
        (7, "topics is 7; give the name of a topic, such as 'eit.frame', or a list of names, or leave it out"),
    ],
)
def test_a_topic_that_does_not_exist_is_refused_at_once(topics, said, tmp_path):
    with pytest.raises(UserError) as refused:
        Subscriber(f"ipc://{tmp_path}/publish", topics)
    assert str(refused.value).startswith(said)


@pytest.mark.parametrize("address", [None, 7761, b"tcp://127.0.0.1:7761"])
def test_an_address_that_is_no_text_is_refused(address):
    with pytest.raises(UserError) as refused:
        Subscriber(address)
    assert str(refused.value) == f"{address!r} is no address; it looks like tcp://127.0.0.1:7761"


@pytest.mark.parametrize("timeout_s", [float("nan"), float("inf"), -1.0, 0.0, "5"])
def test_a_time_that_nobody_can_wait_is_refused(timeout_s, tmp_path):
    with pytest.raises(UserError, match=r"timeout_s is .*; give seconds above 0 .*or None to wait without end"):
        Subscriber(f"ipc://{tmp_path}/publish", timeout_s=timeout_s)
    if timeout_s != 0:
        with Subscriber(f"ipc://{tmp_path}/publish") as subscriber, pytest.raises(UserError, match="timeout_s is"):
            subscriber.wait(timeout_s)


@pytest.mark.parametrize("with_asyncio", [False, True])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (zmq.XPUB, "a daemon is there and publishes no skin.shear now"),
        (
            zmq.ROUTER,
            "the program there does not publish to this client; give the address of the daemon's `publish` key",
        ),
        (None, "no daemon publishes there; start it with `shearloop run CONFIG`, or give the address"),
    ],
)
def test_a_subscriber_in_vain_names_the_cause(kind, said, with_asyncio, tmp_path):
    address = f"ipc://{tmp_path}/publish"
    with zmq.Context() as context, context.socket(zmq.XPUB if kind is None else kind) as bound:
        if kind is not None:
            bound.bind(address)
        with Subscriber(address, ["skin.shear"], 0.01) as subscriber, pytest.raises(UserError) as failed:
            _ = asyncio.run(anext(subscriber)) if with_asyncio else next(subscriber)
        with pytest.raises(UserError) as of_command:
            next(receive_messages(address, ["skin.shear"], 0.01))
    assert str(failed.value).startswith(f"no message came from {address} for 0.01 s: {said}")
    assert "--" not in str(failed.value)
    assert ("--connect" in str(of_command.value)) == (kind != zmq.XPUB)


async def test_an_ipc_path_that_is_removed_while_it_is_looked_at_is_bound(tmp_path, monkeypatch):
    path = tmp_path / "publish"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))

    def removed(_path: str) -> int:
        path.unlink()
        return errno.ENOENT

    monkeypatch.setattr("shearloop.daemon.messaging.bound_sockets.probe", removed)
    with zmq.asyncio.Context() as context:
        Publisher(context, f"ipc://{path}", Clock()).close()
