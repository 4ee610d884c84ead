"""Settings: where each comes from, and the command lines by which a master passes them on."""

import pytest

from pcie_shim.endpoint import parse_endpoint
from pcie_shim.errors import EndpointError
from services.commands import hub, pcie_app, publisher, subscriber
from services.errors import SettingsError
from services.master.command_lines import service_arguments
from services.settings import Settings, endpoint_in, load_settings
from tests.command_runner import invoke


def test_flag_over_variable_over_default(monkeypatch):
    assert load_settings().connect_timeout == 10
    monkeypatch.setenv("BM_CONNECT_TIMEOUT", "3")
    assert load_settings().connect_timeout == 3
    assert load_settings(connect_timeout=4).connect_timeout == 4


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("connect_timeout", -1.0, "0.001 to 86400"),
        ("seen_timeout", float("nan"), "0.001 to 86400"),
        ("uri", "http://robot:9090", "ws://"),
        ("queue", "newest", "latest"),
        ("boards", "nonsense", "unix:"),
        ("publisher", "nonsense", "unix:"),
    ],
)
def test_a_wrong_flag_names_itself_and_its_limits(name, value, expected):
    with pytest.raises(SettingsError) as refused:
        load_settings(**{name: value})
    assert str(refused.value).startswith(f"--{name.replace('_', '-')}: ")
    assert expected in str(refused.value)


@pytest.mark.parametrize("value", ["soon", "nan", "inf", "1e400", "-1", "0", "", "\x1b[2J\n"])
def test_a_wrong_variable_names_itself_and_its_value(monkeypatch, value):
    monkeypatch.setenv("BM_PEER_TIMEOUT", value)
    with pytest.raises(SettingsError) as refused:
        load_settings()
    assert "BM_PEER_TIMEOUT" in str(refused.value)
    assert repr(value) in str(refused.value)


def test_a_path_too_long_for_a_socket_is_refused(tmp_path):
    with pytest.raises(EndpointError):
        endpoint_in(tmp_path / ("x" * 120), "board0")


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        *((name, "", None) for name in ("deployment", "run_directory")),
        ("boards", "unix:/tmp/a.sock, tcp://10.0.0.2:7000", ("unix:/tmp/a.sock", "tcp://10.0.0.2:7000")),
    ],
)
def test_a_variable_may_be_empty_or_a_list(name, text, value, monkeypatch):
    monkeypatch.setenv(f"BM_{name.upper()}", text)
    assert getattr(load_settings(), name) == value


def test_a_command_refuses_an_unknown_variable_in_one_sentence_with_the_nearest(monkeypatch):
    monkeypatch.setenv("BM_CONECT_TIMEOUT", "1")
    ended = invoke(hub.app, ["--port", "0"])
    assert ended.exit_code == 2
    assert ended.stderr.count("\n") == 1
    assert "did you mean BM_CONNECT_TIMEOUT?" in ended.stderr


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
        use_sim_time=True,
        **given,
    )
    line = service_arguments(role, parse_endpoint("unix:/s.sock"), settings, reprogram=role == "pcie-app")
    ended = invoke(command.app, line)
    assert (ended.exit_code, "deployment.toml" in ended.stderr) == (2, True), (
        ended.stderr
    )  # the folder is empty
    assert line[line.index("--deployment") + 1] == str(tmp_path)
    assert ("--use-sim-time" in line) is (role != "pcie-app")
    if role == "pcie-app":
        assert line[line.index("--boards") + 1] == "unix:/a.sock,unix:/b.sock"
        assert line[-1] == "--reprogram"


def test_a_setting_without_a_value_is_no_flag(tmp_path):
    line = service_arguments(
        "subscriber", parse_endpoint("unix:/s.sock"), Settings(deployment=tmp_path), reprogram=False
    )
    assert not {"--uri", "--ca", "--topic-bytes", "--queue", "--boards", "--metrics", "--use-sim-time"} & set(
        line
    )
