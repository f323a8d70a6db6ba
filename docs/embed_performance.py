"""Puts the published performance on the front page of the site, if `make performance` has made one.

mkdocs calls `on_page_markdown` and `on_post_build` (mkdocs.yml, `hooks`).
"""

import shutil
from pathlib import Path
from typing import Any

PERFORMANCE = Path(__file__).resolve().parents[1] / "out/performance"
"""The folder that `make performance` writes."""
FRONT_PAGE = "index.md"
"""The page that shows the performance."""
FRAME = (
    '<iframe src="performance/index.html" title="A synthetic performer" loading="lazy" '
    'allow="fullscreen; clipboard-write" '
    'style="width: 100%; aspect-ratio: 16 / 10; min-height: 360px; border: 0; border-radius: 8px">'
    "</iframe>\n\n"
    "Drag to turn around the performer; [Publish a performance](guide/publish.md) says how this page was made."
)
"""The markdown of the performance."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The front page with the performance before its first picture."""
    if page.file.src_uri != FRONT_PAGE or not PERFORMANCE.is_dir():
        return markdown
    return markdown.replace("![", f"{FRAME}\n\n![", 1)


def on_post_build(config: Any, **_: Any) -> None:
    """Copy the performance into the site."""
    if PERFORMANCE.is_dir():
        target = Path(config.site_dir) / "performance"
        shutil.copytree(PERFORMANCE, target, ignore=shutil.ignore_patterns(".*"), dirs_exist_ok=True)
