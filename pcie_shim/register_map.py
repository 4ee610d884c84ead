"""The boards' register map as constants: offsets in bytes, masks, shifts, encodings.

Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one. What
each register means is in docs/reference/registers.md.
"""

from enum import IntEnum
from typing import Final, NamedTuple

MAP_SHA256: Final = "3e1197271f18778cf35434fbe02dfebc8031433857203d65ac2c3a91a1ef4854"
BAR_SIZE: Final = 0x20000


class BoardState(IntEnum):
    """Values of STATUS.STATE."""

    BLANK = 0  # no image: only identity and control registers are usable
    IDLE = 1  # reset; nothing has run
    RUNNING = 2  # the machine is running; writes are refused, except CONTROL.RESET
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
    DOORBELL = 7  # the number is not DONE + 1, or there is nothing to resume
    BAD_VALUE = 8  # a value is not valid for the machine: address, target, bank, cycles
    STALE = 9  # the board was programmed after this handle was opened
    HELD = 10  # another host holds the board, or another loader is programming it
    BAD_FRAME = 11  # the frame is invalid: operation, length, CRC or sequence number; the link is closed
    BAD_IMAGE = 12  # the image is damaged, or was built for another map or board


class Block(NamedTuple):
    """A register, an array of registers or a memory: 32-bit words from `address` on."""

    name: str
    address: int
    words: int
    writable: bool


ID: Final = 0x0000
ID_VALUE: Final = 0x31304d42
MAP_VERSION: Final = 0x0004
MAP_VERSION_VALUE: Final = 0x10002
MAP_VERSION_MINOR_SHIFT: Final = 0
MAP_VERSION_MINOR_MASK: Final = 0xffff
MAP_VERSION_MAJOR_SHIFT: Final = 16
MAP_VERSION_MAJOR_MASK: Final = 0xffff0000
LIVENESS: Final = 0x0008
PROGRAMMED: Final = 0x000c
MAP_HASH: Final = 0x0020
MAP_HASH_WORDS: Final = 8
IMAGE_HASH: Final = 0x0040
IMAGE_HASH_WORDS: Final = 8
CAP_MACHINE: Final = 0x0080
CAP_MACHINE_KIND_SHIFT: Final = 0
CAP_MACHINE_KIND_MASK: Final = 0xff
CAP_MACHINE_RNG_SHIFT: Final = 8
CAP_MACHINE_RNG_MASK: Final = 0xff00
CAP_MACHINE_SHARED_SHIFT: Final = 16
CAP_MACHINE_SHARED_MASK: Final = 0x10000
CAP_MACHINE_FREE_SHIFT: Final = 17
CAP_MACHINE_FREE_MASK: Final = 0x20000
CAP_MACHINE_PRIOR_WRITTEN_SHIFT: Final = 18
CAP_MACHINE_PRIOR_WRITTEN_MASK: Final = 0x40000
CAP_MACHINE_SENSOR_MODE_SHIFT: Final = 19
CAP_MACHINE_SENSOR_MODE_MASK: Final = 0x180000
CAP_MACHINE_LITERAL_SHIFT: Final = 21
CAP_MACHINE_LITERAL_MASK: Final = 0x200000
CAP_MACHINE_PER_MOVE_SHIFT: Final = 22
CAP_MACHINE_PER_MOVE_MASK: Final = 0x400000
CAP_MACHINE_STREAM_SHIFT: Final = 23
CAP_MACHINE_STREAM_MASK: Final = 0x800000
CAP_LINES: Final = 0x0084
CAP_TOTAL_LINES: Final = 0x0088
CAP_LINE_OFFSET: Final = 0x008c
CAP_PARTITION: Final = 0x0090
CAP_PARTITION_INDEX_SHIFT: Final = 0
CAP_PARTITION_INDEX_MASK: Final = 0xffff
CAP_PARTITION_COUNT_SHIFT: Final = 16
CAP_PARTITION_COUNT_MASK: Final = 0xffff0000
CAP_SENSORS: Final = 0x0094
CAP_WIDTHS: Final = 0x0098
CAP_WIDTHS_PROB_BITS_SHIFT: Final = 0
CAP_WIDTHS_PROB_BITS_MASK: Final = 0xff
CAP_WIDTHS_COUNTER_BITS_SHIFT: Final = 8
CAP_WIDTHS_COUNTER_BITS_MASK: Final = 0xff00
CAP_WIDTHS_PRIOR_BITS_SHIFT: Final = 16
CAP_WIDTHS_PRIOR_BITS_MASK: Final = 0xff0000
CAP_BANKS: Final = 0x009c
CAP_REPLICAS: Final = 0x00a0
CAP_INTERFACE: Final = 0x00a4
CAP_INTERFACE_SENSORS_SHIFT: Final = 0
CAP_INTERFACE_SENSORS_MASK: Final = 0xffff
CAP_INTERFACE_RESULTS_SHIFT: Final = 16
CAP_INTERFACE_RESULTS_MASK: Final = 0xffff0000
CAP_SPEED: Final = 0x00a8
CAP_STEPS: Final = 0x00ac
CAP_SENSOR_BITS: Final = 0x00c0
CAP_SENSOR_BITS_WORDS: Final = 16
CAP_SENSOR_BITS_FIRST_SHIFT: Final = 0
CAP_SENSOR_BITS_FIRST_MASK: Final = 0xff
CAP_SENSOR_BITS_SECOND_SHIFT: Final = 8
CAP_SENSOR_BITS_SECOND_MASK: Final = 0xff00
CAP_SENSOR_BITS_THIRD_SHIFT: Final = 16
CAP_SENSOR_BITS_THIRD_MASK: Final = 0xff0000
CAP_SENSOR_BITS_FOURTH_SHIFT: Final = 24
CAP_SENSOR_BITS_FOURTH_MASK: Final = 0xff000000
CONTROL: Final = 0x0100
CONTROL_RESET_SHIFT: Final = 0
CONTROL_RESET_MASK: Final = 0x1
CONTROL_INTERRUPT_ENABLE_SHIFT: Final = 1
CONTROL_INTERRUPT_ENABLE_MASK: Final = 0x2
TARGET_COUNT: Final = 0x0104
MAX_CYCLES: Final = 0x0108
MAX_CYCLES_WORDS: Final = 2
BANK: Final = 0x0110
PRIOR_SELECT: Final = 0x0114
RUN_UNTIL: Final = 0x0118
RUN_UNTIL_WORDS: Final = 2
START: Final = 0x0120
RESUME: Final = 0x0124
DONE: Final = 0x0140
STATUS: Final = 0x0144
STATUS_STATE_SHIFT: Final = 0
STATUS_STATE_MASK: Final = 0xf
STATUS_STOP_REASON_SHIFT: Final = 4
STATUS_STOP_REASON_MASK: Final = 0xf0
STATUS_ERROR_SHIFT: Final = 8
STATUS_ERROR_MASK: Final = 0xff00
CYCLES: Final = 0x0148
CYCLES_WORDS: Final = 2
COMPUTE_NS: Final = 0x0150
COMPUTE_NS_WORDS: Final = 2
HALT: Final = 0x0180
HALT_WORDS: Final = 8
SENSORS: Final = 0x0200
SENSORS_WORDS: Final = 64
KNOWN_MASK: Final = 0x0300
KNOWN_MASK_WORDS: Final = 64
PRIOR_SELECTS: Final = 0x0400
PRIOR_SELECTS_WORDS: Final = 256
START_STATE: Final = 0x0800
START_STATE_WORDS: Final = 64
BURN_IN: Final = 0x0900
OPS_TIMEOUT: Final = 0x0904
ORDER: Final = 0x0908
SAMPLES_DONE: Final = 0x0940
UNUSED: Final = 0x0944
TIMED_OUT_BIT: Final = 0x0948
STREAM_COUNT: Final = 0x094c
OUTCOMES: Final = 0x1000
OUTCOMES_WORDS: Final = 1024
RESULTS: Final = 0x4000
RESULTS_WORDS: Final = 4096
PRIOR_CODES: Final = 0x8000
PRIOR_CODES_WORDS: Final = 4096
STREAM: Final = 0xc000
STREAM_WORDS: Final = 4096
INPUTS: Final = 0x10000
INPUTS_WORDS: Final = 8192

BLOCKS: Final = (
    Block("ID", ID, 1, writable=False),
    Block("MAP_VERSION", MAP_VERSION, 1, writable=False),
    Block("LIVENESS", LIVENESS, 1, writable=True),
    Block("PROGRAMMED", PROGRAMMED, 1, writable=False),
    Block("MAP_HASH", MAP_HASH, 8, writable=False),
    Block("IMAGE_HASH", IMAGE_HASH, 8, writable=False),
    Block("CAP_MACHINE", CAP_MACHINE, 1, writable=False),
    Block("CAP_LINES", CAP_LINES, 1, writable=False),
    Block("CAP_TOTAL_LINES", CAP_TOTAL_LINES, 1, writable=False),
    Block("CAP_LINE_OFFSET", CAP_LINE_OFFSET, 1, writable=False),
    Block("CAP_PARTITION", CAP_PARTITION, 1, writable=False),
    Block("CAP_SENSORS", CAP_SENSORS, 1, writable=False),
    Block("CAP_WIDTHS", CAP_WIDTHS, 1, writable=False),
    Block("CAP_BANKS", CAP_BANKS, 1, writable=False),
    Block("CAP_REPLICAS", CAP_REPLICAS, 1, writable=False),
    Block("CAP_INTERFACE", CAP_INTERFACE, 1, writable=False),
    Block("CAP_SPEED", CAP_SPEED, 1, writable=False),
    Block("CAP_STEPS", CAP_STEPS, 1, writable=False),
    Block("CAP_SENSOR_BITS", CAP_SENSOR_BITS, 16, writable=False),
    Block("CONTROL", CONTROL, 1, writable=True),
    Block("TARGET_COUNT", TARGET_COUNT, 1, writable=True),
    Block("MAX_CYCLES", MAX_CYCLES, 2, writable=True),
    Block("BANK", BANK, 1, writable=True),
    Block("PRIOR_SELECT", PRIOR_SELECT, 1, writable=True),
    Block("RUN_UNTIL", RUN_UNTIL, 2, writable=True),
    Block("START", START, 1, writable=True),
    Block("RESUME", RESUME, 1, writable=True),
    Block("DONE", DONE, 1, writable=False),
    Block("STATUS", STATUS, 1, writable=False),
    Block("CYCLES", CYCLES, 2, writable=False),
    Block("COMPUTE_NS", COMPUTE_NS, 2, writable=False),
    Block("HALT", HALT, 8, writable=True),
    Block("SENSORS", SENSORS, 64, writable=True),
    Block("KNOWN_MASK", KNOWN_MASK, 64, writable=True),
    Block("PRIOR_SELECTS", PRIOR_SELECTS, 256, writable=True),
    Block("START_STATE", START_STATE, 64, writable=True),
    Block("BURN_IN", BURN_IN, 1, writable=True),
    Block("OPS_TIMEOUT", OPS_TIMEOUT, 1, writable=True),
    Block("ORDER", ORDER, 1, writable=True),
    Block("SAMPLES_DONE", SAMPLES_DONE, 1, writable=False),
    Block("UNUSED", UNUSED, 1, writable=False),
    Block("TIMED_OUT_BIT", TIMED_OUT_BIT, 1, writable=False),
    Block("STREAM_COUNT", STREAM_COUNT, 1, writable=False),
    Block("OUTCOMES", OUTCOMES, 1024, writable=False),
    Block("RESULTS", RESULTS, 4096, writable=False),
    Block("PRIOR_CODES", PRIOR_CODES, 4096, writable=True),
    Block("STREAM", STREAM, 4096, writable=False),
    Block("INPUTS", INPUTS, 8192, writable=True),
)
