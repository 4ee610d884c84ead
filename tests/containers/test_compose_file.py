"""The compose file keeps the project's rules: every service confined, limited, watched, and ended in time."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from services.settings import ENV_PREFIX, Settings

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = YAML(typ="safe").load(ROOT / "compose.yaml")
SERVICES = COMPOSE["services"]
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
BOARDS = sorted(name for name in SERVICES if name.startswith("board"))

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


@every_service
def test_watched_and_ended_in_time(name):
    service = SERVICES[name]
    assert service["healthcheck"]["test"] == ["CMD", "python", "-m", "services.ready", name]
    assert {"interval", "timeout", "retries", "start_period", "start_interval"} <= set(service["healthcheck"])
    assert service["environment"]["BM_RUN_DIRECTORY"] == "/run/rosbayes/status"
    assert "status:/run/rosbayes/status" in service["volumes"]
    assert service["stop_grace_period"] == "5s"
    assert service["restart"] == "unless-stopped"
    assert service["init"] is True  # a process that is 1 would not hear SIGTERM before it has its handlers


@every_service
def test_its_command_exists_and_its_variables_are_settings(name):
    command = SERVICES[name]["command"].split()[0]
    assert command in COMMANDS
    assert command == name or name in BOARDS
    known = {ENV_PREFIX + field.upper() for field in Settings.model_fields}
    assert {key for key in SERVICES[name]["environment"] if key.startswith(ENV_PREFIX)} <= known


def test_one_image():
    assert {service["image"] for service in SERVICES.values()} == {"rosbayes"}
    built = [name for name, service in SERVICES.items() if "build" in service]
    assert built == ["master"]
    assert all(service["pull_policy"] == "never" for name, service in SERVICES.items() if name not in built)


def test_ports_on_loopback_only():
    ports = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert set(ports) == {"hub"}
    assert all(each.startswith("127.0.0.1:") for each in ports["hub"])


def networks_of(name, **variables):
    return {filled(each, **variables) for each in SERVICES[name].get("networks", [])}


@every_service
def test_no_way_out_unless_asked_for(name):
    internal = {each for each, network in COMPOSE["networks"].items() if network.get("internal")}
    assert networks_of(name) - internal == ({"published"} if name == "hub" else set())


def test_ways_out():
    robot = {"ROSBRIDGE_URI": "ws://robot:9090"}
    assert networks_of("subscriber", **robot) == networks_of("publisher", **robot) == {"ros-outside"}
    assert networks_of("pcie-app", **robot) == {"boards"}
    assert networks_of("pcie-app", BM_BOARDS="tcp://far:7000") == {"boards-outside"}
    declared = set(COMPOSE["networks"])
    for name in SERVICES:
        assert networks_of(name) | networks_of(name, **robot, BM_BOARDS="tcp://far:7000") <= declared


def test_only_the_four_share_the_sockets():
    sharing = {
        name
        for name, service in SERVICES.items()
        if any("sockets:" in str(each) for each in service["volumes"])
    }
    assert sharing == {"master", "subscriber", "publisher", "pcie-app"}
    for volume in COMPOSE["volumes"].values():
        assert "uid=10001" in volume["driver_opts"]["o"]
        assert "mode=0700" in volume["driver_opts"]["o"]


def test_only_the_master_has_the_folder_that_takes_orders():
    directory = SERVICES["master"]["environment"]["BM_CONTROL_DIRECTORY"]
    (mount,) = [each for each in SERVICES["master"]["tmpfs"] if each.startswith(f"{directory}:")]
    assert {"mode=0700", "uid=10001", "gid=10001"} <= set(mount.split(":")[1].split(","))
    for name, service in SERVICES.items():
        assert ("BM_CONTROL_DIRECTORY" in service["environment"]) is (name == "master")
        volumes = [each if isinstance(each, str) else each["target"] for each in service["volumes"]]
        assert not any(each.endswith(directory) for each in volumes)


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
    partitions = re.search(r"--partitions (\d+)", (ROOT / "Dockerfile").read_text())
    assert len(BOARDS) == int(partitions[1])
    default = filled(SERVICES["pcie-app"]["environment"]["BM_BOARDS"])
    assert default == ",".join(f"tcp://{board}:7000" for board in BOARDS)
    for index, board in enumerate(BOARDS):
        assert SERVICES[board]["command"] == f"board --listen tcp://0.0.0.0:7000 --insecure --index {index}"


def test_another_deployment_is_mounted_where_it_is_looked_for():
    environment = SERVICES["master"]["environment"]
    assert filled(environment["BM_DEPLOYMENT"]) == "/deployment"
    target = next(each for each in SERVICES["pcie-app"]["volumes"] if isinstance(each, dict))
    assert filled(environment["BM_DEPLOYMENT"], DEPLOYMENT="build/mine") == target["target"]
    assert filled(target["source"], DEPLOYMENT="build/mine") == "build/mine"
    assert target["read_only"] is True
    assert target["bind"] == {"create_host_path": False}  # a wrong name is an error, no new folder of root's
    # boards keep their image for as long as they run: another deployment must make new ones
    assert "DEPLOYMENT" in SERVICES["board0"]["labels"]["deployment"]


@pytest.mark.parametrize(
    ("variables", "profiles"),
    [
        ({}, ["simulation", "boards", "viewer"]),
        ({"ROSBRIDGE_URI": "ws://robot:9090"}, ["simulation-off", "boards", "viewer"]),
        ({"BM_BOARDS": "tcp://far:7000"}, ["simulation", "boards-off", "viewer"]),
    ],
)
def test_profiles(variables, profiles):
    line = re.search(r"^COMPOSE_PROFILES=(.*)$", (ROOT / ".env").read_text(), re.MULTILINE)
    assert filled(line[1], **variables).split(",") == profiles
    used = {each for service in SERVICES.values() for each in service.get("profiles", [])}
    assert used == {"simulation", "boards", "viewer"}


def has_compose():
    docker = shutil.which("docker")
    return (
        bool(docker)
        and subprocess.run([docker, "compose", "version"], capture_output=True, check=False).returncode == 0
    )


@pytest.mark.skipif(
    not has_compose(), reason="docker compose is not installed; scripts/verify containers runs it"
)
def test_compose_understands_it():
    for variables in ({}, {"ROSBRIDGE_URI": "ws://robot:9090"}):
        done = subprocess.run(
            ["docker", "compose", "config", "--services"],
            cwd=ROOT,
            env={"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/", **variables},
            capture_output=True,
            check=False,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        assert ("hub" in done.stdout.split()) is not bool(variables)
