"""HTTP and WebSocket on loopback: the page, and what is new to it many times a second.

Who may speak: a browser's page of ours. Names other than this machine's own are refused (DNS rebinding), and so are
WebSockets that another site's page opens (their `Origin`). Where it binds more than loopback, a token is demanded too.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import secrets
from collections.abc import Callable, Sequence
from http import HTTPStatus
from importlib import resources
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from mavsitl.clock import monotonic_us
from mavsitl.ends import is_loopback
from mavsitl.link.base import Link, LinkError
from mavsitl.view.live import ACTIONS, Station
from mavsitl.view.model import Model, Seen
from mavsitl.view.replay import Replay

__all__ = ["LiveSource", "Page", "ReplaySource", "Source", "run"]

PUMP_S = 0.005
"""Between two looks at the links: as exactly latencies are known."""
SLOWEST_PACE_HZ = 0.5
MAX_MESSAGE_BYTES = 4096
"""Of a client's: they are short."""
MAX_CLIENTS = 16

CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml", ".txt": "text/plain; charset=utf-8", ".md": "text/plain; charset=utf-8",
}  # fmt: skip

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self' ws: wss:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing from outside is loaded, and no other page shows this one in a frame and has its buttons clicked."""

# --- what a client says ----------------------------------------------------------------------------------------------


class Select(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="select"):
    """The vehicle whose rows are wanted."""

    vehicle: int


class Pace(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="pace"):
    """How often a second news are wanted at most: a page that nobody sees wants few."""

    hz: float


class Act(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="act"):
    """A button of a vehicle: a key of `mavsitl.view.live.ACTIONS`."""

    vehicle: int
    name: str


class Play(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="play"):
    on: bool


class Speed(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="speed"):
    speed: float


class Seek(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="seek"):
    at_s: float


class Open(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="open"):
    """Another flight of the run."""

    flight: str


Wish = Select | Pace | Act | Play | Speed | Seek | Open

# --- where the news come from ----------------------------------------------------------------------------------------


class Source(Protocol):
    """A live flight or a replay."""

    @property
    def model(self) -> Model: ...
    @property
    def hz(self) -> float: ...
    def pump(self, now_us: int) -> None:
        """Move what has come: often."""

    def step(self, now_us: int) -> None:
        """A new picture."""

    def wish(self, wish: Wish) -> None:
        """A button, or the replay's. Raises `KeyError` or `ValueError` for what there is not."""


class LiveSource:
    """A `Station` and its links; the monitor's is the last, where it has one."""

    def __init__(self, station: Station, links: Sequence[Link]) -> None:
        self._station = station
        self._links = links

    @property
    def model(self) -> Model:
        return self._station.model

    @property
    def hz(self) -> float:
        return self._station.hz

    def pump(self, now_us: int) -> None:
        for port, link in enumerate(self._links):
            for datagram, source in link.receive(now_us):
                if self._station.receive(port, datagram, now_us):
                    link.admit(source, now_us)

    def step(self, now_us: int) -> None:
        self._station.step(now_us)
        for port, link in enumerate(self._links):
            for datagram in self._station.datagrams(port):
                link.send(datagram)

    def wish(self, wish: Wish) -> None:
        if not isinstance(wish, Act):
            raise ValueError("a live flight cannot be moved")
        self._station.act(wish.vehicle, wish.name)


class ReplaySource:
    """A `Replay`."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay

    @property
    def model(self) -> Model:
        return self._replay.model

    @property
    def hz(self) -> float:
        return self._replay.hz

    def pump(self, now_us: int) -> None:
        """Nothing comes."""

    def step(self, now_us: int) -> None:
        self._replay.step(now_us)

    def wish(self, wish: Wish) -> None:
        match wish:
            case Play(on):
                self._replay.play(on)
            case Speed(speed):
                self._replay.set_speed(speed)
            case Seek(at_s):
                self._replay.seek(at_s)
            case Open(flight):
                self._replay.open(flight)
            case _:
                raise ValueError("a replay has no buttons")


# --- the page --------------------------------------------------------------------------------------------------------


class _Client:
    """A page that is open."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.seen = Seen()
        self.pace_us = 0
        self.due_us = 0
        self.sending: asyncio.Task[None] | None = None
        """What was sent last; the next waits for its end, so that a slow client is sent less and not later."""


class Page:
    """The server: files of `mavsitl/view/page`, and a WebSocket at ``/live``.

    Attributes:
        address: where a browser finds it, with the token where there is one.
    """

    def __init__(self, source: Source, host: str = "127.0.0.1", port: int = 0) -> None:
        """Binds at `start`. `port` 0: any that is free."""
        self._source = source
        self._host, self._port = host, port
        self._token = "" if is_loopback(host) else secrets.token_urlsafe(16)
        self._clients: set[_Client] = set()
        self._server: Server | None = None
        self._encode = msgspec.json.Encoder().encode
        self._decode = msgspec.json.Decoder(Wish).decode
        self.address = ""

    async def start(self) -> None:
        """Raises `LinkError`, naming the option to change."""
        try:
            self._server = await serve(
                self._talk, self._host, self._port, process_request=self._answer, max_size=MAX_MESSAGE_BYTES,
                compression=None, server_header=None, open_timeout=5, ping_interval=20, max_queue=8,
            )  # fmt: skip
        except OSError as error:
            raise LinkError(_cannot_bind(self._host, self._port, error)) from error
        self._port = next(iter(self._server.sockets)).getsockname()[1]
        host = f"[{self._host}]" if ":" in self._host else self._host
        self.address = f"http://{host}:{self._port}/" + (f"?token={self._token}" if self._token else "")

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    @property
    def port(self) -> int:
        """That it has, once it was started."""
        return self._port

    @property
    def clients(self) -> int:
        """Pages that are open."""
        return len(self._clients)

    # --- requests

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The file that is asked for, or a refusal; None: the WebSocket may be opened."""
        url = urlsplit(request.path)
        if not self._is_our_name(request.headers):
            return _reply(HTTPStatus.FORBIDDEN, "this server has no such name")
        if url.path != "/live":
            return _file(url.path)
        origin, host = request.headers.get("Origin"), request.headers.get("Host", "")
        if origin is not None and origin.lower() != f"http://{host.lower()}":
            return _reply(HTTPStatus.FORBIDDEN, "not from another site")
        if self._token:
            given = parse_qs(url.query).get("token", [""])[0]
            if not hmac.compare_digest(given.encode(), self._token.encode()):
                return _reply(HTTPStatus.UNAUTHORIZED, "the whole address is needed, with its token")
        if len(self._clients) >= MAX_CLIENTS:
            return _reply(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_CLIENTS} pages are open")
        return None

    def _is_our_name(self, headers: Headers) -> bool:
        """Whether the request is for an address of loopback, or `localhost`, with our port.

        Bound beyond loopback any name will do: who does not know the token is told nothing, whatever he calls us.
        """
        names = headers.get_all("Host")
        if len(names) != 1:
            return False
        try:
            parts = urlsplit(f"//{names[0]}")
            host, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if port != self._port:
            return False
        return bool(self._token) or is_loopback(host)

    # --- WebSockets

    async def _talk(self, connection: ServerConnection) -> None:
        client = _Client(connection)
        self._clients.add(client)
        try:
            async for message in connection:
                problem = self._take(client, message)
                if problem:
                    await connection.send(self._encode({"problem": problem}).decode())
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)
            if client.sending is not None:
                client.sending.cancel()

    def _take(self, client: _Client, message: str | bytes) -> str:
        """Do what a client wishes; what is wrong with it, or nothing."""
        try:
            wish = self._decode(message)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            return f"not understood: {error}"
        match wish:
            case Select(vehicle):
                client.seen.selected = vehicle
            case Pace(hz):
                client.pace_us = round(1e6 / max(hz, SLOWEST_PACE_HZ))
                client.due_us = 0
            case _:
                try:
                    self._source.wish(wish)
                except KeyError as error:
                    return f"there is no {error.args[0]!r}; buttons: {', '.join(ACTIONS)}"
                except (ValueError, OSError, LinkError) as error:
                    return str(error)
        return ""

    def tell(self, now_us: int) -> None:
        """Send each client what is new to it. Clients that have seen the same are sent the same bytes."""
        encoded: dict[Any, str] = {}
        for client in self._clients:
            if now_us < client.due_us or (client.sending is not None and not client.sending.done()):
                continue
            client.due_us = now_us + client.pace_us
            seen = client.seen
            key = (seen.changes, seen.texts, seen.texts_chapter, seen.selected, seen.chapter, seen.rows)
            news = self._source.model.news(seen)
            if not news:
                continue
            if key not in encoded:
                encoded[key] = self._encode(news).decode()
            client.sending = asyncio.create_task(_send(client.connection, encoded[key]))


async def _send(connection: ServerConnection, text: str) -> None:
    with contextlib.suppress(ConnectionClosed):
        await connection.send(text)


def _cannot_bind(host: str, port: int, error: OSError) -> str:
    if "in use" in str(error).lower():
        return f"port {port} is in use (bind {host}): choose another with --port N, or 0 for one that is free"
    return f"cannot bind {host} port {port}: {error.strerror or error}; see --bind HOST and --port N"


def _file(path: str) -> Response:
    """A file of the page. Names are looked up in what there is: none leads elsewhere."""
    name = path.removeprefix("/") or "index.html"
    files = _files()
    if name not in files:
        return _reply(HTTPStatus.NOT_FOUND, "there is no such page")
    content = files[name].read_bytes()
    return _response(HTTPStatus.OK, CONTENT_TYPES[name[name.rindex(".") :]], content)


def _files() -> dict[str, Any]:
    """By their path below the page's folder."""
    found: dict[str, Any] = {}

    def look(folder: Any, before: str) -> None:
        for entry in folder.iterdir():
            if entry.is_dir():
                look(entry, f"{before}{entry.name}/")
            elif entry.name.endswith(tuple(CONTENT_TYPES)):
                found[f"{before}{entry.name}"] = entry

    look(resources.files("mavsitl.view") / "page", "")
    return found


def _reply(status: HTTPStatus, text: str) -> Response:
    return _response(status, CONTENT_TYPES[".txt"], f"{text}\n".encode())


def _response(status: HTTPStatus, kind: str, content: bytes) -> Response:
    headers = Headers(
        {
            "Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close",
            "Cache-Control": "no-cache", "Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY", "Referrer-Policy": "no-referrer", "Cross-Origin-Resource-Policy": "same-origin",
        }
    )  # fmt: skip
    return Response(status.value, status.phrase, headers, content)


async def run(
    page: Page, source: Source, *, stop: Callable[[], bool], started: Callable[[], None] = lambda: None,
    chore: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Serve until `stop`. `started` is called when the page can be opened, `chore` about once a second.

    Raises `LinkError`.
    """
    await page.start()
    try:
        started()
        due_us = chore_us = 0
        while not stop():
            now_us = monotonic_us()
            source.pump(now_us)
            if now_us >= due_us:
                interval_us = round(1e6 / source.hz)
                due_us = max(due_us + interval_us, now_us + interval_us // 2)
                source.step(now_us)
                page.tell(now_us)
            if now_us >= chore_us:
                chore_us = now_us + 1_000_000
                chore()
            rest_s = PUMP_S if page.clients else 4 * PUMP_S
            await asyncio.sleep(max(min(rest_s, (due_us - monotonic_us()) * 1e-6), 0.0))
    finally:
        await page.close()
