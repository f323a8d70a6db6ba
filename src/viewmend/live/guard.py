"""Who may connect, and how often they may send."""

import asyncio
import hmac
import re
import time
from collections import deque
from ipaddress import ip_address

from starlette.requests import HTTPConnection

TOKEN_LENGTH = 16
WRONG_TOKEN_S = 0.5
"""Seconds until a wrong token is answered."""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # a name, and who knows what 127.0.0.1.example resolves to
        return False


class Guard:
    """Checks the token, the origin, and on loopback the name by which the server is called."""

    def __init__(self, host: str, token: str | None) -> None:
        """Guard a server.

        Raises:
            ValueError: the address is not loopback's and there is no token, or the token is short.
        """
        if token is not None and len(token) < TOKEN_LENGTH:
            raise ValueError(
                f"expected a token of at least {TOKEN_LENGTH} signs, got {len(token)}: it is all that keeps strangers "
                "out; choose a long random one, for example that of python -c 'import secrets; "
                "print(secrets.token_urlsafe())'"
            )
        if not is_loopback(host) and not token:
            raise ValueError(
                f"expected --token with --host {host}: whoever reaches that address could watch; choose a long random "
                "token, or leave --host away"
            )
        self._local = is_loopback(host)
        self.token = token

    def foreign_origin(self, connection: HTTPConnection) -> str | None:
        """Why a request is refused that comes from another site's page; None if it does not.

        Such a page has another `Origin`, or embeds our pictures (`Sec-Fetch-Site`). A page whose own name resolves to
        this machine has that name as `Host`. A plain link to us may be anywhere.
        """
        host = connection.headers.get("host", "")
        place = _place(host, 80)
        if place is None or (self._local and not is_loopback(place[0])):
            return f"expected a request to localhost, got one to '{host[:60]}'; open the address that was printed"
        origin = connection.headers.get("origin")
        if origin is not None and not _same_place(origin, host):
            return f"expected a request of our own page, got one of '{origin[:60]}'"
        site = connection.headers.get("sec-fetch-site", "none")
        followed = connection.headers.get("sec-fetch-dest") == "document"
        if site not in ("none", "same-origin") and not followed:
            return f"expected a request of our own page, got a {site[:20]} one"
        return None

    async def lacks_token(self, connection: HTTPConnection) -> bool:
        """Whether the token is wanted and not given. Who gives a wrong one waits for the answer."""
        if not self.token:
            return False
        scheme, _, given = connection.headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer":
            given = connection.query_params.get("token", "")
        lacks = not hmac.compare_digest(given.encode(errors="replace"), self.token.encode())
        if lacks and given:
            await asyncio.sleep(WRONG_TOKEN_S)
        return lacks


def _place(host: str, port: int) -> tuple[str, int] | None:
    """Name and port of a `Host` header, in lower case; `port` where it has none, None where it is no such header."""
    found = re.fullmatch(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::(\d{1,5}))?", host.lower(), re.ASCII)
    return found and (found[1] or found[2], int(found[3] or port))


def _same_place(origin: str, host: str) -> bool:
    """Whether a page of this `Origin` is one that was served under this `Host`."""
    scheme, _, place = origin.partition("://")
    port = {"http": 80, "https": 443}.get(scheme.lower())
    return port is not None and None is not _place(host, port) == _place(place, port)


class RateLimit:
    """A token bucket: so many events a second on average, twice as many at once."""

    def __init__(self, per_s: float | int) -> None:
        self._per_s = per_s
        self._left, self._at = 2 * per_s, time.monotonic()

    def allows(self) -> bool:
        """Take a token for one more event; whether there was one."""
        now = time.monotonic()
        self._left = min(2 * self._per_s, self._left + (now - self._at) * self._per_s)
        self._at = now
        self._left -= self._left >= 1
        return self._left >= 1


class FaultLimit:
    """How many faults in how many seconds are too many."""

    def __init__(self, faults: int = 20, within_s: float = 10.0) -> None:
        self._at: deque[float] = deque(maxlen=faults)
        self._within_s = within_s

    def exceeded(self) -> bool:
        """Count one more fault; whether that is too many."""
        self._at.append(time.monotonic())
        return len(self._at) == self._at.maxlen and self._at[-1] - self._at[0] < self._within_s
