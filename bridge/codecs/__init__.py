"""Encodings of rosbridge messages: JSON, CBOR, PNG and fragments."""
