"""The embedded rosbridge server: a broker between its clients, for the demo, for tests and for users without ROS."""
