"""A TCP service of a test, which leaves nothing."""

import asyncio
import contextlib


@contextlib.asynccontextmanager
async def tcp_service(serve, port=0):
    """Serve each connection on a port of this machine; at the end, cut those that `serve` has not closed."""
    tasks = []
    writers = []

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
        for task in filter(None, tasks):
            task.cancel()
        for writer in writers:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
