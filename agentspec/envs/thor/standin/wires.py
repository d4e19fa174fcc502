"""The two protocols, from the simulator's side: messages through named pipes, and HTTP posts.

In both the program sends the first event unasked, and every action carries a `sequenceId` that its event repeats.
"""

from __future__ import annotations

import http.client
import json
import struct
from collections.abc import Mapping
from typing import Any, BinaryIO, Protocol

HEADER = struct.Struct("!BI")
"""Of a message part: its kind, and the length of what follows."""

METADATA, ACTION, PICTURE, END = 1, 2, 4, 255
"""Kinds of parts."""

BOUNDARY = "ai2thor-stand-in-7f1d6a2c9e"


class Wire(Protocol):
    """Sends an event, gets the next action."""

    def exchange(self, envelope: Mapping[str, Any], picture: bytes | None) -> dict[str, Any] | None:
        """Send; the next action, or None when nobody asks any more."""
        ...


class Pipes:
    """FIFO: metadata in MessagePack, actions in JSON.

    Args:
        server, client: paths of the pipes to write to and to read from.
    """

    def __init__(self, server: str, client: str) -> None:
        import msgpack  # ai2thor depends on it where it speaks FIFO

        self._pack = msgpack.packb
        self._out: BinaryIO = open(server, "wb")  # noqa: SIM115
        self._client = client
        self._in: BinaryIO | None = None

    def exchange(self, envelope: Mapping[str, Any], picture: bytes | None) -> dict[str, Any] | None:
        """See `Wire`."""
        parts = [(METADATA, self._pack(envelope))]
        if picture is not None:
            parts.append((PICTURE, picture))
        try:
            self._out.write(b"".join(HEADER.pack(k, len(b)) + b for k, b in [*parts, (END, b"")]))
            self._out.flush()
        except BrokenPipeError:
            return None
        if self._in is None:
            self._in = open(self._client, "rb")  # noqa: SIM115
        action = None
        while len(header := self._in.read(HEADER.size)) == HEADER.size:
            kind, length = HEADER.unpack(header)
            body = self._in.read(length)
            if kind == END:
                return action
            if kind == ACTION:
                action = json.loads(body)
        return None


class Posts:
    """WSGI: a form is posted to the Controller's server, whose answer is the next action.

    Args:
        host, port: of the server.
        token: proves that this is the program the Controller started.
    """

    def __init__(self, host: str, port: int, token: str) -> None:
        self._connection = http.client.HTTPConnection(host, port)
        self._token = token

    def exchange(self, envelope: Mapping[str, Any], picture: bytes | None) -> dict[str, Any] | None:
        """See `Wire`."""
        text = 'Content-disposition: form-data; name="{}"\r\nContent-Type: text/plain; charset=utf-8'
        parts = [
            (text.format("metadata"), json.dumps(envelope).encode()),
            (text.format("token"), self._token.encode()),
        ]
        if picture is not None:
            head = 'Content-disposition: form-data; name="image"; filename="image.rgb"\r\nContent-Type: image/raw'
            parts.append((head, picture))
        between = f"\r\n--{BOUNDARY}".encode()
        body = b"".join(between + b"\r\n" + head.encode() + b"\r\n\r\n" + data for head, data in parts)
        headers = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
        try:
            self._connection.request("POST", "/train", body + between + b"--\r\n", headers)
            answer = self._connection.getresponse()
            text_of = answer.read()
        except (OSError, http.client.HTTPException):
            return None
        if answer.status != http.client.OK:
            raise RuntimeError(f"the Controller's server answered {answer.status}: {text_of[:200]!r}")
        action: dict[str, Any] = json.loads(text_of)
        return action if "action" in action else None
