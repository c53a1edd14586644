"""Films on disk that are damaged, joined, or hold more than a picture and sound."""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from facerelight.photo.film.times import Times
from facerelight.photo.film.track import Picture
from facerelight.photo.film.video import convert_film

av = pytest.importorskip("av", reason="the extra video is not installed")

FRAMES, RATE = 6, 10
CHAPTERS = [
    {"id": k, "start": start, "end": end, "time_base": Fraction(1, 1000), "metadata": {"title": title}}
    for k, (start, end, title) in enumerate(((0, 300, "one"), (300, 600, "two")))
]


def written(path: Path) -> Path:
    """Ever brighter pictures, and a tone."""
    with av.open(str(path), "w") as film:
        video, sound = film.add_stream("libx264", rate=RATE), film.add_stream("aac", rate=44100)
        video.width, video.height, video.pix_fmt = 64, 64, "yuv420p"
        for k in range(FRAMES):
            film.mux(video.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), 40 + 30 * k, np.uint8))))
        tone = np.sin(np.arange(44100 * FRAMES // RATE) / 16)[None].astype(np.float32)
        heard = av.AudioFrame.from_ndarray(tone, format="fltp", layout="mono")
        heard.sample_rate = 44100
        for packet in (*sound.encode(heard), *sound.encode(None), *video.encode(None)):
            film.mux(packet)
    return path


def with_more(path: Path) -> Path:
    """A film with chapters and a second picture."""
    with av.open(str(path), "w") as film:
        pictures = [film.add_stream("libx264", rate=RATE) for _ in range(2)]
        for video in pictures:
            video.width, video.height, video.pix_fmt = 64, 64, "yuv420p"
        film.set_chapters(CHAPTERS)
        for k in range(FRAMES):
            for video in pictures:
                film.mux(video.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), 40 + 30 * k, np.uint8))))
        for video in pictures:
            film.mux(video.encode(None))
    return path


def as_it_is(pictures: Iterator[Picture]) -> Iterable[Picture]:
    return pictures


@pytest.mark.parametrize(
    ("raised", "kind", "said"),
    [
        (av.error.InvalidDataError(1094995529, "damaged"), ValueError, "out.mp4: could not be written: .*damaged"),
        (av.error.ArgumentError(22, "no such time"), ValueError, "out.mp4: could not be written: .*no such time"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no text"), ValueError, "in.mp4: .*no text"),
        (RuntimeError("no memory"), RuntimeError, "in.mp4: no memory"),
    ],
)
def test_errors_on_the_way_name_the_film(tmp_path: Path, raised: Exception, kind: type[Exception], said: str) -> None:
    def failing(_: Iterator[Picture]) -> Iterator[Picture]:
        raise raised
        yield

    with pytest.raises(kind, match=said) as caught:
        convert_film(written(tmp_path / "in.mp4"), tmp_path / "out.mp4", failing)
    assert type(caught.value) is kind
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


def test_joined_recordings_are_written_one_behind_the_other(tmp_path: Path) -> None:
    part = written(tmp_path / "part.ts").read_bytes()
    (tmp_path / "in.ts").write_bytes(part * 3)
    seen: list[float] = []

    def watched(pictures: Iterator[Picture]) -> Iterator[Picture]:
        for picture in pictures:
            seen.append(picture.time)
            yield picture

    lost = convert_film(tmp_path / "in.ts", tmp_path / "out.mp4", watched)
    assert lost == ["the film's times go back after 0.5 s: what follows is put behind it"]
    with av.open(str(tmp_path / "out.mp4")) as film:
        frames = list(film.decode(video=0))
    with av.open(str(tmp_path / "out.mp4")) as film:
        heard = [float(packet.pts * packet.time_base) for packet in film.demux(audio=0) if packet.size]
    times = [float(frame.time) for frame in frames]
    assert len(times) == 3 * FRAMES
    assert min(np.diff(times)) > 0
    assert max(np.diff(times)) < 2.5 / RATE
    assert min(np.diff(heard)) > 0
    assert seen == pytest.approx([time - times[0] for time in times], abs=1e-3)
    bright = np.array([frame.to_ndarray(format="gray").mean() for frame in frames]).reshape(3, FRAMES)
    assert np.diff(bright).min() > 20  # nothing has changed places
    sound = np.array(heard).reshape(3, -1)[:, 0] - np.array(times).reshape(3, -1)[:, 0]
    assert sound == pytest.approx(np.full(3, sound[0]), abs=0.03)  # sound stays with its pictures


def test_times_without_a_fault_stay_and_single_faults_move_nothing_else() -> None:
    rng = np.random.default_rng(0)
    given = np.cumsum(rng.integers(1, 9, 50)).tolist()
    times = Times(Fraction(1, 1000), [])
    assert [times(one) for one in given] == given
    assert times.back is None
    assert [times(one) for one in (given[-1], given[-1] - 3, given[-1] + 9)] == [given[-1] + k for k in (1, 2, 9)]
    assert times(None) == given[-1] + 16  # what is due
    together = Times(Fraction(1), [], least=0)
    assert [together(one) for one in (5, 5, 7)] == [5, 5, 7]
    assert together.back is None


@pytest.mark.parametrize("names", [("in.mp4", "out.mp4"), ("in.mkv", "out.mkv"), ("in.mp4", "out.mov")])
def test_chapters_are_kept_and_it_is_said_what_is_left_out(tmp_path: Path, names: tuple[str, str]) -> None:
    source, output = (tmp_path / name for name in names)
    assert convert_film(with_more(source), output, as_it_is) == ["stream 1 (picture) is left out"]
    with av.open(str(output)) as film:
        kept = [
            (float(one["start"] * one["time_base"]), float(one["end"] * one["time_base"]), one["metadata"]["title"])
            for one in film.chapters()
        ]
    assert kept == [(0.0, 0.3, "one"), (0.3, 0.6, "two")]


def test_a_file_that_holds_no_chapters_says_so(tmp_path: Path) -> None:
    lost = convert_film(with_more(tmp_path / "in.mp4"), tmp_path / "out.ts", as_it_is)
    assert lost == ["stream 1 (picture) is left out", "mpegts holds no chapters: left out"]
