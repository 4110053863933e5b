"""The server: files, news, wishes, and who may speak to it."""

from __future__ import annotations

import asyncio
import json
import re
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus

from mavsitl.link.base import LinkError
from mavsitl.link.udp import LOOPBACK
from mavsitl.view.model import Model
from mavsitl.view.server import MAX_CLIENTS, Page, Wish

pytestmark = pytest.mark.sockets

PAGE = Path(str(resources.files("mavsitl.view") / "page"))
PATIENCE_S = 30.0


class Shown:
    """A source whose values the test sets, and whose wishes it reads."""

    hz = 30.0

    def __init__(self) -> None:
        self.model = Model()
        self.wishes: list[Wish] = []

    def pump(self, now_us: int) -> None: ...

    def step(self, now_us: int) -> None: ...

    def wish(self, wish: Wish) -> None:
        if getattr(wish, "name", "") == "none":
            raise KeyError("none")
        self.wishes.append(wish)


@asynccontextmanager
async def serving(source: Shown, host: str = LOOPBACK) -> AsyncIterator[Page]:
    page = Page(source, host)
    await page.start()
    try:
        yield page
    finally:
        await page.close()


def run(body: Callable[[], Awaitable[None]]) -> None:
    async def patiently() -> None:
        await asyncio.wait_for(body(), PATIENCE_S)

    asyncio.run(patiently())


async def get(page: Page, path: str, host: str | None = None, extra: str = "") -> tuple[int, dict[str, str], bytes]:
    """Status, headers by lower-case name, content."""
    reader, writer = await asyncio.open_connection(LOOPBACK, page.port)
    name = f"127.0.0.1:{page.port}" if host is None else host
    writer.write(f"GET {path} HTTP/1.1\r\nHost: {name}\r\n{extra}\r\n".encode())
    answer = await reader.read()
    writer.close()
    head, _, content = answer.partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
    return int(status.split()[1]), headers, content


def live(page: Page, **options: Any) -> Any:
    return connect(f"ws://127.0.0.1:{page.port}/live{options.pop('query', '')}", **options)


async def told(page: Page, client: ClientConnection, now_us: int = 0) -> dict[str, Any]:
    """The next news."""
    page.tell(now_us)
    answer: dict[str, Any] = json.loads(await client.recv())
    return answer


async def refused(opening: Any) -> int:
    with pytest.raises(InvalidStatus) as caught:
        async with opening:
            pass
    status: int = caught.value.response.status_code
    return status


# --- files


def test_every_file_of_the_page_is_served_and_nothing_else() -> None:
    async def body() -> None:
        async with serving(Shown()) as page:
            for file in sorted(PAGE.rglob("*")):
                if file.suffix in (".html", ".js", ".css", ".svg", ".md"):
                    status, headers, content = await get(page, f"/{file.relative_to(PAGE).as_posix()}")
                    assert (status, content) == (200, file.read_bytes()), file
                    assert "default-src 'none'" in headers["content-security-policy"]
                    assert "frame-ancestors 'none'" in headers["content-security-policy"]
                    assert headers["x-content-type-options"] == "nosniff"
            status, headers, content = await get(page, "/")
            assert headers["content-type"].startswith("text/html")
            assert b"<title>mavsitl view</title>" in content
            for path in (
                "/none.js", "/../server.py", "/..%2fserver.py", "/%2e%2e/server.py", "/vendor", "/vendor/",
                "//etc/passwd", "/vendor/../../server.py", "/.", "/__init__.py",
            ):  # fmt: skip
                assert (await get(page, path))[0] == 404, path

    run(body)


def test_the_page_loads_nothing_from_outside() -> None:
    """What it names is a file of its own."""
    names = re.compile(r"""(?:src|href)=["']([^"']+)["']|from\s+["']([^"']+)["']|url\(["']?([^"')]+)""")
    for path in sorted(PAGE.glob("*.*")):
        if path.suffix not in (".html", ".js", ".css"):
            continue
        for match in names.finditer(path.read_text()):
            name = next(group for group in match.groups() if group)
            assert name.startswith("#") or (path.parent / name).is_file(), f"{path.name}: {name}"


def test_the_libraries_are_those_that_are_listed() -> None:
    vendor = PAGE / "vendor"
    listed = dict(re.findall(r"\| `(\w+)\.min\.js`[^|]*\|[^|]*\| ([0-9.]+) \|", (vendor / "README.md").read_text()))
    assert set(listed) == {"three", "uplot"}
    assert listed["uplot"] in (vendor / "uplot.min.js").read_text()[:100]
    revision = listed["three"].split(".")[1]
    assert re.search(rf'="{revision}"', (vendor / "three.min.js").read_text())
    assert "SPDX-License-Identifier: MIT" in (vendor / "three.min.js").read_text()
    for library in listed:
        assert "MIT License" in (vendor / f"LICENSE-{library}").read_text()


def test_the_page_knows_the_columns_of_a_row() -> None:
    from mavsitl.view.model import COLUMNS

    text = (PAGE / "store.js").read_text()
    block = text[text.index("COLUMNS = [") : text.index("];")]
    names = re.findall(r'"(\w+)"', block)
    assert len(names) == len(COLUMNS)
    ours = [re.sub(r"_(s|m|deg|ms|percent)$", "", name) for name in COLUMNS]
    assert [re.sub(r"[A-Z]", lambda letter: f"_{letter[0].lower()}", name) for name in names] == ours


# --- news and wishes


def test_news_go_to_each_client_once() -> None:
    async def body() -> None:
        source = Shown()
        source.model.put("kind", "live")
        source.model.vehicle(1).put("mode", "OFFBOARD")
        async with serving(source) as page, live(page) as one, live(page) as other:
            assert (await told(page, one))["vehicles"]["1"] == {"mode": "OFFBOARD"}
            assert json.loads(await other.recv())["world"] == {"kind": "live"}
            source.model.vehicle(1).put("armed", True)
            await asyncio.sleep(0)
            assert await told(page, one) == {"vehicles": {"1": {"armed": True}}}
            assert json.loads(await other.recv()) == {"vehicles": {"1": {"armed": True}}}

    run(body)


def test_wishes_are_handed_on_and_what_is_wrong_is_answered() -> None:
    async def body() -> None:
        source = Shown()
        async with serving(source) as page, live(page) as client:
            await client.send('{"type":"act","vehicle":1,"name":"arm"}')
            for wrong, answer in (
                ('{"type":"act","vehicle":1,"name":"none"}', "there is no 'none'; buttons: arm"),
                ("not json", "not understood"),
                ('{"type":"none"}', "not understood"),
                ('{"type":"act","vehicle":1,"name":"arm","more":1}', "not understood"),
                ('{"type":"seek","at_s":"soon"}', "not understood"),
                ('{"type":"seek","at_s":NaN}', "not understood"),
                (b"\xff\xfe", "not understood"),
            ):
                await client.send(wrong)
                assert answer in json.loads(await client.recv())["problem"], wrong
            assert [str(wish) for wish in source.wishes] == ["Act(vehicle=1, name='arm')"]

    run(body)


def test_a_page_that_nobody_sees_is_told_seldom_and_then_all() -> None:
    async def body() -> None:
        source = Shown()
        vehicle = source.model.vehicle(1)
        vehicle.put("n", 0)
        async with serving(source) as page, live(page) as client:
            await client.send('{"type":"pace","hz":1}')
            await client.send('{"type":"none"}')
            await client.recv()  # the answer: the pace is known
            await told(page, client)
            for tick in range(1, 30):
                vehicle.put("n", tick)
                page.tell(tick * 33_333)
            news = await told(page, client, 1_000_000)
            assert news == {"vehicles": {"1": {"n": 29}}}

    run(body)


def test_a_client_that_does_not_read_costs_no_memory() -> None:
    """What is sent waits for what was sent before; then it is told the present."""

    async def body() -> None:
        source = Shown()
        vehicle = source.model.vehicle(1)
        async with serving(source) as page, live(page, max_queue=1) as client:
            for tick in range(3000):
                vehicle.put("n", f"{tick}:" + "x" * 20_000)
                page.tell(tick)
                await asyncio.sleep(0)
            received = 0
            while f"{2999}:" not in await client.recv():
                received += 1
                page.tell(10**9)
            assert received < 1000

    run(body)


def test_a_message_that_is_too_long_ends_its_connection_alone() -> None:
    async def body() -> None:
        source = Shown()
        async with serving(source) as page, live(page) as rude, live(page) as client:
            await rude.send("x" * 100_000)
            await rude.wait_closed()
            source.model.put("kind", "live")
            assert await told(page, client) == {"forget_texts": True, "world": {"kind": "live"}}

    run(body)


# --- who may speak


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example:{port}", "127.0.0.1:1", "", "[", "localhost"],
)
def test_no_foreign_name_leads_here(host: str) -> None:
    """DNS rebinding: a site's own name that now means this machine."""

    async def body() -> None:
        async with serving(Shown()) as page:
            for path in ("/", "/live"):
                status, _, _ = await get(page, path, host.format(port=page.port))
                assert status in (400, 403)

    run(body)


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "[::1]:{port}", "LOCALHOST:{port}"])
def test_our_own_names_lead_here(host: str) -> None:
    async def body() -> None:
        async with serving(Shown()) as page:
            assert (await get(page, "/", host.format(port=page.port)))[0] == 200

    run(body)


def test_no_page_of_another_site_opens_a_websocket() -> None:
    """Cross-site WebSocket hijacking: browsers send the page's origin, and let it through."""

    async def body() -> None:
        async with serving(Shown()) as page:
            others = ("evil.example", f"localhost:{page.port}", "127.0.0.1", f"127.0.0.1:{page.port}.evil.example")
            for origin in (*(f"http://{other}" for other in others), f"https://127.0.0.1:{page.port}", "null"):
                assert await refused(live(page, origin=origin)) == 403
            async with live(page, origin=f"http://127.0.0.1:{page.port}"):
                pass

    run(body)


def test_beyond_loopback_a_token_is_needed() -> None:
    async def body() -> None:
        async with serving(Shown(), "0.0.0.0") as page:
            token = page.address.partition("?token=")[2]
            assert len(token) >= 20
            assert await refused(live(page)) == 401
            assert await refused(live(page, query="?token=")) == 401
            assert await refused(live(page, query=f"?token={token[:-1]}")) == 401
            assert await refused(live(page, query="?token=%ff%fe")) == 401
            async with live(page, query=f"?token={token}"):
                pass
            assert await refused(live(page, query=f"?token={token}", origin="http://evil.example")) == 403
            assert (await get(page, "/"))[0] == 200  # the page itself is no secret

    run(body)


def test_each_start_has_another_token() -> None:
    pages = [Page(Shown(), "0.0.0.0") for _ in range(2)]
    assert pages[0]._token != pages[1]._token
    assert Page(Shown())._token == ""


def test_pages_are_bounded() -> None:
    async def body() -> None:
        async with serving(Shown()) as page:
            opened = [await live(page) for _ in range(MAX_CLIENTS)]
            while page.clients < MAX_CLIENTS:
                await asyncio.sleep(0.001)
            assert await refused(live(page)) == 503
            for each in opened:
                await each.close()
            while page.clients:
                await asyncio.sleep(0.001)
            async with live(page):
                pass

    run(body)


def test_a_port_that_is_taken_is_named_with_its_option() -> None:
    async def body() -> None:
        with socket.socket() as holder:
            holder.bind((LOOPBACK, 0))
            holder.listen()
            port = holder.getsockname()[1]
            with pytest.raises(LinkError, match=rf"port {port} is in use .*--port N"):
                await Page(Shown(), LOOPBACK, port).start()

    run(body)


def test_junk_on_the_port_harms_nobody() -> None:
    async def body() -> None:
        source = Shown()
        source.model.put("kind", "live")
        async with serving(source) as page, live(page) as client:
            for junk in (b"\x00" * 100, b"GET\r\n\r\n", b"GET /live HTTP/1.1\r\n" + b"A: b\r\n" * 1000 + b"\r\n"):
                reader, writer = await asyncio.open_connection(LOOPBACK, page.port)
                writer.write(junk)
                writer.write_eof()
                await reader.read()
                writer.close()
            assert (await told(page, client))["world"] == {"kind": "live"}

    run(body)
