"""One HTML file that shows a model: data, program and style in it, so that it opens from disk."""

import html
import json
import re
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent


def page(packed: dict[str, Any]) -> str:
    """The page of what `pack` made; it asks nobody for anything."""
    data = json.dumps(packed, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "title": html.escape(f"{packed['name']}: ddprt"),
        "style": (_HERE / "page.css").read_text("utf-8"),
        "model": data,
        "script": (_HERE / "viewer.js").read_text("utf-8"),
    }
    text = (_HERE / "page.html").read_text("utf-8")
    return re.sub("|".join(rf"\{{{name}\}}" for name in parts), lambda found: parts[found[0][1:-1]], text)
