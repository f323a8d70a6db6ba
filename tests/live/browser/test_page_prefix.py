"""The page behind a reverse proxy that serves it under a path, and nothing else."""

import contextlib
import socket
import threading
from collections.abc import Iterator

import pytest
from live.browser.conftest import SCREENSHOT_S, View
from live.live_servers import running

pytestmark = pytest.mark.slow

PREFIX, TOKEN = "/some/rig", "a-token-of-a-test-long-enough"


def forward(client: socket.socket, port: list[int], refused: list[str]) -> None:
    """Pass a connection's requests on without the prefix, and its answers back; after an upgrade, all bytes."""
    with client, socket.create_connection(("127.0.0.1", port[0])) as server, contextlib.suppress(OSError):

        def answer() -> None:
            with contextlib.suppress(OSError):
                while data := server.recv(65536):
                    client.sendall(data)
                client.shutdown(socket.SHUT_RDWR)

        threading.Thread(target=answer, daemon=True).start()
        waiting, upgraded = b"", False
        while data := client.recv(65536):
            waiting += data
            while not upgraded and b"\r\n\r\n" in waiting:
                head, waiting = waiting.split(b"\r\n\r\n", 1)
                method, path, rest = head.split(b" ", 2)
                if not path.startswith(PREFIX.encode() + b"/"):
                    refused.append(path.decode())
                    return
                server.sendall(b" ".join([method, path[len(PREFIX) :], rest]) + b"\r\n\r\n")
                upgraded = b"upgrade: websocket" in head.lower()
            if upgraded:
                server.sendall(waiting)
                waiting = b""


@contextlib.contextmanager
def proxy(port: list[int], refused: list[str]) -> Iterator[int]:
    """A proxy on a free port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    client = listener.accept()[0]
                    threading.Thread(target=forward, args=(client, port, refused), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)


def test_everything_lies_under_the_path(browser):
    behind, refused = [0], []
    with (
        proxy(behind, refused) as port,
        running(token=TOKEN, public_url=f"http://127.0.0.1:{port}{PREFIX}") as server,
    ):
        behind[0] = server.port
        page, asked, errors = browser.new_page(), [], []
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.goto(f"http://127.0.0.1:{port}{PREFIX}/?token={TOKEN}&time=0")
        view = View(page, server, errors)
        view.until(lambda: view.data("drawn") is not None and view.data("full") == "true", SCREENSHOT_S)
        page.keyboard.press("n")
        view.until(lambda: page.locator("#input-row").is_visible())
        page.keyboard.press("x")
        view.until(lambda: "dB" in page.locator("#error-name").inner_text(), SCREENSHOT_S)
        page.close()
        here = [url for url in asked if url.startswith("http")]
        assert all(any(part in url for url in here) for part in ("assets/0", "camera.jpg", "frame.jpg"))
        assert not refused and not errors and all(f":{port}{PREFIX}/" in url for url in here)
