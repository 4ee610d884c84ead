"""What every command line shares: start, flags, logs, errors and exit codes, end."""
