"""Simulated cameras for live_sources.py: studio videos, each sent by a process of its own in real time.

Every image carries its frame number in its upper rows, in levels too close together to affect the mask, so a receiver
can tell when it was taken. `python research/live_senders.py KIND VIDEO PORT EPOCH PHASE PPM` runs one camera.
"""

import argparse
import io
import signal
import socketserver
import sys
import time
from collections.abc import Iterator
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import av
import cv2
import numpy as np

from viewmend.data.images import write_image
from viewmend.data.native_writer import write_capture
from viewmend.data.source import CaptureSubset
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.utils.srgb import srgb_from_linear

SIZE_PX, FPS, FRAMES, KEY_EVERY = (512, 612), 15, 30, 15
BLOCK_PX, BITS, LEVELS = 16, 6, 5
TICKS = Fraction(1, 90_000)


def make(folder: Path, cameras: int) -> None:
    """Write videos, clean plates and the calibration of a studio rig."""
    if (folder / "calibration").exists():
        return
    config = StudioConfig(
        seed=10021, cameras=cameras, frames=FRAMES, size_px=SIZE_PX, background="stage", fps=float(FPS)
    )
    studio = Studio(config)
    backdrop = studio.backdrop()
    assert backdrop is not None
    plates = (255 * srgb_from_linear(backdrop)).round().byte().permute(0, 2, 3, 1).numpy()
    for name, plate in zip(studio.cameras.names, plates, strict=True):
        write_image(folder / f"plates/{name}.png", plate)
    videos = [_video(folder / f"{name}.mp4") for name in studio.cameras.names]
    for time_index in range(FRAMES):
        frame = studio.read(time_index)
        for view, (container, stream) in enumerate(videos):
            rgb = np.ascontiguousarray(frame.rgb[view].permute(1, 2, 0).numpy())
            picture = av.VideoFrame.from_ndarray(numbered(rgb, plates[view], time_index), format="rgb24")
            picture.pts = time_index
            container.mux(stream.encode(picture))
    for container, stream in videos:
        container.mux(stream.encode())
        container.close()
    write_capture(CaptureSubset(studio, range(1)), folder / "calibration")


def _video(path: Path):
    container = av.open(str(path), "w")
    options = {"crf": "14", "bf": "0", "g": str(KEY_EVERY), "sc_threshold": "0", "tune": "zerolatency"}
    stream = container.add_stream("libx264", rate=FPS, options=options)
    stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
    stream.codec_context.time_base = Fraction(1, FPS)
    return container, stream


def numbered(rgb: np.ndarray, plate: np.ndarray, number: int) -> np.ndarray:
    """Encode a number in blocks of the upper rows that are slightly brighter or darker than the plate."""
    for bit in range(BITS):
        columns = slice(bit * BLOCK_PX, (bit + 1) * BLOCK_PX)
        level = plate[:BLOCK_PX, columns].astype(int) + (LEVELS if number >> bit & 1 else -LEVELS)
        rgb[:BLOCK_PX, columns] = level.clip(0, 255)
    return rgb


def number_of(rgb: np.ndarray, plate: np.ndarray) -> int:
    """Decode the number of an image."""
    brighter = rgb[:BLOCK_PX, : BITS * BLOCK_PX].astype(float) - plate[:BLOCK_PX, : BITS * BLOCK_PX]
    blocks = brighter.reshape(BLOCK_PX, BITS, BLOCK_PX, 3).mean((0, 2, 3))
    return sum(int(level > 0) << bit for bit, level in enumerate(blocks))


def packets(path: str, epoch_s: float, phase_s: float) -> Iterator[tuple[av.Packet, float]]:
    """Yield packets of a looped video in real time, from the next key frame on, with the time each image was taken."""
    with av.open(path) as container:
        stored = [packet for packet in container.demux(video=0) if packet.size]
    passed_s = time.monotonic() - epoch_s - phase_s
    n = (int(passed_s * FPS) // KEY_EVERY + 1) * KEY_EVERY
    while True:
        taken_s = epoch_s + phase_s + n / FPS
        time.sleep(max(0.0, taken_s - time.monotonic()))
        yield stored[n % FRAMES], taken_s
        n += 1


def send_packets(
    out, path: str, epoch_s: float, phase_s: float, ppm: float, format_name: str, options: dict
) -> None:
    """Mux the packets. The sender's clock has an arbitrary start and is off by `ppm` millionths."""
    with av.open(path) as video, av.open(out, "w", format=format_name, options=options) as container:
        stream = container.add_stream_from_template(video.streams.video[0])
        for packet, taken_s in packets(path, epoch_s, phase_s):
            own_s = (taken_s - epoch_s) * (1 + 1e-6 * ppm)
            fresh = av.Packet(bytes(packet))
            fresh.stream, fresh.time_base = stream, TICKS
            fresh.pts = fresh.dts = round(own_s / TICKS)
            fresh.is_keyframe = packet.is_keyframe
            container.mux(fresh)
            report_first()


def report_first(_state: list[int] = []) -> None:  # noqa: B006
    """Print the time of the first image, once."""
    if not _state:
        _state.append(1)
        print(f"{time.monotonic()}", flush=True)


TS = {"flush_packets": "1"}


def serve_http(kind: str, path: str, port: int, epoch_s: float, phase_s: float, ppm: float) -> None:
    """Serve MPEG-TS or multipart JPEG."""
    jpegs: list[bytes] = []
    if kind == "mjpeg":
        with av.open(path) as container:
            for frame in container.decode(video=0):
                bgr = frame.to_ndarray(format="bgr24")
                jpegs.append(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes())

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header(
                "Content-Type", "video/mp2t" if kind == "http" else "multipart/x-mixed-replace; boundary=b"
            )
            self.end_headers()
            try:
                self._send()
            except (OSError, av.FFmpegError):
                return

        def _send(self) -> None:
            if kind == "http":
                send_packets(_Pipe(self.wfile), path, epoch_s, phase_s, ppm, "mpegts", TS)
            for n, _ in enumerate_packets(path, epoch_s, phase_s):
                jpeg = jpegs[n % FRAMES]
                head = f"--b\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                report_first()

        def log_message(self, *_: object) -> None:
            pass

    ThreadingHTTPServer.allow_reuse_address = True
    socketserver.TCPServer.allow_reuse_address = True
    ThreadingHTTPServer(("127.0.0.1", port), Handler).serve_forever()


def enumerate_packets(path: str, epoch_s: float, phase_s: float) -> Iterator[tuple[int, float]]:
    """Yield image numbers in real time."""
    for _, taken_s in packets(path, epoch_s, phase_s):
        yield round((taken_s - epoch_s - phase_s) * FPS), taken_s


class _Pipe(io.RawIOBase):
    """A non-seekable file for PyAV."""

    def __init__(self, file) -> None:
        self._file = file

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self._file.write(data)
        self._file.flush()
        return len(data)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=("udp", "rtsp", "http", "mjpeg"), help="how the video is sent")
    parser.add_argument("video", help="the camera's file")
    parser.add_argument("port", type=int, help="port on this machine")
    parser.add_argument(
        "epoch", type=float, help="when the first image is sent: seconds of the monotonic clock"
    )
    parser.add_argument("phase", type=float, help="seconds by which this camera is late")
    parser.add_argument("ppm", type=float, help="parts per million by which this camera's clock is fast")
    options = parser.parse_args()
    kind, path, port = options.kind, options.video, options.port
    epoch_s, phase_s, ppm = options.epoch, options.phase, options.ppm
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if kind in ("http", "mjpeg"):
        serve_http(kind, path, port, epoch_s, phase_s, ppm)
    while True:
        try:
            if kind == "udp":
                url = f"udp://127.0.0.1:{port}?pkt_size=1316"
                send_packets(url, path, epoch_s, phase_s, ppm, "mpegts", TS)
            else:
                url = f"rtsp://127.0.0.1:{port}/live"
                send_packets(url, path, epoch_s, phase_s, ppm, "rtsp", {"rtsp_transport": "tcp"})
        except (OSError, av.FFmpegError):  # no receiver
            time.sleep(0.05)


if __name__ == "__main__":
    main()
