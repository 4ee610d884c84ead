"""The embedded rosbridge server: a broker of its own, for the demo, for tests and for users without ROS."""
