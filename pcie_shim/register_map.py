"""The boards' register map as constants: addresses in bytes, masks of fields, encodings.

Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. What
each register means is in docs/reference/registers.md.
"""

from enum import IntEnum
from typing import Final

MAP_SHA256: Final = "ce45436af122e6ea95d04bad0f45b2e80adba8b53c02569f00118801536ee5b9"
BAR_SIZE: Final = 0x20000


class BoardState(IntEnum):
    """Values of STATUS.STATE."""

    BLANK = 0  # no image is loaded. Only identity and control registers are usable
    IDLE = 1  # nothing has run since the reset
    RUNNING = 2  # the machine is running. The board refuses all writes except CONTROL.RESET
    DONE = 3  # the machine has stopped for the reason in STOP_REASON


class ErrorCode(IntEnum):
    """Values of STATUS.ERROR."""

    NONE = 0  # nothing was refused since the reset
    OUTSIDE = 1  # the address is not in the map, or not implemented by this image
    MISALIGNED = 2  # the address is not a multiple of 4
    TOO_LONG = 3  # the access runs past the end of its block
    READ_ONLY = 4  # the register cannot be written
    BUSY = 5  # the machine is running; only CONTROL.RESET may be written
    BLANK = 6  # no image has been loaded
    DOORBELL = 7  # the number written to START or RESUME is not DONE + 1, or there is nothing to resume
    BAD_VALUE = 8  # the machine does not accept a value: an address, the target, the bank or a number of cycles
    STALE = 9  # the board was programmed after this host had opened the board
    HELD = 10  # another host holds the board, or another loader is programming it
    BAD_FRAME = 11  # a link frame has an invalid operation, length, CRC or sequence number. The board closes the link
    BAD_IMAGE = 12  # the image is damaged, or was built for another map or board


class Block(int):
    """The address in bytes of a register, an array of registers or a memory. The block has `words` 32-bit words."""

    words: int
    writable: bool

    def __new__(cls, address: int, words: int, *, writable: bool) -> "Block":
        block = super().__new__(cls, address)
        block.words, block.writable = words, writable
        return block


ID: Final = Block(0x0000, 1, writable=False)
ID_VALUE: Final = 0x31304d42
MAP_VERSION: Final = Block(0x0004, 1, writable=False)
MAP_VERSION_VALUE: Final = 0x10003
MAP_VERSION_MINOR_MASK: Final = 0xffff
MAP_VERSION_MAJOR_MASK: Final = 0xffff0000
LIVENESS: Final = Block(0x0008, 1, writable=True)
PROGRAMMED: Final = Block(0x000c, 1, writable=False)
MAP_HASH: Final = Block(0x0020, 8, writable=False)
IMAGE_HASH: Final = Block(0x0040, 8, writable=False)
CAP_MACHINE: Final = Block(0x0080, 1, writable=False)
CAP_MACHINE_KIND_MASK: Final = 0xff
CAP_MACHINE_RNG_MASK: Final = 0xff00
CAP_MACHINE_SHARED_MASK: Final = 0x10000
CAP_MACHINE_FREE_MASK: Final = 0x20000
CAP_MACHINE_PRIOR_WRITTEN_MASK: Final = 0x40000
CAP_MACHINE_SENSOR_MODE_MASK: Final = 0x180000
CAP_MACHINE_LITERAL_MASK: Final = 0x200000
CAP_MACHINE_PER_MOVE_MASK: Final = 0x400000
CAP_MACHINE_STREAM_MASK: Final = 0x800000
CAP_LINES: Final = Block(0x0084, 1, writable=False)
CAP_TOTAL_LINES: Final = Block(0x0088, 1, writable=False)
CAP_LINE_OFFSET: Final = Block(0x008c, 1, writable=False)
CAP_PARTITION: Final = Block(0x0090, 1, writable=False)
CAP_PARTITION_INDEX_MASK: Final = 0xffff
CAP_PARTITION_COUNT_MASK: Final = 0xffff0000
CAP_SENSORS: Final = Block(0x0094, 1, writable=False)
CAP_WIDTHS: Final = Block(0x0098, 1, writable=False)
CAP_WIDTHS_PROB_BITS_MASK: Final = 0xff
CAP_WIDTHS_COUNTER_BITS_MASK: Final = 0xff00
CAP_WIDTHS_PRIOR_BITS_MASK: Final = 0xff0000
CAP_BANKS: Final = Block(0x009c, 1, writable=False)
CAP_REPLICAS: Final = Block(0x00a0, 1, writable=False)
CAP_INTERFACE: Final = Block(0x00a4, 1, writable=False)
CAP_INTERFACE_SENSORS_MASK: Final = 0xffff
CAP_INTERFACE_RESULTS_MASK: Final = 0xffff0000
CAP_SPEED: Final = Block(0x00a8, 1, writable=False)
CAP_STEPS: Final = Block(0x00ac, 1, writable=False)
CAP_LINK: Final = Block(0x00b0, 1, writable=False)
CAP_LINK_SENDS_RESULTS_MASK: Final = 0x1
CAP_SENSOR_BITS: Final = Block(0x00c0, 16, writable=False)
CAP_SENSOR_BITS_FIRST_MASK: Final = 0xff
CAP_SENSOR_BITS_SECOND_MASK: Final = 0xff00
CAP_SENSOR_BITS_THIRD_MASK: Final = 0xff0000
CAP_SENSOR_BITS_FOURTH_MASK: Final = 0xff000000
CONTROL: Final = Block(0x0100, 1, writable=True)
CONTROL_RESET_MASK: Final = 0x1
CONTROL_INTERRUPT_ENABLE_MASK: Final = 0x2
TARGET_COUNT: Final = Block(0x0104, 1, writable=True)
MAX_CYCLES: Final = Block(0x0108, 2, writable=True)
BANK: Final = Block(0x0110, 1, writable=True)
PRIOR_SELECT: Final = Block(0x0114, 1, writable=True)
RUN_UNTIL: Final = Block(0x0118, 2, writable=True)
START: Final = Block(0x0120, 1, writable=True)
RESUME: Final = Block(0x0124, 1, writable=True)
DONE: Final = Block(0x0140, 1, writable=False)
STATUS: Final = Block(0x0144, 1, writable=False)
STATUS_STATE_MASK: Final = 0xf
STATUS_STOP_REASON_MASK: Final = 0xf0
STATUS_ERROR_MASK: Final = 0xff00
CYCLES: Final = Block(0x0148, 2, writable=False)
COMPUTE_NS: Final = Block(0x0150, 2, writable=False)
HALT: Final = Block(0x0180, 8, writable=True)
SENSORS: Final = Block(0x0200, 64, writable=True)
KNOWN_MASK: Final = Block(0x0300, 64, writable=True)
PRIOR_SELECTS: Final = Block(0x0400, 256, writable=True)
START_STATE: Final = Block(0x0800, 64, writable=True)
BURN_IN: Final = Block(0x0900, 1, writable=True)
OPS_TIMEOUT: Final = Block(0x0904, 1, writable=True)
ORDER: Final = Block(0x0908, 1, writable=True)
SAMPLES_DONE: Final = Block(0x0940, 1, writable=False)
UNUSED: Final = Block(0x0944, 1, writable=False)
TIMED_OUT_BIT: Final = Block(0x0948, 1, writable=False)
STREAM_COUNT: Final = Block(0x094c, 1, writable=False)
OUTCOMES: Final = Block(0x1000, 1024, writable=False)
RESULTS: Final = Block(0x4000, 4096, writable=False)
PRIOR_CODES: Final = Block(0x8000, 4096, writable=True)
STREAM: Final = Block(0xc000, 4096, writable=False)
INPUTS: Final = Block(0x10000, 8192, writable=True)

BLOCKS: Final = {name: each for name, each in tuple(globals().items()) if isinstance(each, Block)}
"""All blocks by name, in the order of their addresses."""
