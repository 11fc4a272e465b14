"""Prints every estimate of a daemon on this machine: needs `pip install pyzmq msgpack numpy`."""

import msgpack
import numpy as np
import zmq

socket = zmq.Context().socket(zmq.SUB)
socket.connect("tcp://127.0.0.1:7761")
socket.subscribe("eit.")
while True:
    topic, payload = socket.recv_multipart()
    message = msgpack.unpackb(payload)
    if topic == b"eit.estimate" and message["valid"]:
        print(message["timestamp"], message["source"], message["torque_nm"], "N·m", flush=True)
    elif topic == b"eit.estimate":
        print(message["timestamp"], message["source"], "no estimate:", message["reason"], flush=True)
    elif topic == b"eit.frame":
        channels = np.frombuffer(message["channels"], "<f4").reshape(message["channels_shape"])
        print(message["timestamp"], message["source"], channels.max(), flush=True)
