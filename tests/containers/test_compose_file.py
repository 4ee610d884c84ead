"""The compose file keeps the project's rules: every service confined, limited, watched, and ended in time."""

import re
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from services.settings import ENV_PREFIX, Settings

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = YAML(typ="safe").load(ROOT / "compose.yaml")
SERVICES = COMPOSE["services"]
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
ENDING = {"check"}
"""Services that end before the others start."""
CLUSTER = {"cluster-scheduler", "cluster-worker"}
"""Services of dask, which do not know those of the stack."""
PUBLISHED = {"hub", "dashboard", "cluster-scheduler"}
"""Services that this machine can reach."""
WATCHED = [name for name in SERVICES if name not in ENDING | CLUSTER | {"viewer"}]
ALL_BUT_ENDING = [name for name in SERVICES if name not in ENDING]

every_service = pytest.mark.parametrize("name", SERVICES)


def filled(text, **variables):
    """A text with its ${NAME:-default} and ${NAME:+other} filled in."""

    def fill(match):
        name, kind, word = match.groups()
        value = variables.get(name, "")
        return (word if value else "") if kind == "+" else (value or word)

    return re.sub(r"\$\{(\w+):([-+])([^}]*)\}", fill, text)


@every_service
def test_confined(name):
    service = SERVICES[name]
    assert service["user"] == "10001:10001"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    forbidden = {"privileged", "cap_add", "devices", "pid", "ipc", "userns_mode", "sysctls", "group_add"}
    assert not forbidden & set(service)
    assert service.get("network_mode", "none") == "none"


@every_service
def test_limited(name):
    service = SERVICES[name]
    assert re.fullmatch(r"\d+m", service["mem_limit"])
    assert 0 < service["pids_limit"] <= 256
    assert all("size=" in each and "noexec" in each for each in service["tmpfs"])
    assert set(service["logging"]["options"]) == {"max-size", "max-file"}


@pytest.mark.parametrize("name", WATCHED)
def test_watched(name):
    service = SERVICES[name]
    process = "board0" if name == "boards" else name
    assert service["healthcheck"]["test"] == ["CMD", "python", "-m", "services.ready", process]
    assert {"interval", "timeout", "retries", "start_period", "start_interval"} <= set(service["healthcheck"])
    directory = "/run/rosbayes/${COMPOSE_PROJECT_NAME}"  # `status` shows it, so two stacks can be told apart
    assert service["environment"]["BM_RUN_DIRECTORY"] == directory
    assert f"status:{directory}" in service["volumes"]


@pytest.mark.parametrize("name", ALL_BUT_ENDING)
def test_ended_in_time(name):
    service = SERVICES[name]
    assert service["stop_grace_period"] == "5s"
    assert service["restart"] == "unless-stopped"
    assert service["init"] is True  # a process that is 1 would not hear SIGTERM before it has its handlers


@every_service
def test_its_command_exists_and_its_variables_are_settings(name):
    command = SERVICES[name]["command"].split()[0]
    if name in CLUSTER:
        assert command == "dask"
        return
    assert command in COMMANDS
    assert command == {"boards": "board", "viewer": "listen", "check": "master"}.get(name, name)
    known = {ENV_PREFIX + field.upper() for field in Settings.model_fields}
    assert {key for key in SERVICES[name]["environment"] if key.startswith(ENV_PREFIX)} <= known


def test_ports_on_loopback_only():
    ports = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert set(ports) == PUBLISHED
    assert all(each.startswith("127.0.0.1:") for listed in ports.values() for each in listed)


def test_workers_of_a_cluster_find_its_scheduler():
    scheduler, worker = SERVICES["cluster-scheduler"], SERVICES["cluster-worker"]
    assert " --port 8786 " in scheduler["command"]
    assert worker["command"].startswith("dask worker tcp://cluster-scheduler:8786 --nthreads 1 ")
    assert worker["deploy"] == {"replicas": 3}
    assert worker["networks"] == ["cluster"]


def networks_of(name, **variables):
    return {filled(each, **variables) for each in SERVICES[name].get("networks", [])}


@every_service
def test_no_way_out_unless_asked_for(name):
    internal = {each for each, network in COMPOSE["networks"].items() if network.get("internal")}
    assert networks_of(name) - internal == ({"published"} if name in PUBLISHED else set())


def test_ways_out():
    robot = {"ROSBRIDGE_URI": "ws://robot:9090"}
    assert networks_of("subscriber", **robot) == networks_of("publisher", **robot) == {"ros-outside"}
    assert networks_of("pcie-app", **robot) == {"boards"}
    assert networks_of("pcie-app", BM_BOARDS="tcp://far:7000") == {"boards-outside"}
    declared = set(COMPOSE["networks"])
    for name in SERVICES:
        assert networks_of(name) | networks_of(name, **robot, BM_BOARDS="tcp://far:7000") <= declared


@pytest.mark.parametrize(
    ("volume", "services"),
    [("sockets", {"master", "subscriber", "publisher", "pcie-app"}), ("boards", {"boards", "pcie-app"})],
)
def test_only_these_share_the_sockets(volume, services):
    sharing = {
        name
        for name, service in SERVICES.items()
        if any(str(each).startswith(f"{volume}:") for each in service.get("volumes", []))
    }
    assert sharing == services
    assert volume in COMPOSE["volumes"]


def test_sockets_are_the_users_own():
    for volume in COMPOSE["volumes"].values():
        assert "uid=10001" in volume["driver_opts"]["o"]
        assert "mode=0700" in volume["driver_opts"]["o"]


def test_boards_of_this_stack_alone_are_programmed_again():
    command = SERVICES["pcie-app"]["command"]
    assert filled(command).endswith(" --reprogram")
    assert filled(command, BM_BOARDS="tcp://far:7000").endswith(" --no-reprogram")


def test_who_may_be_missing_is_not_required():
    for name, service in SERVICES.items():
        for needed, how in service.get("depends_on", {}).items():
            needed_profiles, profiles = SERVICES[needed].get("profiles"), service.get("profiles")
            if needed_profiles and needed_profiles != profiles:
                assert how["required"] is False, f"{name} needs {needed}"


def test_boards_are_those_of_the_deployment():
    settings = SERVICES["boards"]["environment"]
    command, _, directory = SERVICES["boards"]["command"].split()
    assert command == "board"
    assert filled(settings["BM_BOARDS"]) == f"unix:{directory}/"
    assert SERVICES["pcie-app"]["environment"]["BM_DEPLOYMENT"] == settings["BM_DEPLOYMENT"]


def test_a_stack_that_cannot_start_ends():
    assert SERVICES["check"]["command"] == "master --check"
    assert SERVICES["check"]["restart"] == "no"
    assert SERVICES["check"]["environment"].items() <= SERVICES["master"]["environment"].items()

    def awaited(name):
        needed = SERVICES[name].get("depends_on", {})
        return needed.keys() | {each for need in needed for each in awaited(need)}

    for name in ALL_BUT_ENDING:
        assert "check" in awaited(name)
        if name not in CLUSTER | {"hub"}:
            assert "hub" in awaited(name)  # whose port may be taken


def test_an_absent_robot_ends_nothing():
    day = "86400"
    for name in ("master", "subscriber", "publisher", "viewer"):
        environment = SERVICES[name]["environment"]
        assert filled(environment["BM_CONNECT_TIMEOUT"]) == day
        assert filled(environment["BM_FIRST_DATA_TIMEOUT"]) == day
    # neither of the two is healthy without a robot
    assert {how["condition"] for how in SERVICES["master"]["depends_on"].values()} == {"service_started"}


def test_another_deployment_is_mounted_where_it_is_looked_for():
    environment = SERVICES["master"]["environment"]
    assert filled(environment["BM_DEPLOYMENT"]) == "/deployment"
    target = next(each for each in SERVICES["pcie-app"]["volumes"] if isinstance(each, dict))
    assert filled(target["target"], DEPLOYMENT="build/mine") == "/build/mine"
    assert target in SERVICES["boards"]["volumes"]
    assert SERVICES["pcie-app"]["working_dir"] == "/"  # so that errors name what the user typed
    assert filled(environment["BM_DEPLOYMENT"], DEPLOYMENT="build/mine") == "build/mine"
    assert filled(target["source"], DEPLOYMENT="build/mine") == "build/mine"
    assert target["read_only"] is True
    assert target["bind"] == {"create_host_path": False}  # a wrong name is an error, no new folder of root's


@pytest.mark.parametrize(
    ("variables", "profiles"),
    [
        ({}, {"hub", "boat", "boards", "viewer"}),
        ({"ROSBRIDGE_URI": "ws://robot:9090"}, {"boards", "viewer"}),
        ({"BM_BOARDS": "tcp://far:7000"}, {"hub", "boat", "viewer"}),
        ({"DEPLOYMENT": "build/mine"}, {"hub", "boards", "viewer"}),
        ({"DEPLOYMENT": "build/mine", "ROSBRIDGE_URI": "ws://robot:9090"}, {"boards", "viewer"}),
    ],
)
def test_profiles(variables, profiles):
    line = re.search(r"^COMPOSE_PROFILES=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE)
    used = {each for service in SERVICES.values() for each in service.get("profiles", [])}
    assert used == {"core", "hub", "boat", "boards", "viewer", "cluster"}
    assert set(filled(line[1], **variables).split(",")) & used == profiles | {"core"}
