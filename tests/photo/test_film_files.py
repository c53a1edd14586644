"""Films on disk that are damaged, joined, or hold more than a picture and sound."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from facerelight.photo.film.track import Picture
from facerelight.photo.film.video import convert_film

av = pytest.importorskip("av", reason="the extra video is not installed")

FRAMES, RATE = 6, 10


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
