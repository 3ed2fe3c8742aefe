"""A tab of a browser without a window that is told what to do while it runs: commands and answers through two pipes."""

import fcntl
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from pages import BROWSER

FLAGS = ("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--disable-background-networking", "--no-first-run")
FLAGS += ("--disable-component-update", "--disable-sync", "--window-size=800,600", "--touch-events=enabled")


class Tab:
    """One tab; commands are those of the Chrome DevTools protocol."""

    def __init__(self, to: int, back: int) -> None:
        self.to, self.back, self.count, self.left, self.session = to, back, 0, b"", ""

    def ask(self, method: str, **params: Any) -> Any:
        """The answer to a command; what else the browser says is passed over."""
        self.count += 1
        words = {"id": self.count, "method": method, "params": params}
        os.write(self.to, json.dumps(words | ({"sessionId": self.session} if self.session else {})).encode() + b"\0")
        while True:
            while b"\0" not in self.left:
                more = os.read(self.back, 1 << 16)
                assert more, "the browser has gone"
                self.left += more
            one, self.left = self.left.split(b"\0", 1)
            said = json.loads(one)
            if said.get("id") == self.count:
                assert "error" not in said, said
                return said["result"]

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression; promises are waited for."""
        found = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str) -> None:
        """Waits for something to become true."""
        for _ in range(600):
            if self.value(expression):
                return
            time.sleep(0.1)
        raise AssertionError(f"never came true: {expression}")

    def touch(self, kind: str, *places: tuple[float, float]) -> None:
        """Fingers at places of the page: "touchStart", "touchMove" or "touchEnd"."""
        points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(places)]
        self.ask("Input.dispatchTouchEvent", type=kind, touchPoints=points)


@contextmanager
def tab(address: str) -> Iterator[Tab]:
    """A tab that shows a page, for the time of a `with`."""
    if BROWSER is None:
        pytest.skip("needs chromium or google-chrome on the path")
    ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for pair in (os.pipe(), os.pipe()) for end in pair]  # 3 and 4 stay free
    hears, to, back, says = ends
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [BROWSER, *FLAGS, f"--user-data-dir={profile}", "--remote-debugging-pipe", "about:blank"]
        script = f'exec "$0" "$@" 3</dev/fd/{hears} 4>/dev/fd/{says}'
        with open(os.devnull, "w") as nothing:
            running = subprocess.Popen(["sh", "-c", script, *words], pass_fds=(hears, says), stdout=nothing, stderr=nothing)
        os.close(hears), os.close(says)
        try:
            found = Tab(to, back)
            target = found.ask("Target.createTarget", url=address)["targetId"]
            found.session = found.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            found.ask("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
            found.until('document.readyState === "complete"')
            yield found
        finally:
            running.terminate()
            running.wait(30)
            os.close(to), os.close(back)
