"""Message definitions (the fields of each type) from `rosbags`, if it is installed.

The hub forwards JSON without definitions. It needs them for three purposes:

- to fill absent fields,
- to send CBOR with typed arrays (without `rosbags`, only arrays of floats are typed),
- to serialise messages (`cbor-raw`) and describe types for rosapi (without `rosbags`, both are refused).

The first operation that needs `rosbags` imports it.
"""

import contextlib
import time
from base64 import b64encode
from collections.abc import Callable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

import cbor2

from bridge.codecs.message_check import element_of
from bridge.errors import BridgeError
from bridge.hub.conversions import DEFAULTS, DUMMY, ROS1_TIME, TIMES, Builder, Encode, cbor_encoder, fields_of
from bridge.hub.filling import Filler
from bridge.hub.interfaces import PARTS, message_texts, part_name
from bridge.hub.limits import RefusedOperationError
from bridge.names import RosVersion, ros1_type, ros2_type
from bridge.stamps import stamp

if TYPE_CHECKING:
    from rosbags.typesys import Stores
    from rosbags.typesys.store import Typestore

# A message to be serialised may have one value per so many bytes of the size limit; a `{}` in an array can stand for
# dozens of values.
_BYTES_A_VALUE: Final = 16
_HEADER: Final = "std_msgs/msg/Header"
_TIME_FIELDS: Final = {1: ("secs", "nsecs"), 2: ("sec", "nanosec")}
# The only field of the common ROS 2 messages whose default is not zero.
_ONE: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}
_MISSING: Final = (
    "the hub has no message definitions: install rosbags (pip install rosbags) and start the hub again"
)


class MessageDefinitions:
    """The definitions of all known message types in one ROS version."""

    def __init__(self, ros_version: RosVersion = 1, wall_clock: Callable[[], int] = time.time_ns) -> None:
        """Start without definitions. `wall_clock` returns nanoseconds since 1970. This time fills absent stamps."""
        self.ros_version: RosVersion = ros_version
        # None before `load`, and also afterwards if rosbags is not installed.
        self._store: Typestore | None = None
        self._is_loaded = False
        self._wall_clock = wall_clock
        # What was derived from the definitions, by the names of types as they were asked for.
        self._encoders: dict[str, Encode | None] = {}
        self._texts: dict[str, str] = {}
        # And by the names that rosbags uses.
        self._fillers: dict[str, Filler] = {}
        self._defaults: dict[str, dict[str, Any]] = {}

    def load(self) -> None:
        """Import rosbags and its message types. The first call takes a tenth of a second; later calls do nothing."""
        if not self._is_loaded:
            self._is_loaded = True
            with contextlib.suppress(ImportError):
                from rosbags.typesys import Stores

                self._store = _store(Stores.ROS2_JAZZY if self.ros_version == 2 else Stores.ROS1_NOETIC)

    def name(self, type_name: str) -> str:
        """Return the name of a message type in the form of `ros_version`."""
        return ros2_type(type_name) if self.ros_version == 2 else ros1_type(type_name)

    def filler(self, type_name: str) -> Filler | None:
        """Return the `Filler` that adds absent fields to messages of a type, or None if the type is unknown."""
        try:
            _store, known = self._known(type_name)
        except BridgeError:
            return None
        return self._filler(known)

    def fillers(self, type_name: str, kind: Literal["srv", "action"]) -> dict[str, Filler]:
        """Return a `Filler` for each known part of a service or action type, such as the part `Request`."""
        fillers = {part: self.filler(part_name(type_name, part, self.ros_version)) for part in PARTS[kind]}
        return {part: filler for part, filler in fillers.items() if filler is not None}

    def _filler(self, name: str) -> Filler:
        if name not in self._fillers:
            parts = tuple(
                (field, self._filler(element), length >= 0)
                for field, (element, length) in self.fields(name).items()
                if element not in DEFAULTS and self.fields(element)
            )
            self._fillers[name] = Filler(
                self.defaults(name), self._varying(name), parts, is_time=name in TIMES
            )
        return self._fillers[name]

    def fields(self, name: str) -> Mapping[str, tuple[str, int]]:
        """Return the element type and length of each field of a known message type, as `element_of` returns them."""
        if name in TIMES:
            return dict.fromkeys(_TIME_FIELDS[self.ros_version], ("uint32", -1))
        store, known = self._known(name)
        return {field: element_of(kind, content) for field, (kind, content) in fields_of(store, known)}

    def defaults(self, name: str) -> dict[str, Any]:
        """Return the defaults of a known message type's fields. The caller must not change the dictionary."""
        if name not in self._defaults:
            self._defaults[name] = {
                field: self._default(name, field, element, length)
                for field, (element, length) in self.fields(name).items()
            }
        return self._defaults[name]

    def _default(self, name: str, field: str, element: str, length: int) -> Any:
        one: Any = DEFAULTS[element] if element in DEFAULTS else self.defaults(element)
        if self.ros_version == 2:
            one = _ONE.get((name, field), one)
        if length < 0:
            return one
        # The reference server writes bytes as base64.
        return b64encode(bytes(length)).decode() if element in {"uint8", "char"} else [one] * length

    def _varying(self, name: str) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the fields of a type whose defaults depend on the time of receipt or on the message's other fields."""

        def now(_message: object) -> dict[str, int]:
            return stamp(self._wall_clock(), self.ros_version)

        def of_other_version(field: str) -> Callable[[dict[str, Any]], int]:
            return lambda message: given if type(given := message.get(field)) is int else 0

        if name in TIMES:
            own, other = _TIME_FIELDS[self.ros_version], _TIME_FIELDS[3 - self.ros_version]
            return {field: of_other_version(theirs) for field, theirs in zip(own, other, strict=True)}
        if name == _HEADER:
            return {"stamp": now}
        return {
            field: lambda message: self.defaults(_HEADER) | {"stamp": now(message)}
            for field, kind in self.fields(name).items()
            if kind == (_HEADER, -1)
        }

    def encode(self, type_name: str, message: dict[str, Any]) -> bytes | None:
        """Return a message as CBOR with typed arrays, or None if the type is unknown or the message does not fit."""
        try:
            if type_name not in self._encoders:
                store, known = self._known(type_name)
                self._encoders[type_name] = cbor_encoder(store, known, self.defaults, {})
            # JSON needs no check.
            return (self._encoders[type_name] or cbor2.dumps)(message)
        except (BridgeError, TypeError, ValueError, AttributeError):
            return None

    def serialise(self, type_name: str, message: dict[str, Any], max_size: int) -> bytes:
        """Serialise a message in the format of the hub's ROS version: as in ROS 1, or as CDR with the CDR header.

        Raises a RefusedOperationError if the type is unknown, or if the message does not fit the type.
        """
        store, known = self._known(type_name)
        try:
            built = Builder(store, max_size // _BYTES_A_VALUE).message(known, message, "")
            serialise = store.serialize_cdr if self.ros_version == 2 else store.serialize_ros1
            return bytes(serialise(built, known))
        except Exception as error:  # rosbags, NumPy and struct raise their own errors for unsuitable values
            raise RefusedOperationError(
                f"a message does not fit its type {self.name(type_name)}: {error}"
            ) from None

    def full_text(self, type_name: str) -> str:
        """Return the definitions of a type and its nested types as text, in the format of bag files.

        Raises a RefusedOperationError if the type's fields are unknown.
        """
        text = self._texts.get(type_name)
        if text is None:
            store, known = self._known(type_name)
            text, _digest = store.generate_msgdef(known, ros_version=self.ros_version)
            self._texts[type_name] = text
        return text

    def details(self, type_name: str) -> list[dict[str, Any]]:
        """Describe a type and its nested types as `rosapi_msgs/TypeDef`, or raise a RefusedOperationError."""
        store, known = self._known(type_name)
        found: dict[str, dict[str, Any]] = {}
        waiting = [known]
        while waiting:
            name = waiting.pop(0)
            if name in found:
                continue
            constants, fields = store.fielddefs[name][0], fields_of(store, name)
            elements = [element_of(kind, content) for _, (kind, content) in fields]
            nested = [element in store.fielddefs for element, _ in elements]
            found[name] = {
                "type": self._shown(name),
                "fieldnames": [self._field(name, field) for field, _ in fields],
                "fieldtypes": [
                    self._shown(element) if inner else element
                    for (element, _), inner in zip(elements, nested, strict=True)
                ],
                "fieldarraylen": [length for _, length in elements],
                "examples": [
                    "[]" if length >= 0 else "{}" if inner else str(DEFAULTS.get(element, ""))
                    for (element, length), inner in zip(elements, nested, strict=True)
                ],
                "constnames": [constant for constant, _, _ in constants],
                "constvalues": [str(value) for _, _, value in constants],
            }
            waiting += [element for (element, _), inner in zip(elements, nested, strict=True) if inner]
        return list(found.values())

    def _shown(self, name: str) -> str:
        if self.ros_version == 1:
            return TIMES.get(name) or ros1_type(name)
        part = name.rpartition("_")[2]  # names of messages have no underscore
        kind = next(
            (kind for kind, parts in PARTS.items() if part in parts and "_" in name.rpartition("/")[2]), "msg"
        )
        return name.replace("/msg/", f"/{kind}/")

    def _field(self, type_name: str, field: str) -> str:
        return ROS1_TIME[field] if self.ros_version == 1 and type_name in TIMES else field

    def _known(self, type_name: str) -> "tuple[Typestore, str]":
        self.load()
        if self._store is None:
            raise RefusedOperationError(_MISSING)
        known = ros2_type(type_name)
        if not _define(self._store, known, self.ros_version):
            raise RefusedOperationError(f"the hub does not know the fields of {type_name}")
        return self._store, known


@cache
def _store(name: "Stores") -> "Typestore":
    """Return the types of a ROS version, one store for all hubs of a process."""
    from rosbags.typesys import get_typestore

    return get_typestore(name)


def _define(store: "Typestore", name: str, ros_version: RosVersion) -> bool:
    """Return whether the store has a type, or now has it from `message_texts`.

    If rosbags lacks the type, its definition in `message_texts`, if any, is added to the store.
    """
    if name in store.fielddefs:
        return True
    text = message_texts(ros_version).get(name)
    if text is None:
        return False
    from rosbags.typesys import get_types_from_msg

    types = get_types_from_msg(text, name)
    for field in types[name][1]:
        element, _length = element_of(*field[1])
        if element not in DEFAULTS:
            _define(store, element, ros_version)
    if ros_version == 1:
        types = {name: (types[name][0], [entry for entry in types[name][1] if entry[0] != DUMMY])}
    store.register(types)
    return True
