"""The page's files, read once: a request can name these and nothing else."""

from dataclasses import dataclass
from pathlib import Path

POLICY = (
    "default-src 'self'; img-src 'self' blob: data:; media-src 'self' blob:; style-src 'self' 'unsafe-inline'; "
    "worker-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "Cache-Control": "no-cache",
}
TYPES = {
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".html": "text/html; charset=utf-8",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}


@dataclass(frozen=True)
class PageFile:
    """A file of the page."""

    content: bytes
    media_type: str


def page_files() -> dict[str, PageFile]:
    """All files of `viewmend/live/page`, by their path in it with slashes."""
    root = Path(__file__).parent / "page"
    paths = [path.relative_to(root) for path in root.rglob("*") if path.is_file()]
    return {
        path.as_posix(): PageFile((root / path).read_bytes(), TYPES.get(path.suffix, "application/octet-stream"))
        for path in paths
        if not any(part.startswith((".", "_")) for part in path.parts)
    }
