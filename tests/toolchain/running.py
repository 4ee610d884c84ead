"""The `toolchain` command within a test's process."""

from tests.command_runner import invoke
from toolchain.commands.main import app

TARGET = ("--uri", "ws://robot:9090", "--topic", "/readings", "--type", "std_msgs/msg/Float64")


def toolchain(*arguments):
    """Run the command; the result has `exit_code`, `stdout` and `stderr`."""
    return invoke(app, arguments)


def assert_refused(result, *named):
    """Assert that a command ended with exit code 2 and one sentence that has these names and values in it."""
    assert (result.exit_code, result.stdout) == (2, "")
    sentence = result.stderr.splitlines()[-1]
    assert sentence.startswith("error: ")
    assert "Traceback" not in result.stderr
    for each in named:
        assert str(each) in sentence
