"""A short video of a scene: rendered view, all methods, truth, side by side."""

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

from viewmend.capture.video_writer import write_mp4
from viewmend.contact_sheet import Tile, contact_sheet, in_rows
from viewmend.evaluation.cells import Cell, CellStore
from viewmend.evaluation.film import FILM_PX, Picture

FPS = 6.0
"""Slow enough to see flicker."""
COLUMNS = 4
LEAST_FRAMES = 2


def scene_video(cells: Sequence[Cell], store: CellStore) -> tuple[str, bytes] | None:
    """The type and bytes of the video of one scene's cells; None where there are no frames to show.

    MP4 (H.264) with PyAV, else WebM (VP8).
    """
    frames = _frames(cells, store)
    if len(frames) < LEAST_FRAMES:
        return None
    try:
        mp4 = io.BytesIO()
        write_mp4(mp4, frames, FPS)
        return "video/mp4", mp4.getvalue()
    except ImportError:
        webm = _webm(frames)
        return ("video/webm", webm) if webm else None


def _frames(cells: Sequence[Cell], store: CellStore) -> list[Picture]:
    done = [cell for cell in cells if cell.error is None]
    rendered, truth = store.scene_film(done[0]) if done else ([], [])
    films = [("rendered", rendered), *((cell.key.method, store.film(cell)) for cell in done), ("truth", truth)]
    films = [(name, film) for name, film in films if len(film) == len(truth)]
    sheets = []
    for n in range(len(truth)):
        tiles = [Tile(name, film[n]) for name, film in films]
        sheets.append(contact_sheet(in_rows(tiles, COLUMNS), FILM_PX))
    return sheets


def _webm(frames: Sequence[Picture]) -> bytes:
    """A video by OpenCV, which can write no H.264; empty where it has no VP8 either."""
    import cv2

    height, width = (size // 2 * 2 for size in frames[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.webm"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), FPS, (width, height))
        for frame in frames:
            writer.write(cv2.cvtColor(frame[:height, :width], cv2.COLOR_RGB2BGR))
        writer.release()
        return path.read_bytes() if path.is_file() else b""
