"""Decoding of serialised ROS messages (`compression: cbor-raw`), in the format of ROS 1 or in CDR.

Types and decoding come from `rosbags` (the extra `messages`), which knows about 160 standard types; register
others with the text of their `.msg` file. It is imported with the first message.
"""

from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final

from bridge.errors import DecodeError, DefinitionError
from bridge.names import RosVersion, ros2_type

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# Headers of CDR: big and little endian, without options.
_CDR: Final = (b"\x00\x00\x00\x00", b"\x00\x01\x00\x00")
_TIMES: Final = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})


class MessageTypes:
    """The known types of serialised messages.

    types = MessageTypes()
    async for message in ros.subscribe("/scan", "sensor_msgs/LaserScan", compression="cbor-raw"):
        scan = types.read(message.raw, "sensor_msgs/LaserScan")
    """

    def __init__(self, ros_version: RosVersion | None = None) -> None:
        """Start with the standard types.

        Args:
            ros_version: The ROS version of the messages; None to detect it for each message.
        """
        self._version = ros_version
        # Definitions by name in the form of ROS 2.
        self._registered: dict[str, str] = {}
        # rosbags' types by ROS version, each made when a message first needs it; a new definition empties this.
        self._stores: dict[int, Typestore] = {}

    def register(self, type_name: str, definition: str) -> None:
        """Add a type that is not a standard one.

        Args:
            type_name: Its name, in the spelling of either ROS version.
            definition: The text of its `.msg` file; types that it uses may follow, each after a line of `=`
                and a line `MSG: package/Type`, as in bag files.

        Raises:
            DefinitionError: The text is not a definition, or rosbags is missing.
            NameFormError: The name is malformed.
        """
        name = ros2_type(type_name)
        # Parsed only to report an error at once; the stores parse it again.
        typesys = _rosbags()
        try:
            typesys.get_types_from_msg(definition, name)
        except Exception as error:  # the parser raises errors of several libraries
            reason = " ".join(str(error).split())[:200]
            raise DefinitionError(f"the definition of {type_name} cannot be read: {reason}") from None
        self._registered[name] = definition
        self._stores.clear()

    def read(self, data: bytes, type_name: str) -> dict[str, Any]:
        """Read one message.

        Args:
            data: Its bytes.
            type_name: Its type, in the spelling of either ROS version.

        Returns:
            Its fields as in JSON, except that arrays of numbers are NumPy arrays of the type in the message,
            which share its memory.

        Raises:
            DecodeError: The bytes are not a message of that type.
            DefinitionError: The type is unknown or has another definition, or rosbags is missing.
            NameFormError: The type's name is malformed.
        """
        name = ros2_type(type_name)
        why = ""
        versions = (2, 1) if self._version is None else (self._version,)
        if not any(name in self._store(version).fielddefs for version in versions):
            raise DefinitionError(
                f"the type {type_name} is unknown: pass the text of its .msg to MessageTypes.register"
            )
        # Bytes without a header of CDR are of ROS 1; with one, they may be of either version.
        if self._version is None and data[:4] not in _CDR:
            versions = (1,)
        for version in versions:
            store = self._store(version)
            if name not in store.fielddefs:
                why = why or f"only ROS {3 - version} has this type"
                continue
            try:
                message = (store.deserialize_ros1 if version == 1 else store.deserialize_cdr)(data, name)
                return _as_dict(message, version)
            except KeyError as error:
                raise DefinitionError(
                    f"the type {type_name} uses {error}, which is unknown: pass the text of its .msg to "
                    "MessageTypes.register"
                ) from None
            except Exception as error:  # the generated code fails in many ways on arbitrary bytes
                why = why or str(error)
        raise DecodeError(f"{len(data)} bytes are not a {type_name}: {why[:200]}")

    def _store(self, version: int) -> "Typestore":
        store = self._stores.get(version)
        if store is None:
            typesys = _rosbags()
            store = typesys.get_typestore(
                typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.LATEST
            )
            for name, definition in self._registered.items():
                types = typesys.get_types_from_msg(definition, name)
                # Otherwise messages of the standard type would be read wrongly.
                if store.fielddefs.get(name, types[name]) != types[name]:
                    raise DefinitionError(f"{name} is a standard type with another definition")
                store.register({n: t for n, t in types.items() if n not in store.fielddefs})
            self._stores[version] = store
        return store


def _rosbags() -> Any:
    try:
        from rosbags import typesys
    except ImportError:
        raise DefinitionError(
            "reading serialised messages needs the package rosbags: pip install rosbags"
        ) from None
    return typesys


def _as_dict(message: Any, version: int) -> dict[str, Any]:
    names = [field.name for field in fields(message) if field.name != "__msgtype__"]
    values = {name: _plain(getattr(message, name), version) for name in names}
    if version == 1 and message.__msgtype__ in _TIMES:
        return {"secs": values["sec"], "nsecs": values["nanosec"]}
    return values


def _plain(value: Any, version: int) -> Any:
    if is_dataclass(value):
        return _as_dict(value, version)
    if isinstance(value, list):
        return [_plain(part, version) for part in value]
    return value
