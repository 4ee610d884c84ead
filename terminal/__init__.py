"""Code shared by all commands: command lines, logs, errors, exit codes, signals, health checks."""
