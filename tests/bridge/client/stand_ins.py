"""Stand-ins for tests of the client: its core alone, a TCP service that is not rosbridge, and cancelled waits."""

import asyncio
import contextlib
import json

import cbor2

from bridge.client.protocol import ClientCore
from bridge.codecs.cbor_codec import typed_array


def connected(**options):
    core = ClientCore(**options)
    core.restore()
    return core


def sent(core):
    return [json.loads(data) for data in core.data_to_send()]


def tell(core, now=0.0, **operation):
    return core.receive(json.dumps(operation).encode(), now)


def as_cbor(message):
    """Return a message as a server writes it, with NumPy arrays as typed arrays."""

    def typed(encoder, array):
        encoder.encode(typed_array(array.tolist(), array.dtype.str[1:]))

    return cbor2.dumps(message, default=typed)


def give_up(subscription):
    """End the present wait as at its deadline."""
    subscription._deadline = 0.0
    subscription._ring()


@contextlib.asynccontextmanager
async def tcp_service(serve, port=0):
    """Serve each connection on a port of this machine; at the end, cut those that `serve` has not closed."""
    tasks, writers = [], []

    async def talk(reader, writer):
        tasks.append(asyncio.current_task())
        writers.append(writer)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.CancelledError):
            served = serve(reader, writer)
            if served is not None:
                await served

    server = await asyncio.start_server(talk, "127.0.0.1", port)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        for writer in writers:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
