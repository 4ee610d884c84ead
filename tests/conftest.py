"""What holds for all tests."""

import signal

# A shell that starts the tests in the background has Ctrl-C ignored for them, and so for every process that they start
# and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)
