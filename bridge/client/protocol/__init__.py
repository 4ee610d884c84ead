"""The rosbridge client as a state machine: bytes and times go in, events and bytes come out.

The state machine has no socket and no clock. In this example of a connection, `->` marks bytes that
`ClientCore.data_to_send` returns, and `<-` marks bytes that are passed to `ClientCore.receive`:

    restore()            ->  {"op": "advertise", "id": "advertise:/cmd:1", "topic": "/cmd", "type": "p/Cmd", ...}
                         ->  {"op": "advertise_service", "service": "/stop", "type": "p/Stop"}
                         ->  {"op": "subscribe", "id": "subscribe:/pose:2", "topic": "/pose", "throttle_rate": 0, ...}
    MessageReceived      <-  {"op": "publish", "topic": "/pose", "msg": {...}}
    publish()            ->  {"op": "publish", "topic": "/cmd", "msg": {...}}
    calls.send()         ->  {"op": "call_service", "id": "call_service:/add:3", "service": "/add", "args": {...}}
    CallAnswered         <-  {"op": "service_response", "id": "call_service:/add:3", "values": {...}, "result": true}
    ServiceRequested     <-  {"op": "call_service", "id": 7, "service": "/stop", "args": {}}
    services.answer()    ->  {"op": "service_response", "id": 7, "service": "/stop", "values": {}, "result": true}
    unsubscribe()        ->  {"op": "unsubscribe", "id": "subscribe:/pose:2", "topic": "/pose"}
    lost()                   drops calls, goals and requests, and keeps everything else for restore()

rosbridge has no handshake and no acknowledgements. If a server refuses an operation, the client gets a status message
at most. So the core stores the program's subscriptions, advertisements and services. On a new connection, the core
sends all of them again. Messages may also be encoded as CBOR, or be split into fragments. The goal of an action works
like a call, with feedback before the result.

Source: the rosbridge protocol, version 2 (https://github.com/RobotWebTools/rosbridge_suite). Servers deviate from the
protocol as described in `docs/reference/rosbridge-differences.md`.
"""

from bridge.client.protocol.client_core import ClientCore
from bridge.client.protocol.subscriptions import Compression, Delivery
from bridge.names import RosVersion

__all__ = ["ClientCore", "Compression", "Delivery", "RosVersion"]
