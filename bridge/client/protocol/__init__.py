"""The rosbridge client as a state machine without sockets and clocks: bytes and times in, events and bytes out.

A connection, as the core sees it (`->` is what `ClientCore.data_to_send` returns, `<-` what `ClientCore.receive` gets):

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
    lost()                   drops calls, goals and requests; keeps everything else for restore()

rosbridge has no handshake and no acknowledgements: at most, a server reports a refused operation in a status message.
So the core stores what the program wants, and sends all of it again on a new connection. Messages may also be encoded
as CBOR, or in fragments. Goals of actions work like calls, with feedback before the result.

Source: the rosbridge protocol, version 2 (https://github.com/RobotWebTools/rosbridge_suite), and
the deviations of servers from it (`docs/reference/rosbridge-differences.md`).
"""

from bridge.client.protocol.client_core import ClientCore
from bridge.client.protocol.subscriptions import Compression, Delivery
from bridge.names import RosVersion

__all__ = ["ClientCore", "Compression", "Delivery", "RosVersion"]
