import time
from collections.abc import Callable
from pathlib import Path

import zmq

from daemon.clock import Clock
from daemon.publisher import Publisher
from tests.daemon.conftest import DEADLINE_S


def until(is_so: Callable[[], bool]) -> None:
    """Wait for what another thread of libzmq brings about."""
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_so():
        assert time.monotonic() < deadline_s
        time.sleep(0.001)


def test_the_publisher_knows_which_topics_are_subscribed_to(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/publish"
    with zmq.Context() as context:
        publisher = Publisher(context, address, Clock())
        assert not publisher.wanted("eit.heatmap")
        with context.socket(zmq.SUB) as one, context.socket(zmq.SUB) as two:
            one.connect(address)
            two.connect(address)
            one.subscribe("eit.")
            two.subscribe("eit.heatmap")
            until(lambda: publisher.wanted("eit.heatmap") and publisher.wanted("eit.frame"))
            assert not publisher.wanted("health")
            one.unsubscribe("eit.")
            until(lambda: not publisher.wanted("eit.frame"))
            assert publisher.wanted("eit.heatmap")
        until(lambda: not publisher.wanted("eit.heatmap"))
        publisher.close()


def test_subscriptions_to_what_there_is_not_are_not_kept(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/publish"
    with zmq.Context() as context:
        publisher = Publisher(context, address, Clock())
        with context.socket(zmq.XSUB) as stranger:
            stranger.connect(address)
            for number in range(300):
                stranger.send(b"\x01eit.%d" % number)
            stranger.send(b"no subscription")
            stranger.send(b"\x01health")
            until(lambda: publisher.wanted("health"))
            assert publisher._subscribed == {b"health"}
        publisher.close()
