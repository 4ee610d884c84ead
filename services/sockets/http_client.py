"""A request to the HTTP socket of a process of this user."""

import asyncio
from pathlib import Path

ANSWER_LIMIT = 1 << 20
"""Maximum size of an answer in bytes."""


async def get(path: Path, target: str, *, timeout: float) -> tuple[int, bytes]:
    """Return the status and the body of the answer to a GET request.

    Raises:
        OSError: Nothing listens there, or it did not answer in time (TimeoutError).
        ValueError: The answer is not one of a process of this version.
    """
    async with asyncio.timeout(timeout):
        reader, writer = await asyncio.open_unix_connection(path)
        try:
            writer.write(f"GET {target} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            await writer.drain()
            answer = bytearray()
            while part := await reader.read(1 << 16):
                answer += part
                if len(answer) > ANSWER_LIMIT:
                    raise ValueError(f"the answer has more than {ANSWER_LIMIT} bytes")
        finally:
            writer.close()
    head, _, body = bytes(answer).partition(b"\r\n\r\n")
    words = head.split(b" ", 2)
    if len(words) != 3 or not words[0].startswith(b"HTTP/1.") or not words[1].isdigit():
        raise ValueError("the answer is not HTTP")
    return int(words[1]), body
