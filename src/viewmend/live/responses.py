"""HTTP responses and their content: the page's files, error messages, request bodies and metrics."""

import asyncio
from collections.abc import Mapping
from pathlib import Path

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from viewmend.live.assets import Asset
from viewmend.live.protocol import ProtocolError
from viewmend.live.registry import SessionRegistry
from viewmend.utils.heap import resident_bytes

MAX_BODY_BYTES = 1_000_000
"""Size of the largest request body, in bytes."""
BODY_S = 10.0
"""Seconds within which a request's body has to arrive."""
MAX_AGE_S = 31_536_000
"""Seconds for which assets that never change may be cached."""
POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; media-src 'self' blob:; style-src 'self' 'unsafe-inline'; "
    "worker-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address may contain the token
    "Cache-Control": "no-cache",
}
MEDIA_TYPES = {
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}


def page_files() -> dict[str, Asset]:
    """All files of `viewmend/live/page` by their relative path, read once: requests can name no other file."""
    root = Path(__file__).parent / "page"
    paths = [path.relative_to(root) for path in root.rglob("*") if path.is_file()]
    return {
        path.as_posix(): Asset(
            (root / path).read_bytes(), MEDIA_TYPES.get(path.suffix, "application/octet-stream")
        )
        for path in paths
        if not any(part.startswith((".", "_")) for part in path.parts)
    }


def error_response(status: int, message: str) -> Response:
    """An error message as JSON."""
    return JSONResponse({"error": message}, status, headers={"Cache-Control": "no-store"})


def asset_response(request: Request, asset: Asset, is_final: bool) -> Response:
    """An asset with its cache headers, or 304 if the client has it; final ones never change under their address."""
    # The address alone is not enough if the token is in a header
    scope = "private" if "authorization" in request.headers else "public"
    cache = f"{scope}, max-age={MAX_AGE_S}, immutable" if is_final else f"{scope}, no-cache"
    headers = {"ETag": asset.etag, "Cache-Control": cache, "X-Content-Type-Options": "nosniff"}
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    if asset.etag in known or "*" in known:
        return Response(status_code=304, headers=headers)
    return Response(asset.content, media_type=asset.media_type, headers=headers)


async def read_body(request: Request) -> bytearray | None:
    """The body of a request; None if it is too large, ProtocolError if it is incomplete or does not arrive in time."""
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > MAX_BODY_BYTES:
                    return None
    except TimeoutError:
        raise ProtocolError(f"expected the whole body within {BODY_S:g} s; send it faster") from None
    except ClientDisconnect:
        raise ProtocolError("expected the whole body, got a part of it") from None
    return body


def metrics_text(registry: SessionRegistry) -> str:
    """All counters and gauges in the text format of Prometheus."""
    service = registry.service
    source = service.source
    counts = service.counts
    available = source.span.end - source.span.first
    ready = int(service.is_ready and source.status.state == "ready")
    dropped = sum(session.dropped for session in list(registry.sessions))
    stages = {label(stage=stage): ms / 1000 for stage, ms in vars(service.times).items() if stage != "wait"}
    lines = [
        *metric("viewmend_up", "gauge", "1 while views can be rendered.", ready),
        *metric("viewmend_viewers", "gauge", "Connected viewers.", len(registry.sessions)),
        *metric("viewmend_frames_total", "counter", "Rendered views.", counts["frames"]),
        *metric(
            "viewmend_shared_total", "counter", "Views of a frame with known geometry.", counts["shared"]
        ),
        *metric(
            "viewmend_dropped",
            "gauge",
            "Looks of present viewers replaced before they were rendered.",
            dropped,
        ),
        *metric(
            "viewmend_cancelled_total", "counter", "Views that were not needed any more.", counts["cancelled"]
        ),
        *metric("viewmend_errors_total", "counter", "Views that failed.", counts["errors"]),
        *metric("viewmend_source_frames", "gauge", "Frames that can be requested.", available),
        *metric("viewmend_stage_seconds_total", "counter", "Seconds spent in each stage.", stages),
    ]
    for extension in registry.extensions:
        lines += extension.metrics()
    cameras = source.camera_counts()
    if cameras:
        up = {label(camera=name): counts["up"] for name, counts in cameras.items()}
        images = {
            label(camera=name, event=event): count
            for name, counts in cameras.items()
            for event, count in counts.items()
            if event != "up"
        }
        lines += metric("viewmend_camera_up", "gauge", "1 while the camera delivers images.", up)
        lines += metric(
            "viewmend_camera_pictures_total", "counter", "Images of each camera by event.", images
        )
    spread_ms = source.spread_ms
    if spread_ms is not None:
        text = "Time between the first and the last image of the newest frame."
        lines += metric("viewmend_cameras_apart_seconds", "gauge", text, spread_ms / 1000)
    resident = resident_bytes()
    if resident is not None:
        lines += metric("process_resident_memory_bytes", "gauge", "Resident memory size in bytes.", resident)
    return "\n".join(lines) + "\n"


def label(**labels: str) -> str:
    """Labels in Prometheus' form."""
    escaped = ((key, value.replace("\\", "\\\\").replace('"', '\\"')) for key, value in labels.items())
    return "{" + ",".join(f'{key}="{value!s}"' for key, value in escaped).replace("\n", "\\n") + "}"


def metric(name: str, kind: str, text: str, values: Mapping[str, float | int] | float | int) -> list[str]:
    """The lines of a metric: one value, or values by `label`."""
    by_label = values if isinstance(values, Mapping) else {"": values}
    rows = [f"{name}{labels} {value!r}" for labels, value in by_label.items()]
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}", *rows]
