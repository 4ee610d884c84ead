"""Outgoing messages: their encodings, and the bounded queue of each client."""
