"""Requests need the token, and must not come from other sites' pages; messages are limited in rate."""

import re

import pytest
from live.live_servers import FakeClock, exchange, get, open_websocket, running, say_hello
from starlette.requests import HTTPConnection
from websockets.exceptions import InvalidStatus

from viewmend.live.auth import AccessControl, RateLimit
from viewmend.live.client import Client
from viewmend.live.responses import page_files

TOKEN = "open sesame, open"


def test_the_token_opens_everything_but_the_page():
    with running(token=TOKEN) as server:
        assert get(f"{server.url}/health")[0] == get(f"{server.url}/health?token=wrong")[0] == 401
        assert get(f"{server.url}/health?token=open+sesame,+open")[0] == 200
        assert get(f"{server.url}/health", {"Authorization": f"Bearer {TOKEN}"})[0] == 200
        assert get(f"{server.url}/")[0] == 200 and get(f"{server.url}/page/nothing.js")[0] == 404
        for query in ("", "?token=wrong"):
            with pytest.raises(InvalidStatus, match="401"):
                open_websocket(server, f"/ws{query}").__enter__()
        with pytest.raises(ConnectionError, match=r"refuses \(401\): .*expected the token"):
            Client(server.ws, token="another long secret").__enter__()
        assert server.is_serving()


def test_a_token_may_have_any_character():
    token = "a+b&c#d/e f%, and more"
    with running(token=token, ready=False) as server, Client(server.ws, token=token) as viewer:
        assert viewer.messages["welcome"]


def test_pages_of_other_sites_are_refused(ball):
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
        assert get(f"{ball.url}/health", headers)[0] == 403 and get(f"{ball.url}/", headers)[0] == 403
    assert get(f"{ball.url}/health", {"Origin": ball.url})[0] == 200
    rebound = {
        "Host": f"127.0.0.1.evil.example:{ball.port}",
        "Origin": f"http://127.0.0.1.evil.example:{ball.port}",
    }
    for headers in (
        rebound,
        {"Origin": "http://["},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
    ):
        assert get(f"{ball.url}/frame.jpg?width=16&height=16", headers)[0] == 403
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
    assert get(ball.url, link)[0] == get(ball.url, {"Sec-Fetch-Site": "same-origin"})[0] == 200
    with pytest.raises(InvalidStatus, match="403"):
        open_websocket(ball, origin="http://evil.example").__enter__()
    with open_websocket(ball, origin=ball.url) as own:
        assert say_hello(own)["type"] == "welcome"


@pytest.mark.parametrize(
    "host",
    [
        "[::1].evil.com",
        "localhost:80@evil.com",
        "localhost/",
        "127.0.0.1.evil.com",
        "",
        "[::1",
        "localhost:x",
    ],
)
def test_hosts_are_parsed_and_not_matched(ball, host):
    answer = exchange(ball, f"GET /health HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 403")
    assert get(f"{ball.url}/health", {"Origin": f"http://{host}:{ball.port}"})[0] == 403


@pytest.mark.parametrize("host", ["LOCALHOST", "[::1]:80", "127.0.0.2", "Localhost:8008"])
def test_all_names_of_this_machine_are_accepted(ball, host):
    assert get(f"{ball.url}/health", {"Host": host, "Origin": f"http://{host.lower()}"})[0] == 200
    assert get(f"{ball.url}/health", {"Host": host, "Origin": f"http://{host}.evil.com"})[0] == 403


def test_a_proxy_serves_the_page_under_a_public_name_and_path():
    public = {"Host": "rig.example.org", "Origin": "https://rig.example.org", "Sec-Fetch-Site": "same-origin"}
    with running(token=TOKEN) as server:  # with a token, any host name is accepted
        health = f"{server.url}/health?token=open+sesame,+open"
        assert get(health, public)[0] == 200
        assert get(health, public | {"Origin": "https://evil.example"})[0] == 403
    with running(token=TOKEN, public_url="https://rig.example.org/mend/") as server:
        for prefix in ("", "/mend"):  # whether or not the proxy removes it
            status, _, page = get(f"{server.url}{prefix}/", public)
            links = re.findall(r'(?:href|src)="([^"#]+)"', page.decode())
            assert status == 200 and len(links) >= 5 and not any(link.startswith("/") for link in links)
            assert {get(f"{server.url}{prefix}/{link}", public)[0] for link in links} == {200}
        changed = public | {"Host": f"127.0.0.1:{server.port}"}  # by the proxy
        assert get(f"{server.url}/health?token=open+sesame,+open", changed)[0] == 200
    for file in (file for name, file in page_files().items() if name.endswith((".js", ".css", ".html"))):
        assert not re.search(rb"""["'`(]/(page|ws|watch|health|path|camera|broadcast)\b""", file.content)


@pytest.mark.parametrize("url", ["rig.example.org", "ftp://rig.example.org", "https://", "https://a/?b=1"])
def test_a_public_address_is_one(url):
    with pytest.raises(ValueError, match="expected --public-url https://NAME/PATH, got"):
        AccessControl("127.0.0.1", TOKEN, url)
    with pytest.raises(ValueError, match="expected --token with --public-url"):
        AccessControl("127.0.0.1", None, url)


def test_an_origin_has_the_default_port_of_its_scheme():
    def is_refused(host, origin, public_url=None):
        access = AccessControl("0.0.0.0", "x" * 16, public_url)
        headers = [(b"host", host.encode()), (b"origin", origin.encode())]
        return access.find_foreign_origin(HTTPConnection({"type": "http", "headers": headers})) is not None

    assert not is_refused("rig.example", "https://rig.example:443")
    assert not is_refused("rig.example:80", "http://RIG.example")
    assert is_refused("rig.example", "https://rig.example:8008") and is_refused(
        "rig.example", "file://rig.example"
    )
    assert is_refused("rig.example:80", "https://rig.example")
    assert not is_refused("127.0.0.1:8008", "https://rig.example", "https://rig.example:443/mend")
    assert is_refused("127.0.0.1:8008", "https://rig.example", "http://rig.example:443")


def test_an_address_of_other_machines_needs_a_token():
    for host in ("0.0.0.0", "192.168.1.4", "::"):
        with pytest.raises(ValueError, match=f"expected --token with --host {host}"):
            AccessControl(host, None)
        AccessControl(host, "x" * 16)
    with pytest.raises(ValueError, match="at least 16 characters, got 15"):
        AccessControl("127.0.0.1", "x" * 15)
    AccessControl("127.0.0.1", None)
    AccessControl("::1", None)


def test_rate_limits():
    clock = FakeClock()
    rate = RateLimit(10, 20, clock)
    assert sum(rate.allow() for _ in range(100)) == 20
    clock.advance(0.5)
    assert sum(rate.allow() for _ in range(100)) == 5
    clock.advance(1000)
    assert sum(rate.allow() for _ in range(100)) == 20, "a long pause does not save up more"
