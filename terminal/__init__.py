"""The parts that all command lines share: start, flags, logs, errors and exit codes, end."""
