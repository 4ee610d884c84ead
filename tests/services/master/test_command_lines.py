"""Command lines of services: each takes its settings from the flags that its master gives it."""

import pytest

from pcie_shim.endpoint import parse_endpoint
from services.commands import pcie_app, publisher, subscriber
from services.master.command_lines import service_command
from services.settings import Settings
from tests.command_runner import invoke


@pytest.mark.parametrize(
    "command", [subscriber, publisher, pcie_app], ids=["subscriber", "publisher", "pcie-app"]
)
def test_every_flag_is_one_of_the_command(command, tmp_path):
    role = command.__name__.rsplit(".", 1)[1].replace("_", "-")
    given = {"uri": "ws://robot:9090", "ca": "c", "queue": "all", "stop": "own", "key_file": "k"}
    settings = Settings(
        deployment=tmp_path,
        boards=("unix:/a.sock", "unix:/b.sock"),
        topic_bytes=10**6,
        metrics="9400",
        **given,
    )
    line = service_command(role, parse_endpoint("unix:/s.sock"), settings, reprogram=role == "pcie-app")
    ended = invoke(command.app, line[1:])
    assert (ended.exit_code, "deployment.toml" in ended.stderr) == (2, True), (
        ended.stderr
    )  # the folder is empty
    assert line[line.index("--deployment") + 1] == str(tmp_path)
    if role == "pcie-app":
        assert line[line.index("--boards") + 1] == "unix:/a.sock,unix:/b.sock"
        assert line[-1] == "--reprogram"


def test_a_setting_without_a_value_is_no_flag(tmp_path):
    line = service_command(
        "subscriber", parse_endpoint("unix:/s.sock"), Settings(deployment=tmp_path), reprogram=False
    )
    assert not {"--uri", "--ca", "--topic-bytes", "--queue", "--boards", "--metrics"} & set(line)
