"""Encodings of rosbridge messages: JSON, CBOR and fragments."""
