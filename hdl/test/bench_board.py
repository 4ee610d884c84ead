"""Comparison of the VHDL board with the emulated board.

Both boards get the same accesses and must give the same answers:

    random accesses --+--> AXI4-Lite --> bm1 (GHDL)  --> answers, counters, states of the generators
                      +--> EmulatedBoard             --> the same?

`simulation.run_bench` runs this cocotb module. The environment variable `HDL_SEED` selects the case.
"""

from __future__ import annotations

import copy
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import cocotb
import numpy as np
from cocotb.clock import Clock
from cocotb.triggers import ClockCycles, FallingEdge, RisingEdge
from cocotbext.axi import AxiLiteBus, AxiLiteMaster, AxiResp

from hdl.test.project import (
    BM1,
    BM1Kernel,
    BM1Machine,
    BoardState,
    EmulatedBoard,
    PriorMode,
    RefusedError,
    SensorMode,
    Start,
    StopReason,
    field_of,
    image_bytes,
    next_doorbell,
    reference_kernel,
)
from hdl.test.project import register_map as rm
from hdl.test.random_machines import Case, codes, random_case

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

FRAMES: Final = 5
"""Number of frames in a session; anything may happen between them."""

_ACCESS_CLOCKS: Final = 14
"""Maximum number of clocks of an access, from its first address bit to its answer."""

_NS: Final = 10
_NOT_COMPARED: Final = (rm.CAP_SPEED, rm.COMPUTE_NS, rm.COMPUTE_NS + 4)
"""Registers that are not compared, because the emulated board measures its real speed and time."""


class SlowKernel:
    """A kernel that pauses after each cycle. The tests can thus access the emulated board while the machine runs."""

    def __init__(self, machine: BM1Machine) -> None:
        self.kernel: BM1Kernel = reference_kernel(machine)
        self.slow = True

    def __getattr__(self, name: str) -> Any:
        return getattr(self.kernel, name)

    def start(self, start: Start) -> StopReason:
        """Run the first cycle of a frame; the board continues with `resume`."""
        return self.kernel.start(replace(start, run_until=1) if self.slow else start)

    def resume(self, run_until: int, halted: Collection[int] = ()) -> StopReason:
        """Run the next cycle of a slice, or all cycles of it if `slow` is False."""
        return self.kernel.resume(self.kernel.cycles + 1 if self.slow else run_until, halted)


class Both:
    """The simulated hardware and an emulated board. Each access is made on both, and both must answer alike."""

    def __init__(self, dut: Any, case: Case) -> None:
        self.dut = dut
        self.case = case
        self.machine = case.image.machine
        self.parameters = case.image.machine.parameters
        self.axi = AxiLiteMaster(
            AxiLiteBus.from_prefix(dut, "axi"), dut.clk_i, dut.rstn_i, reset_active_level=False
        )
        self.interrupts = 0
        self.expected_interrupts = 0
        self.refusals: set[str] = set()
        self.last = "nothing"
        self.power_up()

    def power_up(self) -> None:
        """Create a new emulated board, and reset the hardware with its pin."""
        self.board = EmulatedBoard(self._make, sends_results=False)
        self.board.load(image_bytes(self.case.image))
        self.slow.slow = True

    def _make(self, machine: BM1Machine) -> Any:
        self.slow = SlowKernel(machine)
        self.slow.slow = False  # while the board measures its speed
        return self.slow

    # ---- signals ---------------------------------------------------------------------------------------

    async def reset_pin(self) -> None:
        """Hold the hardware in reset for some clocks."""
        self.dut.rstn_i.value = 0
        await ClockCycles(self.dut.clk_i, 4)
        self.dut.rstn_i.value = 1
        await ClockCycles(self.dut.clk_i, 2)

    async def count_interrupts(self) -> None:
        """Count the clocks in which the interrupt is raised, until the simulation ends."""
        while True:
            await FallingEdge(self.dut.clk_i)
            self.interrupts += self.dut.irq_o.value == 1

    # ---- accesses ----------------------------------------------------------------------------------------

    async def hardware_read(self, address: int) -> int | None:
        """Read a word of the hardware; return None if the hardware refuses the read."""
        answer = await self.axi.read(address, 4 - address % 4)
        if answer.resp == AxiResp.SLVERR:
            return None
        assert answer.resp == AxiResp.OKAY
        return int.from_bytes(answer.data[:4], "little")

    async def read(self, address: int) -> int | None:
        """Read a word of both boards, compare the answers, and return the word; None if both refuse."""
        found = await self.hardware_read(address)
        try:
            expected: int | None = int.from_bytes(self.board.read(address, 1), "little")
        except RefusedError as error:
            expected = None
            self.refusals.add(error.code.name)
        if address in _NOT_COMPARED:
            assert (found is None) == (expected is None), f"read of {address:#07x}"
            return found
        assert found == expected, f"read of {address:#07x}: {found} instead of {expected}, after {self.last}"
        if found is None:
            await self.read(rm.STATUS)
        return found

    async def write(self, address: int, value: int) -> bool:
        """Write a word to both boards, compare the answers, and return whether the word was accepted."""
        answer = await self.axi.write(address, value.to_bytes(4, "little")[: 4 - address % 4])
        try:
            self.board.write(address, value.to_bytes(4, "little"))
            refused = None
        except RefusedError as error:
            refused = error
            self.refusals.add(error.code.name)
        expected = AxiResp.OKAY if refused is None else AxiResp.SLVERR
        assert answer.resp == expected, f"write of {value:#x} to {address:#07x}: {answer.resp}, {refused}"
        self.last = f"the write of {value:#x} to {address:#07x}"
        if refused is not None:
            await self.read(rm.STATUS)
        return refused is None

    async def write_long(self, address: int, value: int) -> None:
        """Write a 64-bit value to both boards."""
        await self.write(address, value & 0xFFFFFFFF)
        await self.write(address + 4, value >> 32)

    # ---- comparisons -------------------------------------------------------------------------------------

    def states(self) -> list[int]:
        """Return the states of the hardware's generators."""
        word = int(self.dut.core.states.value)
        count = self.slow.rng_state.size
        width = len(self.dut.core.states) // count
        return [word >> width * at & (1 << width) - 1 for at in range(count)]

    def compare_states(self) -> None:
        """Compare the states of all generators."""
        expected = self.slow.rng_state.ravel().tolist()
        found = self.states()
        assert found == expected, f"generators: {found} instead of {expected}"

    async def compare_outcome(self) -> None:
        """Compare status, cycles, doorbells, all results and outcomes, and the states of the generators."""
        for address in (rm.STATUS, rm.DONE, rm.CYCLES, rm.CYCLES + 4, rm.START, rm.RESUME):
            await self.read(address)
        results = BM1.registers(self.parameters).result_words
        for word in range(results):
            await self.read(rm.RESULTS + 4 * word)
        if self.parameters.replicas > 1:
            for word in range(4 * self.parameters.replicas):
                await self.read(rm.OUTCOMES + 4 * word)
        await self.wait_for_seeds()
        self.compare_states()

    async def compare_everything(self) -> None:
        """Compare both boards' implemented words, and the first unimplemented word after each block."""
        for block in rm.BLOCKS.values():
            for word in range(block.words):
                if await self.read(block + 4 * word) is None and block not in _NOT_COMPARED:
                    break

    async def wait_for_seeds(self) -> None:
        """Wait until all generators have their seeds after a reset. Loading the seeds takes one clock per generator."""
        for _ in range(self.slow.rng_state.size + 8):
            if self.dut.core.seeds_ready.value == 1 and self.dut.rstn_i.value == 1:
                return
            await RisingEdge(self.dut.clk_i)
        raise AssertionError("the seeds are not loaded")

    # ---- running -----------------------------------------------------------------------------------------

    def cycles_left(self) -> int:
        """Return the number of cycles that the emulated machine has yet to run in this slice."""
        if not self.board.running:
            return 0
        kernel = copy.deepcopy(self.slow.kernel)
        before = kernel.cycles
        (run_until,) = np.frombuffer(self.board.read(rm.RUN_UNTIL, 2), "<u8")
        kernel.resume(int(run_until))
        return kernel.cycles - before

    async def finish(self) -> None:
        """Wait until both boards have stopped, and compare them."""
        self.slow.slow = False
        while self.board.running:
            self.board.step()
        self.slow.slow = True
        left = 5000
        while left and self.dut.running.value == 1:
            await RisingEdge(self.dut.clk_i)
            left -= 1
        assert left, "the hardware does not stop"
        if self.board.interrupt_enabled:
            self.expected_interrupts += 1
        await self.compare_outcome()
        assert self.interrupts == self.expected_interrupts, "interrupts"


class Session:
    """Frames on both boards, with every correct and incorrect access that a host may make."""

    def __init__(self, both: Both) -> None:
        self.both = both
        self.parameters = both.parameters
        self.random = np.random.default_rng(both.case.seed + 1_000_000)
        self.inputs = rm.SENSORS if self.is_plain else rm.INPUTS

    @property
    def is_plain(self) -> bool:
        """True if the machine takes its inputs from SENSORS, not from INPUTS."""
        return self.parameters.replicas == 1 and self.parameters.sensor_mode is SensorMode.COLUMN

    def chance(self, probability: float) -> bool:
        """Return True with this probability."""
        return bool(self.random.random() < probability)

    def pick(self, choices: Sequence[int]) -> int:
        """Return one of the choices."""
        return int(choices[int(self.random.integers(len(choices)))])

    async def frame(self) -> None:
        """Write settings, start, and run a frame to its end, or until a reset."""
        both = self.both
        if self.chance(0.4):
            await self.wrong_accesses()
        await self.write_inputs()
        await self.write_settings()
        if self.chance(0.25):
            await self.wrong_start()
        due = next_doorbell(both.board.done)
        assert await both.write(rm.START, due)
        if await self.while_running(due):
            return
        while True:
            await both.finish()
            status = await both.read(rm.STATUS)
            assert status is not None
            if field_of(rm.STATUS_STOP_REASON_MASK, status) != StopReason.SLICE:
                return
            due = next_doorbell(both.board.done)
            if self.chance(0.15) or not await self.resume():
                return
            if await self.while_running(due):
                return

    async def frame_of_many_slices(self) -> None:
        """Run a frame in slices of few cycles; replicas that are halted after the first slice stay halted."""
        p, both = self.parameters, self.both
        await self.write_inputs()
        for address, value in ((rm.TARGET_COUNT, p.target_count_max), (rm.BANK, 0), (rm.PRIOR_SELECT, 0)):
            await both.write(address, value)
        await both.write_long(rm.MAX_CYCLES, 400)
        end = 1
        await both.write_long(rm.RUN_UNTIL, end)
        doorbell, mask = rm.START, 0
        for at in range(5):
            due = next_doorbell(both.board.done)
            if not await both.write(doorbell, due):
                return  # the frame has ended, so no replica can continue
            await both.finish()
            end += self.pick([1, 2, 9])
            await both.write_long(rm.RUN_UNTIL, end)
            if p.replicas > 1:
                mask = 1 << int(self.random.integers(p.replicas)) if at in {0, 2} else 0
                await both.write(rm.HALT, mask & 0xFFFFFFFF)
            doorbell = rm.RESUME

    # ---- writes of a host -------------------------------------------------------------------------------

    async def write_inputs(self) -> None:
        """Write priors and readings, some of which are missing."""
        p, both = self.parameters, self.both
        words = self.readings().ravel().tolist()
        for at, word in enumerate(words):
            await both.write(self.inputs + 4 * at, word)
        if p.replicas > 1:
            for replica in range(p.replicas):
                row = int(self.random.integers(p.prior_addresses))
                await both.write(rm.PRIOR_SELECTS + 4 * replica, row)
        if p.prior_mode is PriorMode.WRITTEN and self.chance(0.7):
            rows = codes(self.random, p, p.replicas, 0.05, 0.8).ravel().tolist()
            for at, word in enumerate(rows):
                await both.write(rm.PRIOR_CODES + 4 * at, word)

    def readings(self) -> NDArray[np.int64]:
        """Return a frame's inputs; a third of the readings are missing."""
        p = self.parameters
        if not p.sensors:
            return np.empty(0, np.int64)
        tops = (1 << np.array(p.sensor_bits, dtype=np.int64)) - 1
        shape = p.input_shape
        tops = tops if p.sensor_mode is SensorMode.COLUMN else tops[:, np.newaxis]
        if p.has_tables:
            drawn = self.random.integers(1 if self.chance(0.8) else 0, tops + 1, shape)
        else:
            rows = p.replicas * p.sensors
            drawn = codes(self.random, p, rows, 0.03, 0.85).reshape(shape).astype(np.int64)
        by_column = drawn.reshape(p.replicas * p.sensors, -1)
        for at in range(len(by_column)):
            if self.chance(1 / 3):
                by_column[at] = (1 << p.sensor_bits[at % p.sensors]) - 1
        if self.chance(0.1):
            # without readings and with a prior of ones, every line overflows in the same cycle
            drawn[:] = np.broadcast_to(tops, shape)
        return drawn

    async def write_settings(self) -> None:
        """Write random values of target count, limits and bank. Often two stop reasons then occur in one cycle."""
        p, both = self.parameters, self.both
        target = int(
            self.random.choice(
                [
                    1,
                    2,
                    int(self.random.integers(1, 40)),
                    int(self.random.integers(1, 200)),
                    p.target_count_max,
                ]
            )
        )
        await both.write(rm.TARGET_COUNT, min(target, p.target_count_max))
        most = self.pick([1, 2, int(self.random.integers(1, 100)), 150, 300, 600])
        bank = int(self.random.integers(p.rng_banks))
        until = self.pick([0, 0, 1, int(self.random.integers(1, 80)), 64, most])
        await both.write(rm.BANK, bank)
        if p.replicas == 1:
            await both.write(rm.PRIOR_SELECT, int(self.random.integers(p.prior_addresses)))
        await both.write_long(rm.MAX_CYCLES, most)
        await both.write_long(rm.RUN_UNTIL, until)
        if self.chance(0.4):
            last = self.last_cycle()
            if last > 1:
                most = last + self.pick([-1, 0, 0, 1])
                until = last + self.pick([-1, 0, 1]) if self.chance(0.5) else 0
                await both.write_long(rm.MAX_CYCLES, most)
                await both.write_long(rm.RUN_UNTIL, until)
        await both.write(rm.CONTROL, rm.CONTROL_INTERRUPT_ENABLE_MASK if self.chance(0.7) else 0)

    def last_cycle(self) -> int:
        """Return the cycle at which a frame with the current settings would stop without slices."""
        twin = copy.deepcopy(self.both.slow.kernel)
        board = EmulatedBoard(lambda _: twin)
        board.load(image_bytes(self.both.case.image))
        twin.__dict__.update(copy.deepcopy(self.both.slow.kernel).__dict__)
        used = BM1.registers(self.parameters)
        copied = [(self.inputs, used.input_words), (rm.TARGET_COUNT, 1), (rm.BANK, 1), (rm.PRIOR_SELECT, 1)]
        if self.parameters.replicas > 1:
            copied.append((rm.PRIOR_SELECTS, self.parameters.replicas))
        if self.parameters.prior_mode is PriorMode.WRITTEN:
            copied.append((rm.PRIOR_CODES, used.result_words))
        for address, words in copied:
            if words:
                board.write(address, self.both.board.read(address, words))
        board.write(rm.MAX_CYCLES, (600).to_bytes(8, "little"))
        board.write(rm.START, (1).to_bytes(4, "little"))
        while board.running:
            board.step()
        return twin.cycles

    # ---- refused accesses -------------------------------------------------------------------------------

    async def wrong_accesses(self) -> None:
        """Access words that do not exist, and read or write words where that is not allowed."""
        both = self.both
        inputs, results = both.case.image.interface_sensors, both.case.image.interface_results
        places = [
            0x010,
            0x154 + 4,
            rm.HALT + 4 * rm.HALT.words,
            rm.ID,
            rm.CAP_LINES,
            rm.STATUS,
            rm.DONE,
            rm.SENSORS,
            self.inputs + 4 * inputs,
            self.inputs + 4 * (inputs - 1),
            rm.RESULTS + 4 * results,
            rm.RESULTS + 4 * (results - 1),
            rm.PRIOR_SELECTS,
            rm.PRIOR_SELECTS + 4 * self.parameters.replicas,
            rm.OUTCOMES,
            rm.OUTCOMES + 16 * self.parameters.replicas,
            rm.PRIOR_CODES,
            rm.PRIOR_CODES + 4 * (results - 1),
            rm.PRIOR_CODES + 4 * results,
            rm.INPUTS,
            rm.BAR_SIZE - 4,
            int(self.random.integers(rm.BAR_SIZE // 4)) * 4,
            int(self.random.integers(0x200)),
            rm.TARGET_COUNT + 1,
            rm.ID + 2,
        ]
        for place in self.random.choice(places, 8).tolist():
            # an input keeps what is written to it, so it must be a value that a start accepts
            if self.chance(0.5):
                await both.write(place, 0)
            await both.read(place)
        await both.write(rm.LIVENESS, int(self.random.integers(2**32)))
        await both.read(rm.LIVENESS)

    async def wrong_start(self) -> None:
        """Ring the doorbell with a wrong number or wrong settings, then correct them."""
        p, both = self.parameters, self.both
        due = next_doorbell(both.board.done)
        await both.write(rm.START, 0)
        await both.write(rm.RESUME, 0)
        for number in (due + 1, both.board.done, 0xFFFFFFFF):
            if number not in {0, due}:
                assert not await both.write(rm.START, number)
                assert not await both.write(rm.RESUME, number)
        results = BM1.registers(p).result_words
        wrong = [
            (rm.TARGET_COUNT, 0),
            (rm.BANK, p.rng_banks),
            (rm.BANK, 0x80000000),
            (rm.RUN_UNTIL + 4, 0x80000000),
            (rm.MAX_CYCLES + 4, 0x80000000),
            (rm.PRIOR_SELECT, p.prior_addresses),
            (rm.PRIOR_SELECT, 0x10000),
        ]
        if p.counter_bits < 32:
            wrong.append((rm.TARGET_COUNT, p.target_count_max + 1))
        for column in range(p.sensors):
            at = column * (1 if p.sensor_mode is SensorMode.COLUMN else p.lines)
            wrong.append((self.inputs + 4 * at, 1 << p.sensor_bits[column]))
            wrong.append((self.inputs + 4 * at, 0xFFFF0000))
        if p.replicas > 1:
            wrong.append((rm.PRIOR_SELECTS + 4 * (p.replicas - 1), p.prior_addresses))
        if p.prior_mode is PriorMode.WRITTEN:
            wrong.append((rm.PRIOR_CODES + 4 * (results - 1), p.ones_code + 1))
        for at in self.random.permutation(len(wrong))[:4].tolist():
            address, value = wrong[at]
            before = await both.read(address)
            assert before is not None
            await both.write(address, value)
            await both.read(address)
            if await both.write(rm.START, due):  # this machine ignores the value
                await both.finish()
                due = next_doorbell(both.board.done)
            await both.write(address, before)

    # ---- accesses while a frame runs --------------------------------------------------------------------

    async def while_running(self, number: int) -> bool:
        """Try accesses while the frame of doorbell `number` runs, and return whether a reset ended it."""
        both = self.both
        left = both.cycles_left()
        if self.chance(0.15):
            await self.reset_while_running(left, number)
            return True
        if self.chance(0.05):
            await ClockCycles(both.dut.clk_i, int(self.random.integers(0, left + 10)))
            if both.board.running:
                both.power_up()
                both.interrupts = both.expected_interrupts = 0
                await both.reset_pin()
                both.interrupts = 0
                await both.compare_everything()
                return True
        accesses = min((left - 10) // (3 * _ACCESS_CLOCKS), 6)
        for _ in range(max(accesses, 0)):
            address = self.pick(
                [rm.TARGET_COUNT, self.inputs, rm.START, rm.RESUME, rm.CONTROL, rm.BANK, rm.HALT]
            )
            value = self.pick([0, 1, 2, number, next_doorbell(number)])
            if not (address == rm.CONTROL and value & 1):
                assert not await both.write(address, value)
                status = await both.read(rm.STATUS)
                assert status is not None
                assert status & rm.STATUS_STATE_MASK == BoardState.RUNNING
        return False

    async def reset_while_running(self, left: int, number: int) -> None:
        """Reset both boards at a random clock cycle of a frame, or just after its end."""
        both = self.both
        while not both.board.running and both.dut.running.value == 1:
            await RisingEdge(both.dut.clk_i)  # a frame of one cycle or none, while its seeds are loaded
        wait = int(self.random.integers(0, left + 12))
        await ClockCycles(both.dut.clk_i, wait)
        control = rm.CONTROL_RESET_MASK | rm.CONTROL_INTERRUPT_ENABLE_MASK * self.chance(0.5)
        raised = both.board.interrupt_enabled
        answer = await both.axi.write(rm.CONTROL, int(control).to_bytes(4, "little"))
        assert answer.resp == AxiResp.OKAY
        done = await both.hardware_read(rm.DONE)
        if done == number:
            # it has stopped just before
            assert wait + _ACCESS_CLOCKS >= left, "the machine stopped too early"
            both.slow.slow = False
            while both.board.running:
                both.board.step()
            both.slow.slow = True
            both.expected_interrupts += raised
        else:
            seeds = both.slow.rng_state.size
            assert wait <= left + seeds + _ACCESS_CLOCKS, "the machine ran too long"
        both.board.write(rm.CONTROL, int(control).to_bytes(4, "little"))
        await both.compare_outcome()
        assert both.interrupts == both.expected_interrupts, "interrupts"

    async def resume(self) -> bool:
        """Ring the doorbell for the next slice, and return whether the slice runs."""
        p, both = self.parameters, self.both
        due = next_doorbell(both.board.done)
        cycles = both.slow.cycles
        if self.chance(0.3):
            await both.write_long(rm.RUN_UNTIL, cycles)
            assert not await both.write(rm.RESUME, due)
            assert not await both.write(rm.RESUME, next_doorbell(due))
        if self.chance(0.4):
            # the frame keeps the readings and the target with which it was started
            await self.write_inputs()
            await both.write(rm.TARGET_COUNT, 1)
            await both.write_long(rm.MAX_CYCLES, 1)
        await both.write_long(rm.RUN_UNTIL, self.pick([0, cycles + 1, cycles + 7, 2 * cycles, cycles + 100]))
        if p.replicas > 1:
            mask = int(self.random.integers(2**p.replicas)) if self.chance(0.5) else 0
            if self.chance(0.1):
                mask |= 1 << p.replicas
            for word in range(rm.HALT.words):
                await both.write(rm.HALT + 4 * word, mask >> 32 * word & 0xFFFFFFFF)
        if await both.write(rm.RESUME, due):
            return True
        # no replica can continue, or the mask halts a replica that does not exist
        for word in range(rm.HALT.words):
            await both.write(rm.HALT + 4 * word, 0)
        return await both.write(rm.RESUME, due)


@cocotb.test()
async def same_as_the_emulated_board(dut: Any) -> None:
    """Run a session, drawn from the case's seed, on both boards."""
    case = random_case(int(os.environ["HDL_SEED"]))
    frames = int(os.environ.get("HDL_FRAMES", FRAMES))
    for channel in ("awvalid", "wvalid", "arvalid", "bready", "rready"):
        getattr(dut, f"axi_{channel}").value = 0
    dut.rstn_i.value = 0
    Clock(dut.clk_i, _NS, "ns").start(start_high=False)
    both = Both(dut, case)
    await both.reset_pin()
    cocotb.start_soon(both.count_interrupts())
    await both.compare_everything()
    await both.wait_for_seeds()
    both.compare_states()
    session = Session(both)
    for _ in range(frames):
        if session.chance(0.3):
            await both.write(rm.CONTROL, rm.CONTROL_RESET_MASK)
            await both.compare_outcome()
        await session.frame()
        if session.chance(0.3):
            await session.frame_of_many_slices()
    await both.compare_everything()
