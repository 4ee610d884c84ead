"""Doubles of the three real servers, with their measured differences from the specification.

A: rosbridge_suite on ROS 1; B: rosbridge_suite on ROS 2; R: rosbridge-server-rs on ROS 2
(``docs/reference/rosbridge-differences.md``).
They are fakes over `tests.fake_rosbridge`, and add the forms of delivery: what each makes of ``compression`` and
``fragment_size``, and what it loses.
"""

import base64
import io
import itertools
import json
import math

import cbor2
import numpy as np
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from tests.fake_rosbridge import FakeRosbridge

_STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.LATEST)}


class Double(FakeRosbridge):
    """One of the servers; publishes messages of ``std_msgs/Float64MultiArray`` in every form it knows."""

    def __init__(self, server):
        super().__init__(
            ros=1 if server == "A" else 2,
            statuses=server == "R",
            zombies=server in "AB",
            escapes=server in "AB",
            refuses_null=True,
        )
        self.server = server
        self.known = {"none", "png", "cbor", "cbor-raw"}
        self.fragment_sizes = {}
        self._fragment_ids = itertools.count()
        self._parts = {}

    async def _op_subscribe(self, client, op):
        wanted = op.get("compression", "none")
        if wanted not in self.known:
            await self._complain(client, f"unsupported compression {wanted}")
            if self.server == "R":
                return
        if "fragment_size" in op:
            self.fragment_sizes[client.number] = op["fragment_size"]  # sticky, for all that follows
        await super()._op_subscribe(client, op)

    async def _op_fragment(self, client, op):
        parts = self._parts.setdefault((client.number, op["id"]), {})
        parts[op["num"]] = op["data"]
        if len(parts) == op["total"]:
            del self._parts[client.number, op["id"]]
            await self._hear(client, "".join(parts[num] for num in sorted(parts)))

    async def _publish(self, topic, msg):
        reached = 0
        for client in sorted(self._clients, key=lambda client: client.number):
            subscribed = client.subscribed.get(topic, {}).values()
            form = next((op.get("compression", "none") for op in subscribed), "none")
            for _ in range(self._times(client, topic)):
                reached += await self._deliver(client, topic, msg, form)
        return reached

    async def _deliver(self, client, topic, msg, form):
        operation = {"op": "publish", "topic": topic, "msg": msg}
        if form == "png":
            if self.server in "AR":
                await self._say_in_pieces(client, {"op": "png", "data": _picture(json.dumps(operation))})
                return 1
            return 0  # B never delivers one
        if form == "cbor":
            data = cbor2.CBORTag(86, np.asarray(msg["data"], "<f8").tobytes())
            await self._send(client, cbor2.dumps(operation | {"msg": msg | {"data": data}}))
        elif form == "cbor-raw":
            raw = {"bytes": serialised(msg, self.ros), "nsecs": 5, "secs": 7}  # in any order
            await self._send(client, cbor2.dumps({"msg": raw, "topic": topic, "op": "publish"}))
        else:  # an unknown one is silently plain JSON
            await self._say_in_pieces(client, operation)
        return 1

    async def _say_in_pieces(self, client, operation):
        size = self.fragment_sizes.get(client.number)
        text = json.dumps(_nulls(operation))
        if size is None or len(text) <= size:
            await self._say(client, operation)
            return
        number = next(self._fragment_ids)
        key, total = (
            (number, (len(text) - 1) / size + 1)
            if self.server in "AB"
            else (f"fragment-{number}", -(-len(text) // size))
        )
        for num in range(math.floor(total)):
            data = text[num * size : (num + 1) * size]
            await self._say(client, {"op": "fragment", "id": key, "data": data, "num": num, "total": total})


def serialised(msg, ros):
    """A Float64MultiArray with one dimension, as the server's ROS writes it."""
    store = _STORES[ros]
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    message = store.types["std_msgs/msg/Float64MultiArray"](layout, np.asarray(msg["data"], np.float64))
    write = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    return bytes(write(message, "std_msgs/msg/Float64MultiArray"))


def _picture(text):
    pixels = text.encode()
    width = max(1, math.floor(math.sqrt(len(pixels) / 3)))
    height = math.ceil(len(pixels) / 3 / width)
    image = Image.frombytes("RGB", (width, height), pixels.ljust(3 * width * height, b"\n"))
    buffer = io.BytesIO()
    image.save(buffer, "png")
    return base64.b64encode(buffer.getvalue()).decode()


def _nulls(value):
    return json.loads(json.dumps(value), parse_constant=lambda _: None)
