"""Answers that several routes give, and the body of a request."""

import asyncio

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from viewmend.live.protocol import ProtocolError

BODY_BYTES, BODY_S = 1_000_000, 10.0
"""The largest body, and how long it may take."""


async def whole_body(request: Request) -> bytearray | None:
    """The request's body; None where it is too large.

    Raises:
        ProtocolError: it takes too long, or breaks off.
    """
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > BODY_BYTES:
                    return None
    except TimeoutError:
        raise ProtocolError(f"expected the whole body within {BODY_S:g} s") from None
    except ClientDisconnect:
        raise ProtocolError("expected the whole body, got a part of it") from None
    return body


def refusal(status: int, message: str | None) -> Response:
    """An error, in words."""
    return JSONResponse({"error": message}, status, headers={"Cache-Control": "no-store"})
