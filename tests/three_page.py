"""A page that runs a few words of three.js in a browser without a window, and what they tell."""

import json
import os
import re
import subprocess
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from ddprt.export.browser import browser

THREE = os.environ.get("DDPRT_THREE", "")  # a folder of three.js as npm has it
FLAGS = ("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--dump-dom")
PAGE = """<!doctype html><meta charset="utf-8"><pre id="told"></pre>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/": "/three/"}}</script>
<script type="module">
let told;
const text = (array) => btoa(String.fromCharCode(...new Uint8Array(array.buffer)));
try { const THREE = await import("three"); WORDS } catch (error) { told = { fault: String(error.stack || error) }; }
document.getElementById("told").textContent = JSON.stringify(told);
</script>"""
needs_three = pytest.mark.skipif(
    browser() is None or not THREE, reason="needs a browser, and DDPRT_THREE, the folder of npm's three"
)


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder without a word."""

    def log_message(self, format: str, *args: object) -> None:
        pass


def told_by_three(words: str, model: Path, scratch: Path) -> dict[str, Any]:
    """What `words` put into `told`; they know THREE, `text` for arrays, and the folder of a model at /model/."""
    (scratch / "three").symlink_to(Path(THREE).resolve())
    (scratch / "model").symlink_to(model)
    (scratch / "index.html").write_text(PAGE.replace("WORDS", words))
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(scratch))) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{running.server_address[1]}/index.html"
        command = [str(browser()), *FLAGS, "--virtual-time-budget=10000", f"--user-data-dir={scratch / 'profile'}", address]
        done = subprocess.run(command, capture_output=True, text=True)
        running.shutdown()
    answer = re.search(r'<pre id="told">(.*?)</pre>', done.stdout, re.DOTALL)
    assert answer, done.stdout
    told = json.loads(answer[1])
    assert "fault" not in told, told
    return told
