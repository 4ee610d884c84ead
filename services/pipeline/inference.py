"""A frame's posterior, computed from the results of the boards, and the frame's report."""

from machines.kind import Inference
from posteriors.frame_report import BoardReport, FrameReport, StageTimes, VariableReading
from services.boards.frames import decode_boards
from services.sockets.records import FrameResult, Publish
from toolchain.deployment import Deployment


def infer(result: FrameResult, deployment: Deployment) -> Inference:
    """Compute the posterior from the results of all boards, as the deployment's kind of machine requires."""
    machine = deployment.machine
    return machine.kind.infer(decode_boards(result), machine.variables)


def report_of(
    publish: Publish,
    inference: Inference,
    deployment: Deployment,
    *,
    now: tuple[int, int],
    previous_out_ns: int,
) -> FrameReport:
    """Return the report of a frame.

    `now` is the present time in ns, as (Unix time, monotonic time). `previous_out_ns` is the time
    in ns that it took to send the previous result.
    """
    result = publish.result
    sent_ns, tick = now
    boards_ns = result.register_writes_ns + result.compute_ns + result.reads_ns
    # all times are of one monotonic clock, so what no process has measured was spent between them
    hops_ns = tick - publish.reading_sent_tick - publish.waited_ns - boards_ns
    reasons = deployment.machine.kind.reasons
    names = [variable.name for variable in deployment.variables]
    lost = deployment.filter is not None and inference.posterior is None
    ticks = publish.ticks or [publish.received_tick] * len(names)
    return FrameReport(
        stamp_ns=publish.stamp_ns,
        outcome=inference.outcome + ("; the filter goes on with its prediction" if lost else ""),
        deployment=deployment.name,
        published=inference.posterior is not None,
        number=result.number,
        cycles=max((board.cycles for board in inference.boards), default=0),
        counts_total=sum(inference.totals),
        link_bytes=result.link_bytes,
        link_transfers=result.link_transfers,
        received_ns=publish.received_ns,
        sent_ns=sent_ns,
        stages=StageTimes(
            rosbridge_in=max(0, publish.reading_sent_tick - publish.received_tick) / 1e3,
            local_hops=max(0, hops_ns) / 1e3,
            waited=publish.waited_ns / 1e3,
            register_writes=result.register_writes_ns / 1e3,
            compute=result.compute_ns / 1e3,
            reads=result.reads_ns / 1e3,
            boards_compute=result.boards_compute_ns / 1e3,
            rosbridge_out=previous_out_ns / 1e3,
        ),
        boards=tuple(
            BoardReport(
                name=f"board{index}",
                stopped=reasons[board.reason],
                cycles=board.cycles,
                counts_total=total,
                replica_cycles=board.replica_cycles,
                replica_stopped=tuple(reasons[reason] for reason in board.replica_reasons),
            )
            for index, (board, total) in enumerate(zip(inference.boards, inference.totals, strict=True))
        ),
        details=inference.details,
        missing=tuple(
            name for name, address in zip(names, publish.addresses, strict=False) if address is None
        ),
        readings={
            name: VariableReading(value, address, (tick - at) / 1e6)
            for name, value, address, at in zip(names, publish.values, publish.addresses, ticks, strict=False)
            if value is not None and address is not None
        },
    )
