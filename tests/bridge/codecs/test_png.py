"""PNG as a compression: read as the reference server makes it (with Pillow), and never unpacked beyond the limit."""

import base64
import io
import json
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from bridge.codecs.png import decode, encode
from bridge.errors import DecodeError


def picture(pixels, size, mode="RGB", **options):
    buffer = io.BytesIO()
    Image.frombytes(mode, size, pixels).save(buffer, "png", **options)
    return base64.b64encode(buffer.getvalue()).decode()


def by_hand(lines, header, *, before=b""):
    def chunk(kind, content):
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", *header)) + before
    return base64.b64encode(data + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")).decode()


def test_pillow_reads_ours_and_we_read_pillows():
    message = json.dumps({"op": "publish", "msg": {"data": list(range(1000))}}).encode()
    image = Image.open(io.BytesIO(base64.b64decode(encode(message))))
    assert (image.mode, image.tobytes().rstrip(b"\n")) == ("RGB", message)
    assert decode(picture(image.tobytes(), image.size)).rstrip(b"\n") == message
    assert decode(picture(message, (len(message), 1), "L")) == message


def test_every_filter():
    """The library chooses filters by content: a smooth picture takes them all. And each by hand."""
    smooth = np.add.outer(np.arange(60) ** 2 // 7, np.arange(90) * 3).astype(np.uint8)
    noise = np.random.default_rng(1).integers(0, 9, smooth.shape, np.uint8)
    for pixels in (smooth, smooth + noise):
        assert decode(picture(pixels.tobytes(), (30, 60))) == pixels.tobytes()
    for kind in range(5):
        lines = b"".join(bytes([kind]) + bytes(range(at, at + 9)) for at in (5, 100, 240))
        data = by_hand(lines, (3, 3, 8, 2, 0, 0, 0))
        assert decode(data) == Image.open(io.BytesIO(base64.b64decode(data))).tobytes()


@pytest.mark.parametrize(
    "data",
    [
        "",
        "no base64!",
        "\u00e4",
        base64.b64encode(b"GIF89a").decode(),
        base64.b64encode(b"\x89PNG\r\n\x1a\n").decode(),
        picture(bytes(12), (2, 2))[:60],
        picture(bytes(4), (2, 2), "P"),
        by_hand(bytes(100), (3, 3, 16, 2, 0, 0, 0)),
        by_hand(bytes(100), (3, 3, 8, 2, 0, 0, 1)),
        by_hand(bytes(100), (0, 3, 8, 2, 0, 0, 0)),
        by_hand(bytes(9), (3, 3, 8, 2, 0, 0, 0)),
        by_hand(b"\x05" + bytes(9), (3, 1, 8, 2, 0, 0, 0)),
        by_hand(bytes(9), (2**32 - 1, 2**32 - 1, 8, 2, 0, 0, 0)),
    ],
)
def test_malformed_messages_are_refused(data):
    with pytest.raises(DecodeError) as caught:
        decode(data)
    assert "\n" not in str(caught.value)


def test_a_bomb_is_not_unpacked():
    data = by_hand(bytes(64_000_000), (1000, 1000, 8, 2, 0, 0, 0))
    with pytest.raises(DecodeError, match="more than 1000"):
        decode(data, max_size=1000)
    assert len(decode(by_hand(bytes(64_000_000), (10, 10, 8, 2, 0, 0, 0)))) == 300
