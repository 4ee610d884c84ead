"""The modelled link, with times of the test's own; and what a board's server hands to it."""

import os

import pytest

from machines.kind import FrameInput
from pcie_shim.board.server import BoardServer
from pcie_shim.framing import HEADER_BYTES
from pcie_shim.host.mini_cluster import MiniCluster
from pcie_shim.link_rate import LinkModel, link_model
from pcie_shim.wires import WIRES, LinkFigures, LinkRate
from tests.pcie_shim.boards import images

SLOW = LinkFigures(8, 125, shared=False)
"""A byte takes a microsecond."""


def test_a_frame_occupies_the_wire_for_its_bits_and_arrives_after_the_latency():
    arrivals = []
    link = LinkModel(SLOW, arrivals.append)
    link.carry(100, 1_000_000)
    link.carry(50, 1_000_000)  # waits for the bits of the first, not for its latency
    link.carry(10, 2_000_000)  # the wire is free
    assert arrivals == [1_225_000, 1_275_000, 2_135_000]


@pytest.mark.parametrize(
    ("rate", "size", "us"), [(LinkRate.PCIE_GEN2, 2600, 1.5), (LinkRate.JTAG, 3000, 1125)]
)
def test_rates(rate, size, us):
    arrivals = []
    LinkModel(WIRES[rate], arrivals.append).carry(size, 5)
    assert arrivals == [5 + us * 1000]
    assert WIRES[rate].seconds(size) == pytest.approx(us * 1e-6)


def test_two_transfers_one_after_another():
    assert WIRES[LinkRate.PCIE_GEN2].seconds(5200, 4) == pytest.approx(4e-6)
    assert link_model(LinkRate.NONE) is None


@pytest.mark.process
@pytest.mark.parametrize(("shared", "left_ns"), [(True, 3_000_000), (False, 2_000_000)])
def test_only_a_shared_wire_is_that_of_other_processes(shared, left_ns):
    arrivals = []
    link = LinkModel(LinkFigures(8, 0, shared=shared), arrivals.append)
    child = os.fork()
    if not child:
        link.carry(1000, 1_000_000)
        os._exit(0)
    os.waitpid(child, 0)
    link.carry(1000, 1_000_000)
    assert arrivals == [left_ns]


@pytest.mark.parametrize("sends_results", [True, False])
def test_every_frame_of_a_host_is_carried_once_in_each_direction(start_board, monkeypatch, sends_results):
    carried = []
    monkeypatch.setattr(LinkModel, "carry", lambda _self, size, _sent_ns: carried.append(size))
    initialise = BoardServer.__init__
    monkeypatch.setattr(
        BoardServer, "__init__", lambda *given: initialise(*given[:-1], link_model(LinkRate.JTAG))
    )
    parts = images(3, [4])
    with MiniCluster.open([start_board(sends_results=sends_results).endpoint], parts) as boards:
        carried.clear()
        frame = FrameInput(
            addresses=(1, 2), target_count=10, max_cycles=900, bank=0, prior_address=0, stop="own"
        )
        output = boards.run(frame)
        assert output.boards[0].counts.max() == 10
        # sensors; settings with the doorbell; the answer from DONE on, with the counts
        assert carried[:2] == [HEADER_BYTES + 4 * words for words in (2, 8)]
        assert carried[2] == HEADER_BYTES + 4 * (6 + 4 * sends_results)
        # the requests for the counts and DONE come together, and so do their answers
        reads = [] if sends_results else [HEADER_BYTES, HEADER_BYTES, 2 * HEADER_BYTES + 4 * (4 + 6)]
        assert carried[3:] == reads
        # both writes are one post
        assert (output.link_bytes, output.link_transfers) == (sum(carried), 2 if sends_results else 4)
