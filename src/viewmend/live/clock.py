"""The playback clocks: play, pause, seek, speed, and the edge that viewers share."""

from dataclasses import dataclass

from viewmend.live.protocol import ClockChange


@dataclass(frozen=True)
class Span:
    """The times that can be asked for, first to end - 1."""

    first: int = 0
    end: int = 0
    total: int | None = None
    """How many there will be; None for a live rig."""
    fps: float = 0.0
    """Frames a second; 0 where there is a single frame."""
    live: bool = False
    """Frames arrive as they happen. Otherwise they are a recording, which is played in a loop."""

    @property
    def newest(self) -> int:
        """The last time that can be asked for; -1 while there is none."""
        return self.end - 1

    @property
    def complete(self) -> bool:
        """Whether this is a recording with all of its frames."""
        return not self.live and self.end == self.total

    def clamp(self, position: float | int) -> float:
        """The nearest position within."""
        return float(max(self.first, min(max(self.first, self.newest), position)))


class Clock:
    """A position in a span, in frames. Each viewer has one, and the edge of a recording is one."""

    def __init__(self) -> None:
        self.position = 0.0
        self.playing = True
        self.speed = 1.0
        self.live = True

    def advance(self, seconds: float, span: Span, edge: float | None = None) -> None:
        """Move on by `seconds`, or to the `edge` where the clock follows it.

        A recording begins anew one frame after its last. One that is still being generated waits at its end.
        """
        if self.live and edge is not None:
            self.position = edge
            return
        if self.playing:
            self.position += seconds * span.fps * self.speed
        count = span.end - span.first
        if span.complete and count > 0 and self.position >= span.end:
            self.position = span.first + (self.position - span.first) % count
        elif not span.first <= self.position < span.end:
            self.position = span.clamp(self.position)

    def change(self, change: ClockChange, span: Span) -> None:
        """Obey a viewer."""
        if change.seek is not None:
            self.position, self.live = span.clamp(float(change.seek)), False
        if change.speed is not None and not span.live:
            self.speed = change.speed
            self.live = self.live and change.speed == 1
        if change.playing is not None:
            self.playing = change.playing
            self.live = self.live and change.playing
        if change.live:
            self.live, self.playing, self.speed = True, True, 1.0

    def time(self, span: Span) -> int:
        """The index of the frame to show; -1 while there is none."""
        return int(span.clamp(self.position)) if span.end > span.first else -1


def edge_of(span: Span, recording: Clock) -> float:
    """The edge: the newest frame of a live rig, or the position that all who follow a recording share."""
    return float(span.newest) if span.live else recording.position
