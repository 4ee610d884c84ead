"""Local sockets between services: length-prefixed MessagePack records, and the handshake.

A framed record is its length in four bytes (little-endian), followed by that many bytes of MessagePack.
`RecordSplitter` decodes records without I/O. `RecordProtocol` is a connection in asyncio.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from typing import cast

import msgspec

from pcie_shim.endpoint import Endpoint, no_delay
from services.errors import LocalSocketError, OtherPeerError
from services.sockets.records import VERSION, AnyRecord, Hello, Record

MAX_RECORD = 4 * 1024 * 1024
"""Maximum size of a record in bytes. The results of 64 boards with 4096 counts each take about 1 MiB."""

_LENGTH = struct.Struct("<I")
_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[AnyRecord] = msgspec.msgpack.Decoder(AnyRecord)


def encode_record(record: Record) -> bytes:
    """Return the bytes of one framed record, or raise a LocalSocketError if the record exceeds `MAX_RECORD` bytes."""
    body = _encoder.encode(record)
    if len(body) > MAX_RECORD:
        raise LocalSocketError(
            f"a {type(record).__name__} record has {len(body)} bytes, more than the maximum of {MAX_RECORD}"
        )
    return _LENGTH.pack(len(body)) + body


class RecordSplitter:
    """Decoder of bytes into records. The decoder stores an incomplete record until the other bytes have arrived."""

    def __init__(self, peer: str) -> None:
        self._peer = peer
        # The beginning of an incomplete record; bounded, because a long one is refused by its length.
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[AnyRecord]:
        """Add bytes, and return the records now complete. If bytes are not a record, raise a LocalSocketError."""
        pending = self._pending
        pending += data
        records: list[AnyRecord] = []
        at = 0
        while len(pending) - at >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(pending, at)
            # before any of it is stored
            if length > MAX_RECORD:
                raise LocalSocketError(
                    f"{self._peer} announced a record of {length} bytes; the maximum is {MAX_RECORD}, so it is not a rosbayes service"
                )
            end = at + _LENGTH.size + length
            if len(pending) < end:
                break
            try:
                # a copy, because undecoded parts of a record reference their buffer
                records.append(_decoder.decode(bytes(memoryview(pending)[at + _LENGTH.size : end])))
            except (msgspec.MsgspecError, RecursionError) as error:
                raise LocalSocketError(
                    f"{self._peer} sent bytes that are not a rosbayes record ({error})"
                ) from error
            at = end
        del pending[:at]
        return records


def own_hello(role: str, deployment_hash: str) -> Hello:
    """Return the hello of this process."""
    return Hello(role=role, version=VERSION, deployment_hash=deployment_hash)


def check_hello(record: AnyRecord, expected_role: str, deployment_hash: str, where: str) -> None:
    """Raise an OtherPeerError unless a peer's first record is a `Hello` with this role, version and deployment."""
    if not isinstance(record, Hello):
        raise OtherPeerError(
            f"{where}: the peer did not greet (a {type(record).__name__} came first); is it a {expected_role}?"
        )
    if record.role != expected_role:
        raise OtherPeerError(
            f"{where}: expected a {expected_role} there, found a {record.role}; check the endpoints"
        )
    if record.version != VERSION:
        raise OtherPeerError(
            f"{where}: the {record.role} is rosbayes {record.version}, this is {VERSION}; run the same version on both sides"
        )
    if record.deployment_hash != deployment_hash:
        raise OtherPeerError(
            f"{where}: the {record.role} runs deployment {record.deployment_hash[:12] or '(none)'}, "
            f"this process runs {deployment_hash[:12] or '(none)'}; give both the same deployment"
        )


class RecordProtocol(asyncio.Protocol):
    """The asyncio protocol of a local connection. It passes each received record directly to a callback."""

    def __init__(
        self,
        where: str,
        on_record: Callable[[RecordProtocol, AnyRecord], None],
        on_open: Callable[[RecordProtocol], None],
        on_close: Callable[[RecordProtocol, Exception | None], None],
    ) -> None:
        self.where = where
        # The functions get this connection, because its owner may already have the next one.
        self._splitter = RecordSplitter(where)
        self._on_record = on_record
        self._on_open = on_open
        self._on_close = on_close
        # While the connection is open; and the error of this side that closes it, which `on_close` gets.
        self._transport: asyncio.Transport | None = None
        self._failure: Exception | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Handle the opened socket (asyncio)."""
        # uvloop's transports are not subclasses of asyncio's, but behave alike
        self._transport = cast("asyncio.Transport", transport)
        # a record must not wait for others to fill a packet
        sock = transport.get_extra_info("socket")
        if sock is not None:
            no_delay(sock)
        self._on_open(self)

    def data_received(self, data: bytes) -> None:
        """Handle received bytes (asyncio)."""
        try:
            for record in self._splitter.feed(data):
                self._on_record(self, record)
        except (LocalSocketError, OtherPeerError) as error:
            self._failure = error
            self.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the closed socket (asyncio)."""
        self._transport = None
        self._on_close(self, self._failure or exc)

    @property
    def backlog(self) -> int:
        """Number of written bytes that the socket has not accepted yet."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def send(self, record: Record) -> bool:
        """Write a record and return True, or return False if the connection is closed."""
        if self._transport is None or self._transport.is_closing():
            return False
        self._transport.write(encode_record(record))
        return True

    def close(self) -> None:
        """Close the connection after sending everything written."""
        if self._transport is not None:
            self._transport.close()


async def open_connection(endpoint: Endpoint, make: Callable[[], RecordProtocol]) -> RecordProtocol:
    """Connect to an endpoint, with one attempt. Raises an OSError if the attempt fails."""
    loop = asyncio.get_running_loop()
    if endpoint.path:
        _, protocol = await loop.create_unix_connection(make, endpoint.path)
    else:
        _, protocol = await loop.create_connection(make, endpoint.host, endpoint.port)
    return protocol
