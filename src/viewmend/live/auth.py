"""Access control by token, origin and host name, and rate limits for messages."""

import asyncio
import hmac
import re
from collections.abc import Callable
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

MIN_TOKEN_LENGTH = 16
WRONG_TOKEN_S = 0.5
"""Delay before a wrong token is answered."""
DEFAULT_PORTS = {"http": 80, "https": 443}
"""Ports that addresses of these schemes may leave out."""
Origin = tuple[str, str, int]
"""Scheme, name and port of a site, in lower case."""


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # any other name, such as 127.0.0.1.example, may resolve to any address
        return False


class AccessControl:
    """Checks the token, the origin and, on a loopback address without a token, the host name of a request."""

    def __init__(self, host: str, token: str | None, public_url: str | None = None) -> None:
        """Set up the checks of one server, which a proxy may serve at a public address.

        ValueError if other machines can reach the server and there is no token, or the token or the
        address is invalid.
        """
        if token is not None and len(token) < MIN_TOKEN_LENGTH:
            raise ValueError(
                f"expected a token of at least {MIN_TOKEN_LENGTH} characters, got {len(token)}; create a random one, "
                "for example with: python -c 'import secrets; print(secrets.token_urlsafe())'"
            )
        if not is_loopback(host) and not token:
            raise ValueError(
                f"expected --token with --host {host}, which other machines can reach; create a long random token, "
                "or leave out --host"
            )
        if public_url is not None and not token:
            raise ValueError(
                f"expected --token with --public-url {public_url}, which other machines can reach; create a "
                "long random one"
            )
        self._public: Origin | None = None
        if public_url is not None:
            url = urlsplit(public_url)
            self._public = _parse_origin(f"{url.scheme}://{url.netloc}")
            if self._public is None or url.query or url.fragment:
                next_step = "write the proxy's address"
                raise ValueError(
                    f"expected --public-url https://NAME/PATH, got '{public_url[:80]}'; {next_step}"
                )
        # Without a token, a page whose name resolves to this machine could read what it shows.
        self._any_host = bool(token) or not is_loopback(host)
        self._token = token

    def find_foreign_origin(self, connection: HTTPConnection) -> str | None:
        """The reason to refuse a request that another site's page has caused; None for any other request.

        Such a page has another `Origin`, or embeds an image of ours (`Sec-Fetch-Site`). A page
        whose own host name resolves to this machine has that name as `Host`. Plain links from any
        page are allowed.
        """
        host = connection.headers.get("host", "")
        address = _parse_host(host, 80)
        if address is None or not (self._any_host or is_loopback(address[0])):
            next_step = "open the address that was printed, or add --token"
            return f"expected a request to localhost, got one to '{host[:60]}'; {next_step}"
        origin = connection.headers.get("origin")
        if origin is not None and not _is_own_origin(origin, host, self._public):
            next_step = "open the printed address, or start the server with --public-url"
            return (
                f"expected a request from this server's own page, got the origin '{origin[:60]}'; {next_step}"
            )
        site = connection.headers.get("sec-fetch-site", "none")
        is_link = connection.headers.get("sec-fetch-dest") == "document"
        if site not in ("none", "same-origin") and not is_link:
            return f"expected a request from this server's own page, got a {site[:20]} request"
        return None

    async def has_token(self, connection: HTTPConnection) -> bool:
        """Whether the request carries the token, or none is required. A wrong token is answered with a delay."""
        if not self._token:
            return True
        scheme, _, given = connection.headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer":
            given = connection.query_params.get("token", "")
        valid = hmac.compare_digest(given.encode(errors="replace"), self._token.encode())
        if given and not valid:
            await asyncio.sleep(WRONG_TOKEN_S)
        return valid


def _parse_host(host: str, default_port: int) -> tuple[str, int] | None:
    """Name, in lower case, and port of a `Host` header; None for a malformed one."""
    found = re.fullmatch(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::(\d{1,5}))?", host.lower(), re.ASCII)
    return found and (found[1] or found[2], int(found[3] or default_port))


def _parse_origin(origin: str) -> Origin | None:
    """The parts of an `Origin` header; None for a malformed one, or another scheme."""
    scheme, _, address = origin.lower().partition("://")
    host = _parse_host(address, DEFAULT_PORTS[scheme]) if scheme in DEFAULT_PORTS else None
    return host and (scheme, *host)


def _is_own_origin(origin: str, host: str, public: Origin | None) -> bool:
    """Whether an `Origin` header names the server: the request's own `Host`, or the public address."""
    parsed = _parse_origin(origin)
    return parsed is not None and parsed in (public, _parse_origin(f"{parsed[0]}://{host}"))


class RateLimit:
    """A token bucket: `per_s` events a second on average, `burst` at once."""

    def __init__(self, per_s: float | int, burst: float | int, now: Callable[[], float]) -> None:
        self._per_s = per_s
        self._burst = burst
        self._now = now
        self._left = burst
        self._updated_s = now()

    def allow(self) -> bool:
        """Count one event; False if it is above the limit."""
        now = self._now()
        self._left = min(self._burst, self._left + (now - self._updated_s) * self._per_s)
        self._updated_s = now
        allowed = self._left >= 1
        self._left -= allowed
        return allowed
