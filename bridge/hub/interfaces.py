"""Definitions of services, actions and messages that `rosbags` does not have, in ROS's own notation.

Clients of rosbridge often use these definitions: the services of `std_srvs` and of rosapi, the actions of the ROS
tutorials, and `tf2_msgs`. The sources are the packages' own `.srv`, `.action` and `.msg` files.
"""

from functools import cache
from typing import Final

from bridge.names import RosVersion

PARTS: Final = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}

_MESSAGES: Final = {
    "rosapi/TypeDef": """
        string type
        string[] fieldnames
        string[] fieldtypes
        int32[] fieldarraylen
        string[] examples
        string[] constnames
        string[] constvalues
    """,
    "tf/tfMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf2_msgs/TF2Error": """
        uint8 NO_ERROR=0
        uint8 LOOKUP_ERROR=1
        uint8 CONNECTIVITY_ERROR=2
        uint8 EXTRAPOLATION_ERROR=3
        uint8 INVALID_ARGUMENT_ERROR=4
        uint8 TIMEOUT_ERROR=5
        uint8 TRANSFORM_ERROR=6
        uint8 error
        string error_string
    """,
}
_SERVICES: Final = {
    "example_interfaces/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum",
    "nav_msgs/GetMap": "---\nnav_msgs/OccupancyGrid map",
    "nav_msgs/GetPlan": """
        geometry_msgs/PoseStamped start
        geometry_msgs/PoseStamped goal
        float32 tolerance
        ---
        nav_msgs/Path plan
    """,
    "nav_msgs/SetMap": """
        nav_msgs/OccupancyGrid map
        geometry_msgs/PoseWithCovarianceStamped initial_pose
        ---
        bool success
    """,
    "roscpp_tutorials/TwoInts": "int64 a\nint64 b\n---\nint64 sum",
    "rospy_tutorials/AddTwoInts": "int64 a\nint64 b\n---\nint64 sum",
    "sensor_msgs/SetCameraInfo": """
        sensor_msgs/CameraInfo camera_info
        ---
        bool success
        string status_message
    """,
    "std_srvs/Empty": "---",
    "std_srvs/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/Trigger": "---\nbool success\nstring message",
    "tf2_msgs/FrameGraph": "---\nstring frame_yaml",
}
# Services of rosapi as in ROS 1; `_ROSAPI_2` contains the additions of ROS 2.
_ROSAPI: Final = {
    "ActionFeedbackDetails": "string type\n---\nTypeDef[] typedefs",
    "ActionGoalDetails": "string type\n---\nTypeDef[] typedefs",
    "ActionResultDetails": "string type\n---\nTypeDef[] typedefs",
    "ActionType": "string action\n---\nstring type",
    "DeleteParam": "string name\n---",
    "GetActionServers": "---\nstring[] action_servers",
    "GetParam": "string name\nstring default\n---\nstring value",
    "GetParamNames": "---\nstring[] names",
    "GetROSVersion": "---\nuint8 version\nstring distro",
    "GetTime": "---\nbuiltin_interfaces/Time time",
    "HasParam": "string name\n---\nbool exists",
    "Interfaces": "---\nstring[] interfaces",
    "MessageDetails": "string type\n---\nTypeDef[] typedefs",
    "NodeDetails": "string node\n---\nstring[] subscribing\nstring[] publishing\nstring[] services",
    "Nodes": "---\nstring[] nodes",
    "Publishers": "string topic\n---\nstring[] publishers",
    "SearchParam": "string name\n---\nstring global_name",
    "ServiceHost": "string service\n---\nstring host",
    "ServiceNode": "string service\n---\nstring node",
    "ServiceProviders": "string service\n---\nstring[] providers",
    "ServiceRequestDetails": "string type\n---\nTypeDef[] typedefs",
    "ServiceResponseDetails": "string type\n---\nTypeDef[] typedefs",
    "ServiceType": "string service\n---\nstring type",
    "Services": "---\nstring[] services",
    "ServicesForType": "string type\n---\nstring[] services",
    "SetParam": "string name\nstring value\n---",
    "Subscribers": "string topic\n---\nstring[] subscribers",
    "TopicType": "string topic\n---\nstring type",
    "Topics": "---\nstring[] topics\nstring[] types",
    "TopicsAndRawTypes": "---\nstring[] topics\nstring[] types\nstring[] typedefs_full_text",
    "TopicsForType": "string type\n---\nstring[] topics",
}
_ROSAPI_2: Final = {
    "DeleteParam": "string name\n---\nbool successful\nstring reason",
    "GetParam": "string name\nstring default_value\n---\nstring value\nbool successful\nstring reason",
    "SetParam": "string name\nstring value\n---\nbool successful\nstring reason",
}
_ACTIONS: Final = {
    "action_tutorials_interfaces/Fibonacci": """
        int32 order
        ---
        int32[] sequence
        ---
        int32[] partial_sequence
    """,
    "actionlib_tutorials/Averaging": """
        int32 samples
        ---
        float32 mean
        float32 std_dev
        ---
        int32 sample
        float32 data
        float32 mean
        float32 std_dev
    """,
    "actionlib_tutorials/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence",
    "example_interfaces/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence",
    "move_base_msgs/MoveBase": """
        geometry_msgs/PoseStamped target_pose
        ---
        ---
        geometry_msgs/PoseStamped base_position
    """,
    "tf2_msgs/LookupTransform": """
        string target_frame
        string source_frame
        builtin_interfaces/Time source_time
        builtin_interfaces/Duration timeout
        builtin_interfaces/Time target_time
        string fixed_frame
        bool advanced
        ---
        geometry_msgs/TransformStamped transform
        tf2_msgs/TF2Error error
        ---
    """,
    "tf2_web_republisher/TFSubscription": """
        string[] source_frames
        string target_frame
        float32 angular_thres
        float32 trans_thres
        float32 rate
        ---
        ---
        geometry_msgs/TransformStamped[] transforms
    """,
}
# The second field of the messages of ROS 1's actions; a header is the first, and the part itself the
# third.
_ACTIONLIB: Final = {
    "Goal": "actionlib_msgs/GoalID goal_id",
    "Result": "actionlib_msgs/GoalStatus status",
    "Feedback": "actionlib_msgs/GoalStatus status",
}


def part_name(type_name: str, part: str, ros_version: RosVersion) -> str:
    """Return the name of the message that defines a part of a service or an action, for example the `Request`."""
    package, _, name = type_name.partition("/")
    return f"{package}/msg/{name.rpartition('/')[2]}{'_' if ros_version == 2 else ''}{part}"


@cache
def message_texts(ros_version: RosVersion) -> dict[str, str]:
    """Return the text of each message definition by name, such as `tf2_msgs/msg/TFMessage`.

    Each part of a service or an action, such as its request, has an entry of its own.
    """
    rosapi = "rosapi_msgs" if ros_version == 2 else "rosapi"
    own = _ROSAPI | (_ROSAPI_2 if ros_version == 2 else {})
    services = _SERVICES | {f"{rosapi}/{name}": text for name, text in own.items()}
    texts = {}
    for name, text in _MESSAGES.items():
        package, own_name = name.split("/")
        texts[f"{rosapi if package == 'rosapi' else package}/msg/{own_name}"] = text
    for kind, interfaces in ("srv", services), ("action", _ACTIONS):
        for name, text in interfaces.items():
            for part, part_text in zip(PARTS[kind], text.split("---"), strict=True):
                texts[part_name(name, part, ros_version)] = part_text
    if ros_version == 1:
        for name in _ACTIONS:
            package, own_name = name.split("/")
            whole = []
            for part, second in _ACTIONLIB.items():
                third = f"{own_name}{part} {part.lower()}"
                texts[f"{package}/msg/{own_name}Action{part}"] = f"std_msgs/Header header\n{second}\n{third}"
                whole.append(f"{own_name}Action{part} action_{part.lower()}")
            texts[f"{package}/msg/{own_name}Action"] = "\n".join(whole)
    return {name: "\n".join(map(str.strip, text.splitlines())) for name, text in texts.items()}
