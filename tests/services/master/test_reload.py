"""What a reload says of the frames that were under way, and of the readings that came during it."""

from collections import Counter
from types import SimpleNamespace

import pytest

from services.master.peers import Peer
from services.master.reload import LOST_IN_RELOAD, Reloads, what_became_of
from services.pipeline.frames import QUEUE_ALL_DEPTH
from services.pipeline.generations import InForce
from services.settings import Settings
from services.sockets.control_socket import ReloadOrder
from services.sockets.records import Prepare, Prepared, Reading, Switched
from tests.integration.conftest import build_boat
from toolchain.deployment import load_deployment

MEANWHILE = "; 3 readings that came meanwhile found no place to wait and were lost"


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ((0, 0), "0 frames were in flight and finished before"),
        ((1, 0), "1 frame was in flight and finished before"),
        ((5, 2), "5 frames were in flight: 3 finished before, 2 lost after 30 s"),
        ((1, 0, 3), f"1 frame was in flight and finished before{MEANWHILE}"),
        ((5, 2, 3), f"5 frames were in flight: 3 finished before, 2 lost after 30 s{MEANWHILE}"),
        (
            (0, 0, 1),
            "0 frames were in flight and finished before; 1 reading that came meanwhile found no place to wait and was lost",
        ),
    ],
)
def test_what_was_lost_is_not_finished(counts, said):
    assert what_became_of(*counts) == said


class Moves:
    """A run in which nothing is under way."""

    has_begun, waiting, under_way, in_flight = True, 0, "", 0

    def __init__(self):
        self.losses = Counter({LOST_IN_RELOAD: 40})  # of an earlier reload
        self.handed_on = None

    def hold(self):
        pass

    def go_on(self, readings=None):
        self.handed_on = readings

    def lose(self, reason, count):
        self.losses[reason] += count

    def lost_for(self, reason):
        return self.losses[reason]


class Willing:
    """A service that does at once what it is asked for; before that, `first` happens."""

    def __init__(self, role, first=lambda _: None):
        self.peer = Peer(role, None, None)
        self.peer.protocol, self.peer.ready = self, True
        self._first = first

    def send(self, record):
        self._first(record)
        answer = Prepared if isinstance(record, Prepare) else Switched
        self.peer.answered(answer(record.generation))
        return True


async def test_readings_that_find_no_place_while_boards_are_programmed_are_said(tmp_path):
    folder = build_boat(tmp_path / "boat")
    moves = Moves()

    def readings_come(record):
        if not isinstance(record, Prepare):
            for at in range(QUEUE_ALL_DEPTH + 3):
                reloads.wait((Reading(at, at, at, at, [0] * 6, 0, generation=1), at))

    peers = {role: Willing(role).peer for role in ("subscriber", "publisher")}
    app = Willing("pcie-app", readings_come).peer
    several = SimpleNamespace(
        subscriber=peers["subscriber"],
        publisher=peers["publisher"],
        app=app,
        not_ready=[],
        directory=None,
        board_endpoints=(),
        give=lambda *_: None,
    )
    in_force = InForce(load_deployment(folder), folder)
    reloads = Reloads(
        Settings(queue="all"), in_force, several, moves, SimpleNamespace(info=print, warning=print)
    )
    sentence = await reloads.order(ReloadOrder(str(folder)))
    assert f"0 frames were in flight and finished before{MEANWHILE}, " in sentence
    assert (in_force.generation, len(moves.handed_on)) == (1, QUEUE_ALL_DEPTH)
    assert moves.losses[LOST_IN_RELOAD] == 43
