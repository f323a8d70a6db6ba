"""The broadcast over HTTP: a playlist and its segments, which any HLS player and any cache understands."""

import asyncio
import re
import time

from starlette.requests import Request
from starlette.responses import Response

from viewmend.live.answers import refusal
from viewmend.live.broadcast import Broadcast
from viewmend.live.film_segments import PLAYLIST
from viewmend.live.protocol import token_query

FIRST_S = 20.0
"""So long who asks for the playlist waits for a film that begins."""
PLAYLIST_AGE_S, SEGMENT_AGE_S = 1, 60
"""How long caches may answer with what they have."""


async def film_answer(broadcast: Broadcast, request: Request) -> Response:
    """A file of the film; 404 for one that is not there, 503 for a film that does not begin."""
    name, end = request.path_params["name"], time.monotonic() + FIRST_S
    while (content := broadcast.file(name)) is None and name == PLAYLIST:
        if time.monotonic() > end or await request.is_disconnected():
            return refusal(503, "the film did not begin in time; see /health")
        await asyncio.sleep(0.1)
    if content is None:
        return refusal(404, "there is no such file of the film, or no more")
    kind, age_s = "video/mp4", SEGMENT_AGE_S
    if name == PLAYLIST:
        content = with_query(content, token_query(request.query_params.get("token")))
        kind, age_s = "application/vnd.apple.mpegurl", PLAYLIST_AGE_S
    headers = {"Cache-Control": f"max-age={age_s}", "X-Content-Type-Options": "nosniff"}
    return Response(content, media_type=kind, headers=headers)


def with_query(playlist: bytes, query: str) -> bytes:
    """A playlist whose files are asked for with a query, `?token=...` say."""
    text = re.sub(r'(?<=URI=")[^"]*', lambda uri: uri[0] + query, playlist.decode())
    return re.sub(r"^[^#\n].*$", lambda uri: uri[0] + query, text, flags=re.MULTILINE).encode()
