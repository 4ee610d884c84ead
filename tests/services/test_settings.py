"""Settings: flag over variable over default, and a sentence for every mistake."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from services.errors import SettingsError
from services.settings import endpoint_in, load_settings


def test_flag_over_variable_over_default(monkeypatch):
    assert load_settings().connect_timeout == 10
    monkeypatch.setenv("BM_CONNECT_TIMEOUT", "3")
    assert load_settings().connect_timeout == 3
    assert load_settings(connect_timeout=4).connect_timeout == 4


def test_boards_are_split_at_commas(monkeypatch):
    monkeypatch.setenv("BM_BOARDS", "unix:/tmp/a.sock, tcp://10.0.0.2:7000")
    assert load_settings().boards == ("unix:/tmp/a.sock", "tcp://10.0.0.2:7000")


def test_an_unknown_variable_names_the_nearest(monkeypatch):
    monkeypatch.setenv("BM_CONECT_TIMEOUT", "3")
    with pytest.raises(
        SettingsError, match="BM_CONECT_TIMEOUT is no setting.*did you mean BM_CONNECT_TIMEOUT"
    ):
        load_settings()


@pytest.mark.parametrize(
    ("flags", "match"),
    [
        ({"connect_timeout": -1.0}, r"--connect-timeout: expected seconds from 0.001 to 86400 \(got -1.0\)"),
        ({"seen_timeout": float("nan")}, r"--seen-timeout: expected seconds from 0.001 to 86400 \(got nan\)"),
        ({"uri": "http://robot:9090"}, "--uri: a rosbridge URI starts with ws://"),
        ({"queue": "newest"}, "--queue: .*latest.*newest"),
        ({"boards": "nonsense"}, "--boards: "),
    ],
)
def test_a_wrong_flag_says_which_and_what_was_expected(flags, match):
    with pytest.raises(SettingsError, match=match):
        load_settings(**flags)


@pytest.mark.parametrize("value", ["soon", "nan", "inf", "1e400", "-1", "0", "", "\x1b[2J\n"])
def test_a_wrong_variable_says_which(monkeypatch, value):
    monkeypatch.setenv("BM_PEER_TIMEOUT", value)
    sentence = r"environment variable BM_PEER_TIMEOUT: expected seconds from 0.001 to 86400 \(got "
    with pytest.raises(SettingsError, match=sentence + re.escape(repr(value))):
        load_settings()


def test_a_path_too_long_for_a_socket_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="too long"):
        endpoint_in(tmp_path / ("x" * 120), "board0")


@pytest.mark.parametrize("name", ["deployment", "run_directory", "control_directory"])
def test_an_empty_variable_names_no_folder(name, monkeypatch):
    monkeypatch.setenv(f"BM_{name.upper()}", "")
    assert getattr(load_settings(), name) is None


def test_a_hub_with_a_wrong_variable_says_one_sentence():
    command = [Path(sys.executable).parent / "hub", "--port", "0"]
    environment = os.environ | {"BM_X": "1"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("error: environment variable BM_X is no setting")
