"""Which UDP ports of this machine are taken, and by whom: Linux says it in /proc, elsewhere only a bind finds out."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from mavsitl.link.sockets import LOOPBACK

__all__ = ["find_command", "holders"]

_TABLES = ("/proc/net/udp", "/proc/net/udp6")
_PROCESSES = Path("/proc")


def holders(ports: Iterable[int]) -> dict[int, str]:
    """Those of the UDP ports that somebody has, with "NAME (process N)", or "" where the system does not tell.

    Linux tells the names of the user's own processes. On other systems the ports are bound for a moment to find out.
    """
    wanted = set(ports)
    inodes = _inodes() if sys.platform == "linux" else None
    if inodes is None:
        return {port: "" for port in sorted(wanted) if _is_taken(port)}
    taken = {port: inode for port, inode in inodes if port in wanted}
    names = _owners(set(taken.values())) if taken else {}
    return {port: names.get(inode, "") for port, inode in sorted(taken.items())}


def find_command(port: int) -> str:
    """What a person types to learn who has a UDP port."""
    if sys.platform == "linux":
        return f"sudo ss -lunp 'sport = :{port}'"
    if sys.platform == "win32":
        return f"netstat -ano -p udp | findstr :{port}"
    return f"sudo lsof -nP -iUDP:{port}"


def _inodes() -> list[tuple[int, str]] | None:
    """(port, socket inode) of every UDP socket in this network namespace; None where they cannot be read."""
    found = []
    for table in _TABLES:
        try:
            lines = Path(table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            if table == _TABLES[0]:
                return None
            continue  # a system without IPv6
        for line in lines:
            fields = line.split()
            found.append((int(fields[1].rpartition(":")[2], 16), fields[9]))
    return found


def _owners(inodes: set[str]) -> dict[str, str]:
    """Socket inode to its process, of the processes that this user may look into."""
    links = {f"socket:[{inode}]": inode for inode in inodes}
    owners: dict[str, str] = {}
    for process in _PROCESSES.iterdir():
        if process.name.isdigit():
            for target in _descriptors(process / "fd"):
                if target in links:
                    owners.setdefault(links[target], f"{_program(process)} (process {process.name})")
    return owners


def _descriptors(folder: Path) -> Iterator[str]:
    try:
        for descriptor in folder.iterdir():
            yield str(descriptor.readlink())
    except OSError:  # another user's process, or one that has just ended
        return


def _program(process: Path) -> str:
    """The command without its arguments' values; for an interpreter also the module or script that it runs."""
    try:
        words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "a program"
    shown = [Path(words[0]).name]
    if shown[0].startswith("python"):
        shown += [Path(word).name for word in words[1:] if word and not word.startswith("-")][:2]
    return " ".join(shown) or "a program"


def _is_taken(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return True
    return False
