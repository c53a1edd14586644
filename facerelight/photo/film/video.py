"""Films on disk: pictures go through a function, everything else (sound, subtitles, times, tags) is taken over as it
is."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from facerelight.photo.film.times import Times
from facerelight.photo.film.track import Picture

if TYPE_CHECKING:
    from av.container import InputContainer, OutputContainer
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

__all__ = ["FilmFacts", "convert_film", "film_facts"]

NEEDED = 'films need PyAV; pip install "facerelight[video]"'
ENCODERS: dict[str, dict[str, str]] = {
    "libx264": {"crf": "16", "preset": "medium"},
    "libx265": {"crf": "18", "preset": "medium", "x265-params": "log-level=error"},
    "libvpx-vp9": {"crf": "20", "b:v": "0", "row-mt": "1", "cpu-used": "4"},
}
HIGH_DEFINITION = 720  # lines, from which players take a film without a colour space for BT.709
CODED_AS = {
    1: "ITU709",
    4: "FCC",
    5: "ITU601",
    6: "ITU601",
    7: "SMPTE240M",
    9: "BT2020",
}  # by number of the colour space
NOT_SRGB = {16: "PQ", 18: "HLG"}  # transfer curves
STILL_PICTURE = 0x0400  # a stream that is a cover
UNUSED = 48  # a stream that no reader wants
WITH_CHAPTERS = ("mp4", "mov", "ipod", "matroska", "webm")
RATE = Fraction(25)  # frames a second where a film says nothing
TAGS = ("colorspace", "color_range", "color_primaries", "color_trc")

Change = Callable[[Iterator[Picture]], Iterable[Picture]]


class FilmFacts(NamedTuple):
    """``size``: height and width of the upright picture; ``rate``, frames a second; about how many ``frames``, 0 where
    nothing says it; ``bits`` a channel; ``turn``, quarter turns anticlockwise that make the stored picture upright."""

    size: tuple[int, int]
    rate: Fraction
    frames: int
    bits: int
    turn: int


def film_facts(path: str | Path) -> FilmFacts:
    """What a film is, by its first picture.

    Raises:
        ValueError: a file that is no film.
        RuntimeError: PyAV is not there.
    """
    return _probed(Path(path))[0]


def convert_film(source: str | Path, output: str | Path, change: Change) -> list[str]:
    """Write ``source`` as ``output``, its pictures as ``change`` gives them back.

    Rate and times, size, rotation, colour range and tags of the picture are kept, sound and subtitles copied packet by
    packet. H.264, or H.265 where the film has it, is written at a quality at which nothing is seen to be lost; .webm is
    VP9. An existing file is replaced only once the new one is whole.

    Args:
        change: takes the upright pictures, and gives as many in the same order.

    Returns:
        What could not be kept, a line each.

    Raises:
        ValueError: a file that is no film, or one that cannot be written.
    """
    source, output = Path(source), Path(output)
    facts, first = _probed(source)
    av = _av()
    partial = output.with_name(f"{output.stem}.{os.getpid()}.part{output.suffix}")
    lost: list[str] = []
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(source)) as given, _said(source, output), av.open(str(partial), "w") as made:
            _Conversion(given, made, facts, first, lost).run(change)
        partial.replace(output)
    except (av.FFmpegError, OSError) as error:
        raise ValueError(f"{output}: could not be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return lost


class _Conversion:
    """From one open container to another."""

    def __init__(
        self, given: InputContainer, made: OutputContainer, facts: FilmFacts, first: VideoFrame, lost: list[str]
    ) -> None:
        self.given, self.made, self.facts, self.lost = given, made, facts, lost
        self.video: Any = _picture_stream(given)
        self.space, self.full = _colour_space(first), int(first.color_range) == 2
        self.stored: deque[dict[str, Any]] = deque()  # times and tags of pictures that are on their way
        self.stored_size = first.height, first.width
        self.out = self._picture_out(first)
        self.copies = self._copied_streams()
        joins: list[Fraction] = []
        self.times = {  # several subtitles may come at once
            one: Times(one.time_base, joins, int(one.type != "subtitle")) for one in (self.video, *self.copies)
        }
        self._keep_chapters()
        self.made.metadata.update(given.metadata)

    def run(self, change: Change) -> None:
        for picture in change(self._pictures()):
            for packet in self.out.encode(self._coded(picture.pixels, self.stored.popleft())):
                self.made.mux(packet)
        for packet in self.out.encode(None):
            self.made.mux(packet)
        back = [times.back for times in self.times.values() if times.back is not None]
        if back:
            self.lost.append(f"the film's times go back after {min(back):.1f} s: what follows is put behind it")

    def _pictures(self) -> Iterator[Picture]:
        start: float | None = None
        for packet in self.given.demux([self.video, *self.copies]):
            if packet.stream is not self.video:
                if packet.dts is not None:
                    later = self.times[packet.stream](packet.dts) - packet.dts
                    if later:
                        packet.dts += later
                        packet.pts = None if packet.pts is None else packet.pts + later
                    packet.stream = self.copies[packet.stream]
                    self.made.mux(packet)
                continue
            for frame in _decoded(packet):
                if (frame.height, frame.width) != self.stored_size:  # a film may change its size
                    frame = frame.reformat(self.stored_size[1], self.stored_size[0])
                frame.pts = self.times[self.video](frame.pts)
                time = float(frame.time or 0.0)
                start = time if start is None else start
                self.stored.append({tag: getattr(frame, tag) for tag in ("pts", "time_base", *TAGS)})
                form = "rgb48le" if self.facts.bits > 8 else "rgb24"
                shown = frame.to_ndarray(format=form, **self._range("src"))
                yield Picture(np.ascontiguousarray(np.rot90(shown, self.facts.turn)), time - start)

    def _range(self, side: str) -> dict[str, Any]:
        return {f"{side}_colorspace": self.space, f"{side}_color_range": 2 if self.full else 1}

    def _coded(self, pixels: np.ndarray, stored: dict[str, Any]) -> VideoFrame:
        av = _av()
        turned = np.ascontiguousarray(np.rot90(pixels, -self.facts.turn))
        shown = av.VideoFrame.from_ndarray(turned, format="rgb48le" if self.facts.bits > 8 else "rgb24")
        frame: VideoFrame = shown.reformat(format=self.out.codec_context.pix_fmt, **self._range("dst"))
        for tag, value in stored.items():
            setattr(frame, tag, value)
        return frame

    def _picture_out(self, first: VideoFrame) -> Any:
        name = self.video.codec_context.name
        kind = "libvpx-vp9" if self.made.format.name == "webm" else "libx265" if name == "hevc" else "libx264"
        out: Any = self.made.add_stream(kind, rate=self.facts.rate, options=dict(ENCODERS[kind]))
        context, own = out.codec_context, self.video.codec_context
        context.width, context.height = first.width, first.height
        context.pix_fmt = _pixel_format(kind, first)
        context.time_base = self.video.time_base
        for tag in TAGS:
            setattr(context, tag, getattr(own, tag))
        if own.sample_aspect_ratio:
            context.sample_aspect_ratio = own.sample_aspect_ratio
        if kind == "libx265" and self.made.format.name in ("mp4", "mov"):
            context.codec_tag = "hvc1"  # other players do not show it
        if first.rotation:
            out.set_display_rotation(first.rotation)
        out.metadata.update({key: value for key, value in self.video.metadata.items() if key in ("language", "title")})
        curve = NOT_SRGB.get(int(own.color_trc or 0))
        if curve:
            self.lost.append(f"the film's brightness is coded as {curve}: it is relit as if it were an ordinary film")
        if first.interlaced_frame:
            self.lost.append("the film is interlaced: it is relit and written as whole pictures")
        return out

    def _copied_streams(self) -> dict[Any, Any]:
        copies, chapters = {}, self.given.chapters()
        for stream in self.given.streams:
            if stream is self.video:
                continue
            known = stream.type in ("audio", "subtitle") and getattr(stream, "codec_context", None) is not None
            if known and stream.codec_context.codec.canonical_name in self.made.supported_codecs:
                copies[stream] = self.made.add_stream_from_template(stream)
                copies[stream].metadata.update(stream.metadata)
            elif stream.type in ("audio", "subtitle"):
                self.lost.append(f"{self.made.format.name} holds no {_name(stream)} ({stream.type}): left out")
            elif not (int(stream.discard) >= UNUSED and chapters):  # chapters may be a stream as well
                kind = {"video": "picture", None: "unknown"}.get(stream.type, stream.type)
                self.lost.append(f"stream {stream.index} ({kind}) is left out")
        return copies

    def _keep_chapters(self) -> None:
        chapters = self.given.chapters()
        if chapters and self.made.format.name in WITH_CHAPTERS:
            self.made.set_chapters(chapters)
        elif chapters:
            self.lost.append(f"{self.made.format.name} holds no chapters: left out")


def _probed(path: Path) -> tuple[FilmFacts, VideoFrame]:
    av = _av()
    if not path.is_file():
        raise ValueError(f"{path}: expected a film, got {'a folder' if path.is_dir() else 'no file of this name'}")
    try:
        with av.open(str(path)) as container:
            video = _picture_stream(container)
            first = next(container.decode(video), None) if video is not None else None
            if video is None or first is None:
                raise ValueError(f"{path}: expected a film, got a file without moving pictures")
            rate = video.average_rate or video.guessed_rate or RATE
            seconds = (container.duration or 0) / av.time_base
            turn = round(float(first.rotation) / 90) % 4
            size = (video.height, video.width) if turn % 2 == 0 else (video.width, video.height)
            bits = max((part.bits for part in first.format.components), default=8)
            return FilmFacts(size, rate, video.frames or round(float(rate) * seconds), bits, turn), first
    except (av.FFmpegError, OSError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: expected a film that can be read, got: {why}") from error


def _picture_stream(container: InputContainer) -> VideoStream | None:
    moving = [one for one in container.streams.video if not int(one.disposition) & STILL_PICTURE]
    return moving[0] if moving else None


def _decoded(packet: Any) -> list[Any]:
    """The pictures of a packet; none where it is damaged."""
    try:
        return list(packet.decode())
    except _av().error.InvalidDataError:
        return []


def _colour_space(frame: VideoFrame) -> str:
    space = int(frame.colorspace)
    return CODED_AS.get(space, "ITU709" if frame.height >= HIGH_DEFINITION else "ITU601")


def _pixel_format(encoder: str, frame: VideoFrame) -> str:
    """The picture's own format where the encoder has it, or one like it."""
    known = [form.name for form in _av().Codec(encoder, "w").video_formats or ()]
    name = frame.format.name.replace("yuvj", "yuv")
    if frame.width % 2 or frame.height % 2:  # chroma of half the size needs even sides
        return "yuv444p"
    deep = max((part.bits for part in frame.format.components), default=8) > 8 and "yuv420p10le" in known
    return name if name in known and name.startswith("yuv4") else "yuv420p10le" if deep else "yuv420p"


def _name(stream: Any) -> str:
    context = getattr(stream, "codec_context", None)
    return context.codec.canonical_name if context is not None else "unknown codec"


@contextmanager
def _said(source: Path, output: Path) -> Iterator[None]:
    """Errors while a film is read and written, with its name."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if isinstance(error, _av().FFmpegError) or str(source) in str(error) or str(output) in str(error):
            raise
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        raise kind(f"{source}: {error}") from error


def _av() -> Any:
    try:
        import av
    except ModuleNotFoundError as error:
        raise RuntimeError(NEEDED) from error
    return av
