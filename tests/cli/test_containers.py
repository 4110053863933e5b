"""The container files: what they say, and the services of compose.yaml as processes on networks of their own.

`python -m tests.cli.containerfile` carries out the Containerfile's steps.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pyulog import ULog
from ruamel.yaml import YAML

from mavsitl import cli
from tests.cli.containerfile import ROOT, included, parse

COMPOSE: dict[str, Any] = YAML(typ="safe").load((ROOT / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
INSTRUCTIONS = parse((ROOT / "Containerfile").read_text())


def last(word: str) -> list[str]:
    return [each for each in INSTRUCTIONS if each.word == word][-1].arguments


def words(service: str) -> list[str]:
    return shlex.split(SERVICES[service]["command"])


# --- what they say --------------------------------------------------------------------------------


def test_compose_is_as_its_specification_says() -> None:
    """By the specification's own schema, which check-jsonschema has with it."""
    checker = Path(sys.executable).parent / "check-jsonschema"
    arguments = ["--builtin-schema", "vendor.compose-spec", str(ROOT / "compose.yaml")]
    done = subprocess.run([str(checker), *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("service", SERVICES)
def test_each_service_s_command_parses(service: str) -> None:
    assert callable(cli.build_parser().parse_args(words(service)).run)


def test_the_image_s_commands_parse() -> None:
    parser = cli.build_parser()
    assert last("ENTRYPOINT") == ["mavsitl"]
    assert callable(parser.parse_args(last("CMD")).run)
    check = last("HEALTHCHECK")
    assert callable(parser.parse_args(check[check.index("mavsitl") + 1 :]).run)


def test_nothing_runs_as_root_and_nothing_is_published_beyond_loopback() -> None:
    words_in_order = [each.word for each in INSTRUCTIONS]
    assert last("USER") == ["mavsitl"]
    assert words_in_order.index("USER") < words_in_order.index("CMD")
    assert all(each["cap_drop"] == ["ALL"] for each in SERVICES.values())
    published = [port for each in SERVICES.values() for port in each.get("ports", [])]
    assert published
    assert all(port.startswith("127.0.0.1:") for port in published)
    exposed = [name for name in SERVICES if "--insecure" in words(name)]
    assert exposed == ["vehicle"]
    assert all(COMPOSE["networks"][name] == {"internal": True} for name in SERVICES["vehicle"]["networks"])


def test_all_that_is_copied_is_there_and_let_through() -> None:
    for each in INSTRUCTIONS:
        if each.word == "COPY" and each.option("from") is None:
            for source in each.arguments[:-1]:
                assert (ROOT / source).exists(), source
                assert source in included(ROOT), source


def test_every_folder_of_a_volume_is_the_user_s() -> None:
    made = next(each.rest for each in INSTRUCTIONS if each.word == "RUN" and "useradd" in each.rest)
    mounted = {volume.split(":")[1] for each in SERVICES.values() for volume in each.get("volumes", [])}
    for folder in {*mounted, *last("VOLUME")}:
        assert f" {folder}" in made


# --- as processes ---------------------------------------------------------------------------------


@dataclass
class Networks:
    """A network namespace for each service, behind one bridge, each with the names of all as the engine gives them."""

    prefix: str
    log_folder: Path
    hosts: dict[str, str] = field(default_factory=dict)

    def __enter__(self) -> Networks:
        self.hosts = {name: f"10.77.0.{10 + index}" for index, name in enumerate(SERVICES)}
        hub = f"{self.prefix}-hub"
        ip("netns", "add", hub)
        ip("-n", hub, "link", "add", "bridge", "type", "bridge")
        ip("-n", hub, "link", "set", "bridge", "up")
        names = "127.0.0.1 localhost\n" + "".join(f"{address} {name}\n" for name, address in self.hosts.items())
        for index, (name, address) in enumerate(self.hosts.items()):
            space = self.space(name)
            ip("netns", "add", space)
            ip("-n", hub, "link", "add", f"port{index}", "type", "veth", "peer", "name", "eth0", "netns", space)
            ip("-n", hub, "link", "set", f"port{index}", "master", "bridge", "up")
            ip("-n", space, "address", "add", f"{address}/24", "dev", "eth0")
            ip("-n", space, "link", "set", "eth0", "up")
            ip("-n", space, "link", "set", "lo", "up")
            hosts = Path("/etc/netns") / space / "hosts"  # `ip netns exec` puts it in the place of /etc/hosts
            hosts.parent.mkdir(parents=True)
            hosts.write_text(names)
        return self

    def __exit__(self, *_: object) -> None:
        for name in (*self.hosts, "hub"):
            subprocess.run(["ip", "netns", "delete", self.space(name)], check=False)
            shutil.rmtree(Path("/etc/netns") / self.space(name), ignore_errors=True)

    def space(self, service: str) -> str:
        return f"{self.prefix}-{service}"

    def start(self, service: str, *more: str) -> subprocess.Popen[str]:
        """Its command, with folders of ours in place of the volumes."""
        arguments = [self.mounted(service, word) for word in words(service)]
        return subprocess.Popen(
            ["ip", "netns", "exec", self.space(service), sys.executable, "-m", "mavsitl", *arguments, *more],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip

    def mounted(self, service: str, word: str) -> str:
        return str(self.log_folder / service) + word if word in ("/logs", "/state") else word


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def networks(tmp_path: Path) -> Iterator[Networks]:
    if shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("needs root and iproute2 to make network namespaces")
    try:
        with Networks(f"mavsitl{os.getpid()}", tmp_path) as made:
            yield made
    except subprocess.CalledProcessError as error:
        pytest.skip(f"network namespaces are not allowed here: {error.stderr.strip()}")


@pytest.mark.sockets
def test_the_services_fly_on_networks_of_their_own(networks: Networks, tmp_path: Path) -> None:
    """As compose.yaml starts them, with a flight cut to 3 s. The image's health check is content with the vehicle."""
    processes: dict[str, subprocess.Popen[str]] = {}
    said: dict[str, str] = {}
    try:
        for service in SERVICES:  # in the order of depends_on
            processes[service] = networks.start(service, *(("--duration", "3") if service == "ground" else ()))
        ground = processes["ground"]
        assert ground.stdout is not None
        said["ground"] = ground.stdout.read()  # it ends with its flight
        ground.wait(60.0)
        check = last("HEALTHCHECK")
        asked = [sys.executable, "-m", *check[check.index("mavsitl") :]]
        subprocess.run(["ip", "netns", "exec", networks.space("vehicle"), *asked], check=True, capture_output=True)
    finally:
        for service, process in processes.items():
            process.send_signal(signal.SIGTERM)  # nothing to one that has ended
            assert process.stdout is not None
            said.setdefault(service, process.stdout.read())  # up to its end
            process.wait(60.0)
            process.stdout.close()
    assert {name: process.returncode for name, process in processes.items()} == dict.fromkeys(processes, 0), said
    assert "WITHOUT AUTHENTICATION" in said["vehicle"]
    assert "flying\n" in said["ground"]
    for service in ("vehicle", "ground"):
        assert f"logs: {tmp_path / service}/logs\n" in said[service]
        log = ULog(str(tmp_path / service / "logs" / f"{service}.ulg"))
        assert not log.file_corruption
