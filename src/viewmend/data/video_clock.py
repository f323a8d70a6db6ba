"""One clock for all videos of a capture: which frames of the videos show the same time."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int

from viewmend.data.errors import CaptureError, Issue
from viewmend.data.videos import video_properties

ABSENT = -1
"""This index stands for the missing frame of a video that has none at a time."""
TOLERANCE = 0.5
"""A frame belongs to a time that is at most this many frame periods from it."""
NEW_TIME = 0.75
"""A frame adds a time of its own if it is more than this many frame periods from all others."""
GAP = 1.5
"""Frames are missing where the interval is this many periods."""
SAME_PHASE = 0.5
"""Frames keep a constant distance from the times if the mean of their unit phasors is at least this long."""
RATE_TOLERANCE = 0.02
"""Rates are equal if they differ by less than this share."""
NOTEWORTHY = 0.05
"""Videos that differ in length by a smaller share are not mentioned."""
MAX_NAMED = 3
"""Issues name at most this many cameras."""
DAY_S = 86400.0
"""Timecodes start again after a day, seconds."""

TrackKind = Literal["images", "masks"]


@dataclass(frozen=True)
class Timecode:
    """A recorder's clock, which counts frames."""

    frames: int
    """Frames since midnight."""
    rate: int
    """Frames in a second of the count, such as 30 for videos of 29.97 frames per second."""


@dataclass(frozen=True)
class Track:
    """When the frames of a video, or a camera's numbered images, were taken."""

    camera: str
    kind: TrackKind
    times_s: Float64[np.ndarray, "frame"]
    """Increasing, by the video's own clock."""
    fps: float | None
    """Frames per second, gaps aside; None for a single frame."""
    offset_s: float = 0.0
    """How far the camera's clock is ahead of the others'."""
    is_timed: bool = True
    """Whether the video stores its times; if not, they follow from an assumed rate."""
    timecode: Timecode | None = None
    """The recorder's clock at the video's time 0; None if the video has no timecode."""

    @property
    def gaps(self) -> list[tuple[float, int]]:
        """Where frames are missing: the time at which the first should be, in seconds, and their number."""
        if self.fps is None:
            return []
        steps = np.diff(self.times_s) * self.fps
        return [
            (float(self.times_s[at]) + 1 / self.fps, round(float(steps[at])) - 1)
            for at in np.flatnonzero(steps > GAP).tolist()
        ]


def video_track(camera: str, kind: TrackKind, path: Path, offset_s: float = 0.0) -> Track:
    """The track of a video; CaptureError if it cannot be decoded."""
    try:
        video = video_properties(path)
    except CaptureError as error:
        raise CaptureError(f"{path}: camera '{camera}': {str(error).removeprefix(f'{path}: ')}") from None
    timecode = None
    if video.timecode is not None and video.fps is not None:
        timecode = parse_timecode(video.timecode, video.fps)
    return Track(camera, kind, np.array(video.times_s), video.fps, offset_s, video.is_timed, timecode)


def parse_timecode(text: str, fps: float) -> Timecode | None:
    """Parse the timecode of a video: HH:MM:SS:FF, or HH:MM:SS;FF in drop-frame counting; None for other text."""
    parts = re.fullmatch(r"(\d+):(\d+):(\d+)([:;.,])(\d+)", text.strip())
    if parts is None:
        return None
    hours, minutes, seconds, frames = (int(parts[group]) for group in (1, 2, 3, 5))
    rate = round(fps)
    minutes += 60 * hours
    count = (60 * minutes + seconds) * rate + frames
    if parts[4] != ":":  # two numbers of each minute are skipped, except in every tenth minute
        count -= 2 * round(rate / 30) * (minutes - minutes // 10)
    return Timecode(count, rate)


@dataclass(frozen=True)
class VideoClock:
    """The times of a capture, and the frame of each video at each of them."""

    tracks: tuple[Track, ...]
    """The videos; offsets are already subtracted from their times."""
    reference_fps: float | None
    """Frames per second of the video that sets the times; at least half of the cameras are as fast."""
    times_s: Float64[np.ndarray, "time"]
    """When two cameras or more have all of their frames."""
    end: int
    """How many of the times lie before the end of the shortest video."""
    frames: Mapping[tuple[str, TrackKind], Int[np.ndarray, "time"]]
    """Index of each video's frame at each time; `ABSENT` without one."""
    moved: frozenset[tuple[str, TrackKind]]
    """Videos that had no time in common with the others, and were moved to start together with them."""
    by_index: frozenset[str]
    """Cameras whose masks have other times, but as many frames as their images, and were matched
    one to one."""
    timecode_note: str | None = None
    """A note if the videos start at different timecodes: how different, and whether they were used."""

    @property
    def fps(self) -> float | None:
        """Mean number of times per second; None for a single time."""
        times = self.times_s[: self.end]
        if len(times) < 2:
            return None
        mean = (len(times) - 1) / float(times[-1] - times[0])
        rate = self.reference_fps
        return rate if rate is not None and abs(mean / rate - 1) < RATE_TOLERANCE else round(mean, 3)

    def describe(self, camera: str) -> list[dict[str, Any]]:
        """Rate, length, gaps and offset of each of a camera's videos, for `viewmend check`."""
        return [
            {
                "kind": track.kind,
                "frames": len(track.times_s),
                "fps": track.fps,
                "start_s": _extent([track])[0],
                "end_s": _extent([track])[1],
                "gaps": track.gaps,
                "offset_ms": 1000 * track.offset_s,
            }
            for track in self.tracks
            if track.camera == camera
        ]

    def issues(self, cameras: Sequence[str]) -> tuple[Issue, ...]:
        """Faults of the times of these cameras' videos; one issue for all cameras with the same fault."""
        faults: dict[str, list[str]] = {}
        for track in self.tracks:
            if track.camera in cameras:
                for fault in self._faults(track):
                    faults.setdefault(fault, []).append(track.camera)
        found = tuple(Issue(fault.format(_named(names))) for fault, names in faults.items())
        return found if self.timecode_note is None else (Issue(self.timecode_note), *found)

    def _faults(self, track: Track) -> list[str]:
        """The faults of a video, with {} for the camera."""
        images = [other for other in self.tracks if other.kind == "images"]
        rate = self.reference_fps or 1.0
        subject = f"the {track.kind} of {{}}"
        others = "the others'"
        faults = []
        if track.kind == "masks":
            images = [other for other in images if other.camera == track.camera]
            others = "the images'"
            if track.camera in self.by_index:
                return [
                    f"{subject} have other times than the images, but as many frames; they are matched one to one"
                ]
            if np.array_equal(track.times_s, images[0].times_s):
                return []
        if track.kind == "images" and not track.is_timed:
            faults.append(
                f"{subject} have no times in their files; they are matched by index at {own_fps(track):.4g} fps"
            )
        if (track.camera, track.kind) in self.moved:
            faults.append(f"{subject} have no time in common with {others}; they are taken to start together")
        own_rate = track.fps or rate
        fastest = rate * (1 + RATE_TOLERANCE)
        text = f"{subject} have {own_rate:.4g} frames per second, not {others} {rate:.4g}; they are matched by time"
        if own_rate < rate * (1 - RATE_TOLERANCE):
            faults.append(f"{text}, and the camera is absent in between")
        if (
            track.kind == "images"
            and own_rate > fastest
            and sum((other.fps or 0) > fastest for other in images) > 1
        ):
            faults.append(
                f"{text}, and their frames in between are not used; leave out the slow cameras to use them"
            )
        if track.gaps:
            lost = sum(count for _, count in track.gaps)
            from_s = track.gaps[0][0]
            text = f"{subject} lack {lost} frame{'s' if lost > 1 else ''} from {from_s:.2f} s on"
            faults.append(f"{text}, by the video's own times; the camera is absent there")
        start_s, end_s = _extent(images)
        late_s = float(track.times_s[0]) - start_s
        early_s = end_s - _extent([track])[1]
        least_s = max(NOTEWORTHY * (end_s - start_s), NEW_TIME / rate)
        if late_s > least_s:
            faults.append(f"{subject} start {late_s:.2f} s after {others}; the camera is absent until then")
        if early_s > least_s:
            consequence = "from there on the camera is absent, or the capture ends"
            faults.append(f"{subject} end {early_s:.2f} s before {others}; {consequence}")
        return faults


def own_fps(track: Track) -> float:
    """Frames per second by the times of a track; 1 for a single frame."""
    return track.fps or 1.0


def _extent(tracks: Sequence[Track]) -> tuple[float, float]:
    """The start of the first of these tracks and the end of the last one, seconds."""
    ends = [float(track.times_s[-1]) + (1 / track.fps if track.fps else 0.0) for track in tracks]
    return min(float(track.times_s[0]) for track in tracks), max(ends)


def _named(cameras: list[str]) -> str:
    names = ", ".join(f"'{name}'" for name in cameras[:MAX_NAMED])
    more = f" and {len(cameras) - MAX_NAMED} more" if len(cameras) > MAX_NAMED else ""
    return f"camera{'s' if len(cameras) > 1 else ''} {names}{more}"


def match_tracks(tracks: Sequence[Track]) -> VideoClock:
    """Match videos by time. One video sets the times, with a rate that at least half of the cameras reach.

    Other videos fill its gaps. Videos of the same rate at a constant distance of less than a frame
    are matched one to one, and so are masks with as many frames as their images. ValueError if no
    two cameras share a time.
    """
    tracks = [replace(track, times_s=track.times_s - track.offset_s) for track in _with_known_rates(tracks)]
    tracks, timecode_note = _by_timecode(tracks)
    images = {track.camera: track for track in tracks if track.kind == "images"}
    reference = _choose_reference(images.values())
    period_s = 1 / (reference.fps or 1.0)
    tracks, moved, by_index = _overlap(tracks, images, reference)
    aligned = [track.times_s - _phase_s(track.times_s, reference.times_s, period_s) for track in tracks]
    times = _fill_gaps(reference.times_s, tracks, aligned, period_s)
    found: dict[tuple[str, TrackKind], np.ndarray] = {}
    for track, own in zip(tracks, aligned, strict=True):
        index = _nearest(own, times)
        is_near = np.abs(own[index] - times) <= TOLERANCE * period_s + 1e-6
        found[track.camera, track.kind] = np.where(is_near, index, ABSENT)

    # Keep the times at which two cameras or more have all of their frames
    complete = [
        np.min([found[key] for key in found if key[0] == camera], axis=0) != ABSENT for camera in images
    ]
    kept = np.sum(complete, axis=0) >= min(2, len(images))
    if not kept.any():
        raise ValueError(
            "expected at least two videos that overlap in time, got none; check their times and offset_ms"
        )
    times = times[kept]
    frames = {key: index[kept] for key, index in found.items()}
    end_s = min(
        own[-1] + 1 / (track.fps or reference.fps or 1.0) for track, own in zip(tracks, aligned, strict=True)
    )
    end = max(1, int((times < end_s - TOLERANCE * period_s).sum()))
    return VideoClock(tuple(tracks), reference.fps, times, end, frames, moved, by_index, timecode_note)


def _choose_reference(images: Collection[Track]) -> Track:
    """The longest video of the highest rate that at least half of the cameras reach."""
    order = sorted(images, key=lambda track: (round(track.fps or 0.0, 1), len(track.times_s)), reverse=True)
    rate = round(order[len(order) // 2].fps or 0.0, 1)
    return next(track for track in order if round(track.fps or 0.0, 1) == rate)


def _overlap(
    tracks: Sequence[Track], images: Mapping[str, Track], reference: Track
) -> tuple[list[Track], frozenset[tuple[str, TrackKind]], frozenset[str]]:
    """Move videos that have no time in common with the others, to start with them; masks follow their images.

    Returns the videos, those that were moved, and the cameras whose masks were matched to the images
    one to one.
    """
    period_s = 1 / (reference.fps or 1.0)
    images = dict(images)
    overlapping = list(tracks)
    moved: set[tuple[str, TrackKind]] = set()
    by_index = set()
    for number, track in enumerate(tracks):
        peer = reference if track.kind == "images" else images[track.camera]
        early_s = peer.times_s[0] - track.times_s[-1]
        late_s = track.times_s[0] - peer.times_s[-1]
        if track.kind == "masks" and len(track.times_s) == len(peer.times_s):
            if np.abs(np.diff(track.times_s - peer.times_s)).max(initial=0.0) > TOLERANCE * period_s:
                by_index.add(track.camera)
            overlapping[number] = replace(track, times_s=peer.times_s)
        elif max(early_s, late_s) > period_s:
            moved.add((track.camera, track.kind))
            shift_s = float(peer.times_s[0] - track.times_s[0])
            overlapping[number] = replace(track, times_s=track.times_s + shift_s)
        if track.kind == "images":
            images[track.camera] = overlapping[number]
    return overlapping, frozenset(moved), frozenset(by_index)


def _fill_gaps(
    times_s: Float64[np.ndarray, "time"],
    tracks: Sequence[Track],
    aligned: Sequence[Float64[np.ndarray, "_frame"]],
    period_s: float,
) -> Float64[np.ndarray, "new_time"]:
    """Add the times of images that are far from all times so far; `aligned` are the videos' times."""
    for track, own in zip(tracks, aligned, strict=True):
        if track.kind == "images":
            far = np.abs(own - times_s[_nearest(times_s, own)]) > NEW_TIME * period_s
            times_s = np.sort(np.concatenate([times_s, own[far]]))
    return times_s


def _with_known_rates(tracks: Sequence[Track]) -> list[Track]:
    """The tracks; those without times get the usual rate of the images that have times, if there are any."""
    rates = [track.fps for track in tracks if track.is_timed and track.kind == "images" and track.fps]
    if not rates:
        return list(tracks)
    usual = float(np.median(rates))
    return [
        track if track.is_timed else replace(track, fps=usual, times_s=np.arange(len(track.times_s)) / usual)
        for track in tracks
    ]


def _by_timecode(tracks: list[Track]) -> tuple[list[Track], str | None]:
    """The tracks at the times of their recorders' clocks, and what was found; unchanged if these do not fit together.

    All videos of images need a timecode, and there has to be a time at which all of them run.
    """
    image_tracks = [track for track in tracks if track.kind == "images"]
    clocks_s = _clocks_s(tracks)
    starts = {name: start_s for (name, kind), start_s in clocks_s.items() if kind == "images"}
    if len(starts) < 2:
        return tracks, None
    latest = max(starts.values())
    starts = {name: start + DAY_S if latest - start > DAY_S / 2 else start for name, start in starts.items()}
    first = min(starts, key=starts.__getitem__)
    last = max(starts, key=starts.__getitem__)
    apart_s = starts[last] - starts[first]
    if apart_s * max(track.fps or 1.0 for track in image_tracks) < TOLERANCE:
        return tracks, None
    differ = f"the videos' timecodes start up to {apart_s:.2f} s apart (first '{first}', last '{last}')"
    without = [track.camera for track in image_tracks if track.camera not in starts]
    if without:
        return (
            tracks,
            f"{differ}, but {_named(without)} has none; videos are taken to start together, see offset_ms",
        )
    shift = {name: start - starts[first] for name, start in starts.items()}
    ends = [float(track.times_s[-1]) + shift[track.camera] for track in image_tracks]
    if min(ends) < max(float(track.times_s[0]) + shift[track.camera] for track in image_tracks):
        return tracks, f"{differ}, and there is no time at which all run; videos are taken to start together"
    moved = []
    for track in tracks:
        from_s = shift[track.camera]
        own_s = clocks_s.get((track.camera, track.kind))
        if own_s is not None:  # of masks, which may start later than the images, and after midnight
            late_s = own_s - clocks_s[track.camera, "images"]
            from_s += (late_s + DAY_S / 2) % DAY_S - DAY_S / 2
        moved.append(replace(track, times_s=track.times_s + from_s))
    remove = "ffmpeg -i IN -map 0:v -c copy -write_tmcd 0 OUT"
    return (
        moved,
        f"{differ}; they are matched by timecode; if they were cut to start together, remove it ({remove})",
    )


def _clocks_s(tracks: Sequence[Track]) -> dict[tuple[str, TrackKind], float]:
    """The clock of each video with a timecode at its time 0, seconds since midnight.

    Videos that count alike run at one rate: the smallest difference of measured rates would
    add up to seconds over the hours since midnight.
    """
    rates: dict[int, list[float]] = {}
    for track in tracks:
        if track.timecode is not None and track.fps:
            rates.setdefault(track.timecode.rate, []).append(track.fps)
    return {
        (track.camera, track.kind): track.timecode.frames / float(np.median(rates[track.timecode.rate]))
        for track in tracks
        if track.timecode is not None and track.timecode.rate in rates
    }


def _nearest(
    times: Float64[np.ndarray, "time"], wanted: Float64[np.ndarray, "frame"]
) -> Int[np.ndarray, "frame"]:
    """Index of the time nearest to each wanted one."""
    return np.searchsorted((times[1:] + times[:-1]) / 2, wanted)


def _phase_s(own: Float64[np.ndarray, "frame"], times: Float64[np.ndarray, "time"], period_s: float) -> float:
    """The distance of a video's frames from the times, if constant and below half a period; 0 otherwise."""
    distances = own - times[_nearest(times, own)]
    mean = np.exp(2j * np.pi * distances[np.abs(distances) < period_s] / period_s)
    if not len(mean) or abs(mean.mean()) < SAME_PHASE:
        return 0.0
    return float(np.angle(mean.mean())) / (2 * np.pi) * period_s
