"""The embedded rosbridge server. It passes messages between its clients, for the demo, tests and users without ROS."""
