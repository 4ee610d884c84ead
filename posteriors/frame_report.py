"""The report of each frame on the topic `/bm/frame`. Writing and reading use the same keys."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, Final, Literal, NamedTuple

import orjson
from pydantic import BeforeValidator, Field, FiniteFloat, TypeAdapter

from bridge.stamps import header, stamp_ns
from pcie_shim.wires import WIRES
from posteriors.messages import Part, validated

FRAME_TOPIC: Final = "/bm/frame"
FRAME_TYPE: Final = "diagnostic_msgs/DiagnosticArray"


@dataclass(frozen=True, slots=True, kw_only=True)
class StageTimes:
    """The duration of each stage of a frame in microseconds, or None if it is not reported (thesis figure 4.5)."""

    rosbridge_in: FiniteFloat | None = None
    local_hops: FiniteFloat | None = None
    waited: FiniteFloat | None = None
    register_writes: FiniteFloat | None = None
    compute: FiniteFloat | None = None
    reads: FiniteFloat | None = None
    boards_compute: FiniteFloat | None = None
    rosbridge_out: FiniteFloat | None = None
    """The time to send the previous frame's posterior. A report is sent before the posterior of its own frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardReport:
    """The outcome of a frame on one board, and on each replica of the board."""

    name: str
    stopped: str
    cycles: int | None = None
    counts_total: int | None = None
    replica_cycles: tuple[int, ...] = ()
    replica_stopped: tuple[str, ...] = ()


def _number_or_text(value: object) -> object:
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        return value
    return number if math.isfinite(number) else value


class VariableReading(NamedTuple):
    """The reading of a variable in a frame."""

    value: Annotated[float | str, BeforeValidator(_number_or_text)]
    """The received value: a float to nine digits, or a str for the name of a state, infinity or NaN."""
    address: int
    """Address in the variable's column."""
    age_ms: FiniteFloat
    """Age of the reading when the report is created, in milliseconds. docs/reference/topics.md defines this age."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameReport:
    """The content of a `/bm/frame` message. Attributes that end in `_ns` are Unix times in nanoseconds."""

    stamp_ns: int
    """Time of the reading."""
    heard_ns: int = 0
    """Arrival of the report in this process."""
    outcome: str
    deployment: str = ""
    published: bool = True
    number: int | None = None
    cycles: int | None = None
    counts_total: int | None = None
    link_bytes: int | None = None
    """Bytes between pcie-app and all boards, in both directions."""
    link_transfers: int | None = None
    """Number of transfers that carried the `link_bytes`."""
    received_ns: int | None = None
    """Time at which the subscriber received the reading."""
    sent_ns: int | None = None
    """Time at which the posterior was sent."""
    stages: StageTimes = StageTimes()
    boards: tuple[BoardReport, ...] = ()
    details: Mapping[str, str] = field(default_factory=dict)
    """Further values, whose keys depend on the kind of machine."""
    missing: tuple[str, ...] = ()
    """Names of the variables without a reading."""
    readings: Mapping[str, VariableReading] = field(default_factory=dict)
    """The reading of each variable, by the variable's name. Readings that are arrays are left out."""

    @property
    def is_biased(self) -> bool:
        """True if a board of a BM2 reached the maximum number of cycles. `outcome` says which boards did so."""
        return "ended_early" in self.details

    def link_us(self, rate: str) -> float | None:
        """Return the modelled time in microseconds for all transfers of the frame, made one after another.

        `rate` is a value of `--link-rate`. The result is None if the report has no bytes.
        """
        if self.link_bytes is None or self.link_transfers is None:
            return None
        return 1e6 * WIRES[rate].seconds(self.link_bytes, self.link_transfers)


# Keys of the message's values and their formats. The key of a number is the name of its field; the
# key of a stage has the suffix `_us`.
_STAGES: Final = tuple(each.name for each in fields(StageTimes))
_FRAME_KEYS: Final = {
    "number": "%d",
    "published": "%s",
    "cycles": "%d",
    "counts_total": "%d",
    "link_bytes": "%d",
    "link_transfers": "%d",
    "received_ns": "%d",
    "sent_ns": "%d",
    **{f"{stage}_us": "%.1f" for stage in _STAGES},
    "missing": "%s",
}
_READING: Final = "reading."
"""Prefix of the keys of readings, before the name of the variable."""
_BOARD_KEYS: Final = {"cycles": "%d", "counts_total": "%d", "reason": "%s"}
_REPLICA_KEYS: Final = {"replica_cycles": "%s", "replica_reasons": "%s"}
_FORMS: Final = _FRAME_KEYS | _BOARD_KEYS | _REPLICA_KEYS
_OF_FRAME, _OF_BOARD, _OF_REPLICAS = map(tuple, (_FRAME_KEYS, _BOARD_KEYS, _BOARD_KEYS | _REPLICA_KEYS))
_numbers: Final = attrgetter(
    "cycles", "counts_total", "link_bytes", "link_transfers", "received_ns", "sent_ns"
)
_times: Final = attrgetter(*_STAGES)


# Every result is preceded by a report, so a template is formatted once and only filled in for each frame.
@cache
def _template(keys: tuple[str, ...]) -> str:
    """Return a DiagnosticStatus as a JSON format, with `%` in place of level, name, message, hardware and values."""
    pairs = ",".join(f'{{"key":"{key}","value":"{_FORMS[key]}"}}' for key in keys)
    return f'{{"level":%d,"name":"rosbayes: %s","message":%s,"hardware_id":%s,"values":[{pairs}]}}'


def _status(keys: tuple[str, ...], head: tuple[object, ...], values: tuple[object, ...]) -> str:
    """Return a DiagnosticStatus as JSON: the fields in `head`, then the `values` that are not None, under `keys`."""
    if None in values:
        keys = tuple(key for key, value in zip(keys, values, strict=True) if value is not None)
        values = tuple(value for value in values if value is not None)
    return _template(keys) % (*head, *values)


def write_frame_report(report: FrameReport, ros_version: Literal[1, 2]) -> dict[str, Any]:
    """Return a report as a diagnostic_msgs/DiagnosticArray. Unknown values (None) are left out."""
    frame = _status(
        _OF_FRAME,
        (
            not report.published or report.is_biased,
            "frame",
            _quoted(report.outcome),
            _quoted(report.deployment),
        ),
        (
            *(
                report.number,
                "true" if report.published else "false",
                *_numbers(report),
                *_times(report.stages),
            ),
            _quoted(",".join(report.missing))[1:-1] if report.missing else "",
        ),
    )
    pairs = [f',{{"key":{_quoted(key)},"value":{_quoted(value)}}}' for key, value in report.details.items()]
    for name, (value, address, age_ms) in report.readings.items():
        text = _quoted(value)[1:-1] if isinstance(value, str) else f"{value:.9g}"
        pairs.append(f'{_reading_begin(name)}{text};{address};{age_ms:.1f}"}}')
    statuses = [f"{frame.removesuffix(']}')}{''.join(pairs)}]}}" if pairs else frame]
    for index, board in enumerate(report.boards):
        reason = _quoted(board.stopped)
        head = (0, f"board {index}", reason, _quoted(board.name))
        values = (board.cycles, board.counts_total, reason[1:-1])
        if board.replica_cycles:
            cycles, reasons = map(str, board.replica_cycles), ",".join(board.replica_stopped)
            statuses.append(_status(_OF_REPLICAS, head, (*values, ",".join(cycles), _quoted(reasons)[1:-1])))
        else:
            statuses.append(_status(_OF_BOARD, head, values))
    return {
        "header": header(report.stamp_ns, "bm", ros_version),
        "status": orjson.Fragment(f"[{','.join(statuses)}]"),
    }


@cache
def _reading_begin(name: str) -> str:
    """Return the beginning of a reading's JSON pair, up to the value; cached, because a deployment has few names."""
    return f',{{"key":{_quoted(_READING + name)},"value":"'


def _quoted(text: str) -> str:
    return orjson.dumps(text).decode()


class _Header(Part):
    stamp: Annotated[int, BeforeValidator(stamp_ns)]


class _KeyValue(Part):
    key: str
    value: str


class _Status(Part):
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: tuple[_KeyValue, ...] = ()

    def by_key(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.values}


class _DiagnosticArray(Part):
    header: _Header
    status: Annotated[tuple[_Status, ...], Field(min_length=1)]


_ARRAY: Final = TypeAdapter(_DiagnosticArray)
_REPORT: Final = TypeAdapter(FrameReport)


def read_frame_report(message: dict[str, Any], heard_ns: int) -> FrameReport:
    """Return the report in a diagnostic_msgs/DiagnosticArray, or raise a BadResultError. Every key is optional."""
    array = validated(_ARRAY, message, FRAME_TOPIC, FRAME_TYPE)
    first, *others = array.status
    values = first.by_key()
    report = {
        **values,
        "stamp_ns": array.header.stamp,
        "heard_ns": heard_ns,
        "outcome": first.message,
        "deployment": first.hardware_id,
        "stages": {stage: values[key] for stage in _STAGES if (key := f"{stage}_us") in values},
        "boards": [_board(each) for each in others],
        "details": {
            key: value
            for key, value in values.items()
            if key not in _FRAME_KEYS and not key.startswith(_READING)
        },
        "missing": [name for name in values.get("missing", "").split(",") if name],
        "readings": {
            # from the right, because the name of a state may have a semicolon
            key.removeprefix(_READING): value.rsplit(";", 2)
            for key, value in values.items()
            if key.startswith(_READING)
        },
    }
    return validated(_REPORT, report, FRAME_TOPIC, FRAME_TYPE)


def _board(status: _Status) -> dict[str, Any]:
    values = status.by_key()
    cycles, reasons = (values.get(key, "") for key in _REPLICA_KEYS)
    return {
        **values,
        "name": status.hardware_id or status.name,
        "stopped": status.message,
        "replica_cycles": cycles.split(",") if cycles else (),
        "replica_stopped": reasons.split(",") if reasons else (),
    }
