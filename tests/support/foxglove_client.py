"""A client of the Foxglove protocol, made of aiohttp and protobuf: it reads what any viewer reads."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections import defaultdict
from typing import Any

import aiohttp

from support.protobuf_topics import message_class

MESSAGE, PLAYBACK = 1, 5  # opcodes from the server
CONTROL = 3  # opcode to it


class FoxgloveClient:
    """Subscribes to all topics but those that `leaves` names the end of."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, leaves: tuple[str, ...] = ()) -> None:
        self._socket = socket
        self._leaves = leaves
        self._classes: dict[int, tuple[str, Any]] = {}
        self.info: dict[str, Any] = {}
        self.messages: dict[str, list[tuple[float, Any]]] = defaultdict(list)
        """Log time, s, and message, by topic."""
        self.states: list[tuple[int, float, float, bool, str]] = []
        """Status, time [s], speed, whether it sought, and the request."""

    @property
    def topics(self) -> set[str]:
        return {topic for topic, _ in self._classes.values()}

    def shown(self, topic: str) -> set[str]:
        """Names of the entities in the newest message of a scene."""
        messages = self.messages[topic]
        return {entity.id for entity in messages[-1][1].entities} if messages else set()

    async def subscribe(self, *topics: str) -> None:
        """To topics that are advertised."""
        numbers = [number for number, (topic, _) in self._classes.items() if topic in topics]
        wanted = [{"id": number, "channelId": number} for number in numbers]
        await self._socket.send_json({"op": "subscribe", "subscriptions": wanted})

    async def close(self) -> None:
        await self._socket.close()

    async def read(self) -> None:
        """One message."""
        message = await self._socket.receive()
        if message.type is aiohttp.WSMsgType.TEXT:
            await self._on_text(json.loads(message.data))
        elif message.type is aiohttp.WSMsgType.BINARY:
            self._on_binary(message.data)
        else:
            raise ConnectionError(message)

    async def until(self, condition) -> None:
        while not condition():
            await self.read()

    async def control(self, *, play: bool, speed: float, seek: float | None, request: str) -> None:
        head = struct.pack("<BBfBQ", CONTROL, not play, speed, seek is not None, round(1e9 * (seek or 0.0)))
        await self._socket.send_bytes(head + struct.pack("<I", len(request)) + request.encode())

    async def _on_text(self, said: dict[str, Any]) -> None:
        if said["op"] == "serverInfo":
            self.info = said
        if said["op"] == "status" and "nknown channel" in said["message"]:
            # On a busy machine the SDK advertises a channel a moment before it knows it.
            lost = {int(number) for number in re.findall(r"\d+", said["message"])}
            await self.subscribe(*(self._classes[number][0] for number in lost & set(self._classes)))
        if said["op"] != "advertise":
            return
        for channel in said["channels"]:
            schema = base64.b64decode(channel["schema"])
            self._classes[channel["id"]] = channel["topic"], message_class(channel["schemaName"], schema)
        topics = [channel["topic"] for channel in said["channels"]]
        await self.subscribe(*(topic for topic in topics if not topic.endswith(self._leaves)))

    def _on_binary(self, data: bytes) -> None:
        if data[0] == MESSAGE:
            number, t = struct.unpack_from("<IQ", data, 1)
            topic, kind = self._classes[number]
            self.messages[topic].append((1e-9 * t, kind.FromString(data[13:])))
        elif data[0] == PLAYBACK:
            status, t, speed, sought, length = struct.unpack_from("<BQfBI", data, 1)
            self.states.append((status, 1e-9 * t, speed, bool(sought), data[19 : 19 + length].decode()))
