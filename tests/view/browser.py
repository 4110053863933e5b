"""A headless Chromium for the tests, driven by its DevTools protocol; also takes pictures of the page by hand:

python -m tests.view.browser http://127.0.0.1:8550/ page.png --size 1280x720 --dark --wait 10
"""

from __future__ import annotations

import argparse
import base64
import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from websockets.sync.client import ClientConnection, connect

PATIENCE_S = 60.0
"""On a machine that has much else to do."""

_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-extensions", "--disable-default-apps", "--hide-scrollbars", "--mute-audio",
    "--disable-renderer-backgrounding", "--disable-backgrounding-occluded-windows",
    "--remote-debugging-port=0", "about:blank",
)  # fmt: skip


def program() -> str | None:
    """Where Chromium is; None: there is none."""
    return next(
        (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
    )


class Tab:
    """A page in the browser."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._calls = 0
        self.errors: list[str] = []
        """What the page threw, or wrote to its console as an error."""
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> Any:
        """One call of the DevTools protocol; events that come meanwhile are looked at for errors."""
        self._calls += 1
        self._connection.send(json.dumps({"id": self._calls, "method": method, "params": params}))
        while True:
            answer = json.loads(self._connection.recv(timeout=PATIENCE_S))
            if answer.get("id") == self._calls:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif event.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(f"{params['entry']['text']} {params['entry'].get('url', '')}")
        elif event.get("method") == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.errors.append(str(params["args"]))

    def look(self, size: tuple[int, int], *, dark: bool = False, scale: float = 1.0) -> None:
        """Size of the window in pixels of the page, and the system's choice of colours."""
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )
        scheme = "dark" if dark else "light"
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Of an expression of JavaScript, as JSON has it."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait(self, expression: str, patience_s: float = PATIENCE_S) -> None:
        """Until the expression is true. Raises `TimeoutError`, with what the page shows."""
        end_s = monotonic() + patience_s
        while True:
            if self.value(f"Boolean({expression})"):
                return
            if monotonic() > end_s:
                shown = self.value("document.body.innerText")
                raise TimeoutError(f"not within {patience_s:g} s: {expression}\n{shown}\n{self.errors}")
            sleep(0.05)

    def press(self, selector: str, text: str) -> None:
        """Click the first element of the selector with this text, as soon as it can be clicked."""
        button = (
            f"[...document.querySelectorAll({json.dumps(selector)})].find((b) => b.textContent === {json.dumps(text)})"
        )
        self.wait(f"{button} && !{button}.disabled")
        self.value(f"{button}.click()")

    def picture(self) -> bytes:
        """PNG."""
        data: str = self.call("Page.captureScreenshot", format="png")["data"]
        return base64.b64decode(data)


class Browser:
    """Tabs of one browser."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._stack = ExitStack()
        self._browser = self._connect(self._address())

    def _connect(self, address: str) -> ClientConnection:
        return self._stack.enter_context(connect(address, max_size=None, open_timeout=PATIENCE_S))

    def _address(self) -> str:
        import urllib.request

        with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/json/version", timeout=PATIENCE_S) as answer:
            address: str = json.load(answer)["webSocketDebuggerUrl"]
            return address

    def tab(self) -> Tab:
        self._browser.send(json.dumps({"id": 1, "method": "Target.createTarget", "params": {"url": "about:blank"}}))
        while (answer := json.loads(self._browser.recv(timeout=PATIENCE_S))).get("id") != 1:
            pass
        target = answer["result"]["targetId"]
        return Tab(self._connect(f"ws://127.0.0.1:{self._port}/devtools/page/{target}"))

    def close(self) -> None:
        self._stack.close()


@contextmanager
def browser() -> Iterator[Browser]:
    """A Chromium with a profile of its own, ended at the end of the `with`."""
    found = program()
    assert found is not None
    with tempfile.TemporaryDirectory(prefix="mavsitl-view-", ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [found, f"--user-data-dir={profile}", *_OPTIONS],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            told = Path(profile) / "DevToolsActivePort"
            end_s = monotonic() + PATIENCE_S
            while not (told.is_file() and len(told.read_text().split()) == 2):
                if process.poll() is not None or monotonic() > end_s:
                    raise RuntimeError(f"Chromium does not start (exit code {process.returncode})")
                sleep(0.05)
            opened = Browser(int(told.read_text().split()[0]))
            try:
                yield opened
            finally:
                opened.close()
        finally:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Take a picture of a page.")
    parser.add_argument("address")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--wait", type=float, default=5.0, metavar="S")
    parser.add_argument("--run", default="", metavar="JAVASCRIPT", help="first")
    options = parser.parse_args(arguments)
    width, height = map(int, options.size.split("x"))
    with browser() as opened:
        tab = opened.tab()
        tab.look((width, height), dark=options.dark, scale=options.scale)
        tab.open(options.address)
        if options.run:
            sleep(1.0)
            tab.value(options.run)
        sleep(options.wait)
        options.picture.write_bytes(tab.picture())
        for error in tab.errors:
            print(error)
    return 1 if tab.errors else 0


if __name__ == "__main__":
    raise SystemExit(main())
