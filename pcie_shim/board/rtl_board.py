"""A board with simulated hardware. An access to a register becomes an AXI4-Lite transaction of the VHDL."""

import struct
import threading
import time
from collections.abc import Callable
from typing import Final, NoReturn

from pcie_shim import register_map as rm
from pcie_shim.board.emulated_board import CHUNK_S, EmulatedBoard, RefusedError
from pcie_shim.board.simulation import MOST_WORDS, Simulation
from pcie_shim.errors import ImageError, SimulationError
from pcie_shim.programming_file import Image, image_from_bytes
from pcie_shim.register_layout import ALL_ONES, DONE_BLOCK, SETTINGS, WORD, field_of
from pcie_shim.register_map import BoardState, ErrorCode

LOAD_S: Final = 20.0
"""Maximum seconds that `load` waits for a compilation. Then `load` refuses, and the loader has to try again."""

_SHORTEST_CHUNK: Final = 16  # clocks
_DOORBELLS: Final = (rm.START, rm.RESUME)
_MEASURED_S: Final = 0.2

_DETAILS: Final = {
    ErrorCode.BUSY: "the machine is running; only a reset may be written",
    ErrorCode.DOORBELL: "this number is not the next one, or there is no slice to resume",
    ErrorCode.BAD_VALUE: "a setting, input or prior code is out of range",
}


class RtlBoard:
    """A board like `EmulatedBoard`, but its registers and its machine are simulated hardware.

    While the board is blank, no hardware is simulated, and a blank `EmulatedBoard` answers. If the simulation ends,
    hangs or sends an invalid answer, the board raises a SimulationError and is unusable from then on.
    """

    def __init__(self, simulate: Callable[[Image], Simulation]) -> None:
        """Create a blank board. `simulate` compiles and starts an image's hardware, or raises a SimulationError."""
        self._simulate = simulate

        # While there is no simulation, this board answers.
        self._blank = EmulatedBoard(sends_results=False)

        # The simulated hardware and the hash of its image; programming the board again replaces both.
        self._simulation: Simulation | None = None
        self._image_hash = self._blank.image_hash

        # Hardware that is being compiled, or is ready for `load` to take.
        self._preparation: _Preparation | None = None

        # Clocks of the next chunk, which adapts to the measured speed.
        self._chunk = _SHORTEST_CHUNK

        # Attributes that `Board` requires; `done` and `running` are the last values read from the hardware's registers.
        self.turned = 0.0
        self.programmed = 0
        self.done = 0
        self.running = False

    def close(self) -> None:
        """End the simulation."""
        if self._preparation is not None:
            self._preparation.close()
        if self._simulation is not None:
            self._simulation.close()

    @property
    def image_hash(self) -> str:
        """SHA-256 of the loaded image in hexadecimal, or zeros while the board is blank."""
        return self._image_hash

    @property
    def interrupt_enabled(self) -> bool:
        """True if the host has enabled interrupts."""
        return bool(self._word(rm.CONTROL) & rm.CONTROL_INTERRUPT_ENABLE_MASK)

    # ---- programming ----------------------------------------------------------------------------------

    def prepare(self, image: Image) -> None:
        """Compile and start the hardware of an image before `load`. Raise a SimulationError if this fails."""
        if self._preparation is not None:
            self._preparation.close()
        self._preparation = _Preparation(self._simulate, image)
        self._preparation.run()
        if self._preparation.error is not None:
            raise self._preparation.error

    def load(self, content: bytes) -> None:
        """Program the board as `Board.load` does. A compilation longer than LOAD_S also raises a RefusedError."""
        if self.running:
            raise RefusedError(ErrorCode.BUSY, "the machine is running; reset it before programming")
        try:
            image = image_from_bytes(content, "the image")
            simulation = self._prepared(image)
        except (ImageError, SimulationError) as error:
            raise RefusedError(ErrorCode.BAD_IMAGE, str(error).rstrip(".")) from error
        if self._simulation is not None:
            self._simulation.close()
        self._simulation = simulation
        self._image_hash = image.image_hash
        self._chunk = max(int(simulation.speed * CHUNK_S), _SHORTEST_CHUNK)
        self.programmed += 1
        self._look()

    def _prepared(self, image: Image) -> Simulation:
        """Return the started simulation of an image, after waiting for at most LOAD_S."""
        preparation = self._preparation
        wanted = image.image_hash, image.partition
        if preparation is None or (preparation.identity != wanted and not preparation.is_alive()):
            if preparation is not None:
                preparation.close()
            self._preparation = preparation = _Preparation(self._simulate, image)
            preparation.start()
        if preparation.is_alive():
            # the loader waits as long as for any board, and tries again later
            preparation.join(LOAD_S)
        if preparation.is_alive() or preparation.identity != wanted:
            raise RefusedError(
                ErrorCode.BUSY,
                "its hardware is being compiled; program it again when the board reports the end",
            )
        self._preparation = None
        if preparation.simulation is None:
            raise preparation.error or SimulationError("the simulation of the hardware has not started")
        return preparation.simulation

    # ---- registers ------------------------------------------------------------------------------------

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on, or raise a RefusedError if the board lacks one of the words."""
        simulation = self._simulation
        if simulation is None:
            return self._blank.read(address, count)
        self._check_extent(address, count)
        words = bytearray()
        for first in range(0, count, MOST_WORDS):
            answer = simulation.read(address + 4 * first, min(count - first, MOST_WORDS))
            words += answer.words
            if answer.response:
                self._refuse(address + len(words), is_first=not words)
        # the hardware knows neither the simulator's speed nor the boards that it replaced
        for register, value in (
            (rm.CAP_SPEED, min(int(simulation.speed), ALL_ONES)),
            (rm.PROGRAMMED, self.programmed),
        ):
            if address <= register < address + 4 * count:
                WORD.pack_into(words, register - address, value)
        return bytes(words)

    def write(self, address: int, words: bytes | memoryview) -> None:
        """Write words from `address` on (see `Board.write`). Words before a refused word may have been written."""
        simulation = self._simulation
        if simulation is None:
            self._blank.write(address, words)
            return
        count = len(words) // 4
        self._check_extent(address, count)
        places = range(address, address + 4 * count, 4)
        writes = list(zip(places, struct.unpack(f"<{count}I", words), strict=True))
        if count > 1:
            # in a burst, doorbells take effect after all other words; a 0 written to a doorbell has no effect
            rings = [write for write in writes if write[0] in _DOORBELLS and write[1]]
            writes = [write for write in writes if write[0] not in _DOORBELLS] + rings
        # one by one, up to the first that is refused
        refused = next((place for place, word in writes if not simulation.write(place, word)), None)
        if address <= rm.RESUME and address + len(words) > rm.CONTROL:
            self._look()
        if refused is not None:
            self._refuse(refused, is_first=refused == address)

    def _check_extent(self, address: int, count: int) -> None:
        """Refuse an access outside the map, because the hardware's address is too narrow for one."""
        if not count or address >= rm.BAR_SIZE:
            raise RefusedError(ErrorCode.OUTSIDE, f"nothing is at {address:#06x}")
        if address + 4 * count > rm.BAR_SIZE:
            self.read(address, 1)
            raise RefusedError(ErrorCode.TOO_LONG, f"{count} words from {address:#06x} on exceed the map")

    def _refuse(self, address: int, *, is_first: bool) -> NoReturn:
        """Raise a RefusedError with the code that the hardware reports for the word at `address`."""
        status = self._word(rm.STATUS)
        code = ErrorCode(field_of(rm.STATUS_ERROR_MASK, status))
        if code is ErrorCode.OUTSIDE and not is_first:
            code = ErrorCode.TOO_LONG  # the hardware sees single words
        raise RefusedError(code, _DETAILS.get(code, f"the hardware refuses the access to {address:#06x}"))

    def _word(self, address: int) -> int:
        (value,) = WORD.unpack(self.read(address, 1))
        return int(value)

    # ---- the machine ----------------------------------------------------------------------------------

    def step(self) -> None:
        """Run the machine for one more chunk of about 50 ms. Then `running` tells whether to call `step` again."""
        if self._simulation is None or not self.running:
            return
        began = time.monotonic()
        answer = self._simulation.run(self._chunk)
        elapsed = time.monotonic() - began
        if not answer.response and elapsed < CHUNK_S / 2:
            self._chunk *= 2
        elif elapsed > CHUNK_S * 1.5:
            self._chunk = max(int(self._chunk * CHUNK_S / elapsed), _SHORTEST_CHUNK)
        self._look()

    def _look(self) -> None:
        """Read from the hardware whether the machine runs."""
        # DONE comes second: the machine may stop between the two reads
        status = self._word(rm.STATUS)
        self.done = self._word(rm.DONE)
        self.running = field_of(rm.STATUS_STATE_MASK, status) == BoardState.RUNNING

    def interrupt_words(self) -> bytes:
        """Return the payload of an interrupt: the registers from DONE to COMPUTE_NS. The results are not included."""
        return self.read(rm.DONE, DONE_BLOCK.size // 4)

    def release(self) -> None:
        """Stop a running machine and disable interrupts. The server calls this after the host has disconnected."""
        if self._simulation is None:
            self._blank.release()
            return
        if self.running:
            self.write(rm.CONTROL, WORD.pack(rm.CONTROL_RESET_MASK))
        self.write(rm.CONTROL, WORD.pack(0))


class _Preparation(threading.Thread):
    """A thread that compiles and starts the hardware of an image. It ends with a simulation or an error."""

    def __init__(self, simulate: Callable[[Image], Simulation], image: Image) -> None:
        super().__init__(daemon=True, name="compilation")
        self._simulate = simulate
        self._image = image
        self.identity = image.image_hash, image.partition
        self.simulation: Simulation | None = None
        self.error: SimulationError | None = None

    def run(self) -> None:
        """Compile and start the simulation, measure its speed, and power the hardware up."""
        simulation = None
        try:
            simulation = self._simulate(self._image)
            simulation.power_up()
            simulation.speed = _measure_speed(simulation, self._image)
            # again, because measuring has written registers
            simulation.power_up()
            self.simulation = simulation
        except SimulationError as error:
            self.error = error
            if simulation is not None:
                simulation.close()

    def close(self) -> None:
        """End the simulation, if it has been started."""
        if self.simulation is not None:
            self.simulation.close()


def _measure_speed(simulation: Simulation, image: Image) -> float:
    """Return the clocks per second of the slowest frame."""
    host = image.kind.on_host([image.machine])
    course = host.begin(host.slowest())
    places = [(rm.BLOCKS[name], words) for name, words in course.starts[0].items()]
    for address, words in [*places, (rm.TARGET_COUNT, SETTINGS.pack(*course.settings))]:
        for at, (word,) in enumerate(WORD.iter_unpack(words)):
            simulation.write(address + 4 * at, word)
    simulation.write(rm.CONTROL, rm.CONTROL_INTERRUPT_ENABLE_MASK)
    number = clocks = 0
    chunk = _SHORTEST_CHUNK
    began = time.monotonic()
    is_done = True
    while (elapsed := time.monotonic() - began) < _MEASURED_S:
        if is_done:
            number += 1
            simulation.write(rm.START, number)
        answer = simulation.run(chunk)
        clocks += answer.clocks
        is_done = answer.response != 0
        chunk = chunk if is_done else 2 * chunk
    return clocks / elapsed
