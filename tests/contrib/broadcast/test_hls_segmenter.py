"""The film's segments, as a player finds them."""

from io import BytesIO

import numpy as np
import pytest

from viewmend.contrib.broadcast import FIRST, INIT, KEPT, LISTED, PLAYLIST, FilmSegments
from viewmend.live.video import video_codecs

av = pytest.importorskip("av")
pytestmark = pytest.mark.skipif("h264" not in video_codecs(), reason="PyAV has no x264 here")
FPS = 5


def grey(level, width=64, height=48):
    return np.full((height, width, 3), level, np.uint8)


def listed(film):
    """Lines of the playlist: what it says, and the segments that it names."""
    lines = film.file(PLAYLIST).decode().split()
    return [line for line in lines if line.startswith("#")], [line for line in lines if not line.startswith("#")]


def played(film, names):
    """What a player makes of these segments: times in frames, and pictures."""
    data = film.file(INIT) + b"".join(film.file(name) for name in names)
    with av.open(BytesIO(data)) as container:
        frames = list(container.decode(video=0))
    return [round(float(f.pts * f.time_base) * FPS) for f in frames], [f.to_ndarray(format="rgb24") for f in frames]


def test_each_picture_comes_at_its_time_and_each_second_is_a_segment_of_its_own():
    with FilmSegments((64, 48), FPS) as film:
        for at in range(22):
            film.add(grey(10 * at), at)
        said, names = listed(film)
        assert "#EXT-X-TARGETDURATION:1" in said and "#EXT-X-INDEPENDENT-SEGMENTS" in said
        assert len(names) == 4 and [line for line in said if "EXTINF" in line] == ["#EXTINF:1.000000,"] * 4
        times, pictures = played(film, names)
        assert times == list(range(20))
        assert [round(p.mean() / 10) for p in pictures] == times and pictures[0].shape == (48, 64, 3)
        for n, name in enumerate(names):  # one by one: who joins begins anywhere
            times, pictures = played(film, [name])
            assert len(times) == FPS and abs(pictures[0].mean() - 50 * n) < 4


def test_where_pictures_are_left_out_the_others_keep_their_time():
    with FilmSegments((64, 48), FPS) as film:
        for at in (0, 1, 4, 7, 8, 12, 16, 21, 22):
            film.add(grey(10 * at), at)
        _, names = listed(film)
        times, pictures = played(film, names)
        assert times == [0, 1, 4, 7, 8, 12, 16] and [round(p.mean() / 10) for p in pictures] == times


def test_a_playlist_is_shown_when_it_is_long_enough_and_never_grows_longer():
    with FilmSegments((64, 48), FPS) as film:
        seen, known = 0, []
        for at in range(FPS * (KEPT + 8)):
            film.add(grey(at % 200), at)
            if film.file(PLAYLIST) is None:
                assert at <= FPS * FIRST + 1
                continue
            said, names = listed(film)
            seen += 1
            assert FIRST <= len(names) <= LISTED and all(film.file(name) for name in names)
            assert int(said[3].removeprefix("#EXT-X-MEDIA-SEQUENCE:")) == int(names[0].removesuffix(".m4s"))
            known += [name for name in names if name not in known]
        assert seen and len(known) == KEPT + 7 and known == sorted(known)
        assert sum(film.file(name) is not None for name in known) == KEPT
        assert film.file("../secret") is None


def test_pictures_of_any_size_fill_the_film():
    with FilmSegments((64, 48), FPS) as film:
        for at in range(FPS * FIRST + 2):
            film.add(np.hstack([grey(30, 40 + at, 91), grey(220, 40 + at, 91)]), at)
        _, pictures = played(film, listed(film)[1])
        assert all(p.shape == (48, 64, 3) for p in pictures)
        assert all(p[:, :28].mean() < 45 and p[:, 36:].mean() > 205 for p in pictures)


def test_noise_does_not_make_segments_of_any_size():
    noise = np.random.default_rng(0)
    with FilmSegments((640, 360), 30) as film:
        for at in range(30 * FIRST + 2):
            film.add(noise.integers(0, 255, (360, 640, 3), dtype=np.uint8), at)
        sizes = [len(film.file(name)) for name in listed(film)[1]]
        assert max(sizes) < 2_000_000 and max(sizes[1:]) < 1_200_000
