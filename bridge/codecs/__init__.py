"""Encodings of rosbridge messages: JSON, CBOR, PNG, fragments and serialised ROS messages."""
