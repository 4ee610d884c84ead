"""PNG compression of rosbridge: JSON as the pixels of a picture, in base64.

The reference server of ROS 1 answers `compression: png` like this: the bytes of the JSON are the red, green
and blue values of a nearly square picture, padded with newlines (older servers: one line of grey values).
Only such pictures are read: 8 bits per channel, without palette and interlacing. The header contains the
size, so a decompression bomb is refused before it is unpacked.

Source: PNG, third edition (https://www.w3.org/TR/png-3/), chapters 5, 7, 9 and 11.
"""

import base64
import binascii
import math
import struct
import zlib
from collections.abc import Iterator
from typing import Final

from bridge.codecs.json_codec import MAX_SIZE
from bridge.errors import DecodeError

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
# The lowest level: 1 MiB of numbers takes 12 ms instead of 74 ms, and becomes 7 % longer.
_COMPRESSION_LEVEL: Final = 1
# Bytes per pixel by colour type.
_CHANNELS: Final = {0: 1, 2: 3, 4: 2, 6: 4}


def decode(data: str, *, max_size: int = MAX_SIZE) -> bytes:
    """Extract a message's JSON, perhaps followed by newlines, from its picture in base64.

    Raises:
        DecodeError: The picture is too large, or does not contain a message.
    """
    try:
        picture = base64.b64decode(data, validate=True)
    except (binascii.Error, ValueError):
        raise DecodeError("a png arrived that is not base64") from None
    if not picture.startswith(_SIGNATURE):
        raise DecodeError("a png arrived that is not a picture")
    # Checksums and unknown chunks are ignored: the content is checked as JSON later.
    header, packed = b"", bytearray()
    for kind, content in _chunks(picture):
        if kind == b"IHDR":
            header = content
        elif kind == b"IDAT":
            packed += content
    if len(header) != 13:
        raise DecodeError("a png arrived without a header")
    width, height, bits, colour, _method, _filter, interlaced = struct.unpack(">IIBBBBB", header)
    channels = _CHANNELS.get(colour)
    if bits != 8 or channels is None or interlaced or not width or not height:
        raise DecodeError(
            "a png arrived that is not a message: expected 8 bits a channel, no palette, no interlacing"
        )
    line = width * channels
    # The padding of a nearly square picture is less than a few lines.
    if line * height > max_size + 8 * line:
        raise DecodeError(f"a png arrived that holds more than {max_size} bytes")
    wanted = (line + 1) * height
    # No more than announced is unpacked, whatever the data contains.
    unpacking = zlib.decompressobj()
    try:
        lines = unpacking.decompress(bytes(packed), wanted)
    except zlib.error as error:
        raise DecodeError(f"a png arrived that cannot be unpacked ({error})") from None
    if len(lines) != wanted:
        raise DecodeError("a png arrived that is not complete")
    return _unfiltered(lines, line, channels)


def encode(message: bytes) -> str:
    """Return the JSON of a message as a picture in base64, like the reference server."""
    # Nearly square, three bytes a pixel, filled up with newlines, which JSON ignores.
    pixels = -(-len(message) // 3) or 1
    width = math.isqrt(pixels)
    height = -(-pixels // width)
    line = 3 * width
    padded = message.ljust(line * height, b"\n")
    lines = b"".join(b"\0" + padded[at : at + line] for at in range(0, len(padded), line))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    picture = _SIGNATURE + b"".join(
        _chunk(kind, content)
        for kind, content in (
            (b"IHDR", header),
            (b"IDAT", zlib.compress(lines, _COMPRESSION_LEVEL)),
            (b"IEND", b""),
        )
    )
    return base64.b64encode(picture).decode()


def _chunks(picture: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(_SIGNATURE)
    while at + 12 <= len(picture):
        size = int.from_bytes(picture[at : at + 4])
        if at + 12 + size > len(picture):
            break
        yield picture[at + 4 : at + 8], picture[at + 8 : at + 8 + size]
        at += 12 + size


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _unfiltered(lines: bytes, line: int, channels: int) -> bytes:
    """Undo the filter of each line; its number precedes the line."""
    # Servers that use Pillow choose a filter for each line. The line above the first one counts as zeros.
    pixels = bytearray()
    above = bytes(line)
    for at in range(0, len(lines), line + 1):
        current = bytearray(lines[at + 1 : at + 1 + line])
        match lines[at]:
            case 0:
                pass
            case 1:
                for i in range(channels, line):
                    current[i] = (current[i] + current[i - channels]) & 255
            case 2:
                current = bytearray((a + b) & 255 for a, b in zip(current, above, strict=True))
            case 3:
                for i in range(line):
                    left = current[i - channels] if i >= channels else 0
                    current[i] = (current[i] + (left + above[i]) // 2) & 255
            case 4:
                for i in range(line):
                    left, corner = (current[i - channels], above[i - channels]) if i >= channels else (0, 0)
                    current[i] = (current[i] + _paeth(left, above[i], corner)) & 255
            case other:
                raise DecodeError(f"a png arrived with the unknown filter {other}")
        pixels += current
        above = bytes(current)
    return bytes(pixels)


def _paeth(left: int, above: int, corner: int) -> int:
    guess = left + above - corner
    by_left, by_above, by_corner = abs(guess - left), abs(guess - above), abs(guess - corner)
    if by_left <= by_above and by_left <= by_corner:
        return left
    return above if by_above <= by_corner else corner
