"""Prints every estimate of a daemon on another computer: needs `pip install pyzmq msgpack`."""

from pathlib import Path

import msgpack
import zmq

KEYS = Path.home() / ".config/shearloop"


def key(file: str, name: str) -> bytes:
    """Return the 40 characters between the quotes of one line of a key file."""
    return (KEYS / file).read_text(encoding="utf-8").partition(f'{name} = "')[2][:40].encode()


socket = zmq.Context().socket(zmq.SUB)
socket.setsockopt(zmq.CURVE_SERVERKEY, key("server.key", "public-key"))
socket.setsockopt(zmq.CURVE_PUBLICKEY, key("client.key_secret", "public-key"))
socket.setsockopt(zmq.CURVE_SECRETKEY, key("client.key_secret", "secret-key"))
socket.connect("tcp://lab-pc:7761")
socket.subscribe("eit.estimate")
while True:
    message = msgpack.unpackb(socket.recv_multipart()[1])
    found = message["torque_nm"] if message["valid"] else message["reason"]
    print(message["timestamp"], message["source"], found, flush=True)
