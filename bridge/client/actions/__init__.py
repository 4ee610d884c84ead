"""Actions, for senders of goals and for servers: the operations of ROS 2, and the topics of actionlib in ROS 1."""
