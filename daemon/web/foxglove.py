"""Serves a daemon's messages to Foxglove, under the topics and schemas of a recording."""

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from shearloop.daemon.messaging.messages import TOPICS
from shearloop.daemon.recorder import schema
from shearloop.errors import UserError
from shearloop.extras import require


class FoxgloveServer(AbstractContextManager["FoxgloveServer", None]):
    """Foxglove's WebSocket server on loopback, as a context. A client can read and cannot send."""

    def __init__(self, port: int) -> None:
        """Listen at a port, 0 for any free one; raises UserError without foxglove-sdk and for a port in use."""
        require("foxglove", "foxglove", "a server for Foxglove")
        import foxglove

        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        try:
            self._server = foxglove.start_server(name="shearloop", port=port, context=self._context)
        except (OSError, RuntimeError) as error:
            raise UserError(f"port {port} cannot be used: {error}; give another with --foxglove") from error
        self.port = self._server.port

    def __exit__(self, *_: object) -> None:
        """Disconnect the clients."""
        self._server.stop()

    def publish(self, topic: str, content: Mapping[str, Any]) -> None:
        """Send one decoded message to the clients that subscribe to it; an unknown topic is left out."""
        if topic not in TOPICS:
            return
        name, t_ns = schema.recorded_topic(topic, content["source"]), round(content["timestamp"] * 1e9)
        shapes = {f"{key}_shape": list(value.shape) for key, value in content.items() if isinstance(value, np.ndarray)}
        if name not in self._channels:
            self._channels[name] = self._new_channel(name, topic)
        data = schema.message_json(topic, {**content, **shapes}, t_ns - content["t_mono_ns"])
        self._channels[name].log(data, log_time=t_ns)

    def _new_channel(self, name: str, topic: str) -> Any:
        import foxglove

        data = json.dumps(schema.schemas()[topic], ensure_ascii=False).encode()
        described = foxglove.Schema(name=topic, encoding="jsonschema", data=data)
        return foxglove.Channel(name, schema=described, message_encoding="json", context=self._context)
