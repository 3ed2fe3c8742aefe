"""The page behind an address of this machine, until Ctrl-C."""

import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from ddprt.errors import UserError


def server(page: str, port: int) -> ThreadingHTTPServer:
    """A server that knows this page alone, reachable from this machine only.

    Args:
      page: HTML.
      port: 0 takes one that is free.
    Raises:
      UserError: the port is taken or not allowed.
    """
    body = page.encode("utf-8")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """The page; nothing else is here."""
            known = self.path.split("?")[0] == "/"
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body) if known else 0))
            self.end_headers()
            if known:
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing: requests are of no interest."""

    try:
        return ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise UserError(f"--port: got {port} ({error.strerror}), expected a free one; take another, or leave it out") from None


def serve(page: str, port: int, *, browse: bool) -> None:
    """Serves a page until it is interrupted, which ends it well.

    Args:
      page: HTML.
      port: 0 takes one that is free.
      browse: open it in the user's browser.
    Raises:
      UserError: as in `server`.
    """
    with server(page, port) as running:
        address = f"http://127.0.0.1:{running.server_address[1]}/"
        print(f"viewer:   {address} (Ctrl-C ends it)", flush=True)
        if browse:
            webbrowser.open(address)
        try:
            running.serve_forever()
        except KeyboardInterrupt:
            print()
