"""The embedded rosbridge server: a broker for the demo, for tests and for users without ROS."""
