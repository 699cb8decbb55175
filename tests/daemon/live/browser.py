"""Headless Chromium for tests of the page: DevTools over a websocket, what it logs, and pictures."""

import base64
import json
import re
import shutil
import subprocess
import time
from pathlib import Path

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium")
_OPTIONS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-sync",
    ),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"),
    *("--disable-dev-shm-usage", "--disable-extensions", "--hide-scrollbars", "about:blank"),
)


class Browser:
    """One browser with one page; for a `with` statement. `errors`: what the page's console and network report."""

    def __init__(self, profile: Path) -> None:
        assert CHROMIUM is not None
        self.errors = []
        self._count = 0
        log = profile / "stderr"
        profile.mkdir()
        with log.open("w") as file:
            command = [CHROMIUM, f"--user-data-dir={profile}", *_OPTIONS]
            self._process = subprocess.Popen(command, stdout=file, stderr=file)
        end = time.monotonic() + 60.0
        while not (found := re.search(r"DevTools listening on (ws://\S+)", log.read_text())):
            assert time.monotonic() < end, log.read_text()
            assert self._process.poll() is None, log.read_text()
            time.sleep(0.05)
        self._socket = connect(found[1], max_size=None, ping_interval=None).__enter__()
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._session = None
        self.call("Browser.close")
        self._process.wait(10)

    def call(self, method, **parameters):
        """The result of one command; what happens meanwhile is looked through for errors."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=60.0))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def _note(self, method, found):
        if method == "Runtime.exceptionThrown" or (
            method == "Runtime.consoleAPICalled" and found["type"] in ("error", "warning", "assert")
        ):
            self.errors.append(found)
        entry = found.get("entry", {})  # "rendering": a test that reads a canvas
        if entry.get("level") in ("error", "warning") and entry["source"] != "rendering":
            self.errors.append(entry)

    def open(self, url, width=1280, height=900, scheme="light"):
        """Open a page at this width [px], in the scheme light or dark."""
        self.show(width, height, scheme)
        self.call("Page.navigate", url=url)

    def show(self, width, height=900, scheme="light"):
        """Resize the page, and choose its colours."""
        phone = width < 600
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", features=features)

    def value(self, expression):
        """Value of a JavaScript expression in the page."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, expression, timeout_s=60.0):
        """The value of an expression once it is true."""
        end = time.monotonic() + timeout_s
        while not (value := self.value(expression)):
            assert time.monotonic() < end, (expression, self.errors)
            time.sleep(0.05)
        return value

    def picture(self, path):
        """Save a picture of the whole page."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(shot["data"]))
