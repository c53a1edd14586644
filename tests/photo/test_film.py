"""Films: faces followed and held steady, cuts and faces that leave, lamps that move, files with sound; and the whole of
it on a few frames."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from facerelight import Lamp
from facerelight.cli import main
from facerelight.geometry.lights import even_hemisphere, light_from_angles
from facerelight.photo import PhotoRelighter, load_relighter
from facerelight.photo.faces.landmarks import find_faces
from facerelight.photo.film.evidence import Evidence
from facerelight.photo.film.lamps import MovingLamp, largest_step, take_moving
from facerelight.photo.film.names import is_film
from facerelight.photo.film.relighter import FilmRelighter, Lighting
from facerelight.photo.film.steady import PointFilter
from facerelight.photo.film.track import FADE, Picture, Tracked, follow

SIDE = 256


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    photo = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    return np.ascontiguousarray(photo[:SIDE, 96 : 96 + SIDE])


@pytest.fixture(scope="module")
def relighter():
    return load_relighter()


def noisy(pixels: np.ndarray, count: int, noise: float = 3.0) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.clip(pixels + rng.normal(0, noise, pixels.shape), 0, 255).astype(np.uint8) for _ in range(count)]


def pictures(frames: list[np.ndarray]) -> list[Picture]:
    return [Picture(frame, k / 25) for k, frame in enumerate(frames)]


def without_face(portrait: np.ndarray) -> np.ndarray:
    """The same place with nobody to be found, so much like it that it is no cut."""
    out = portrait.copy()
    out[20:190, 40:215] = cv2.GaussianBlur(portrait, (0, 0), 40)[20:190, 40:215]
    return out


# -- points over time


def test_noise_of_points_goes_and_movement_stays() -> None:
    rng, truth = np.random.default_rng(0), np.cumsum(np.r_[np.zeros(20), np.full(20, 2.0)])
    found = [np.full((30, 3), place) + rng.normal(0, 0.25, (30, 3)) for place in truth]
    points = PointFilter(unit=50.0)
    states = [points.step(one) for one in found]
    smooth = np.stack([PointFilter.smoothed(states[k : k + 13]) for k in range(40)])
    error = smooth - truth[:, None, None]
    assert error[3:17].std() < 0.25 / 1.7  # standing still
    assert np.abs(error.mean((1, 2))).max() < 0.5  # never behind, though it starts at once
    with pytest.raises(ValueError, match="expected some in the first frame"):
        PointFilter(50.0).step(None)


def test_frames_without_points_are_bridged() -> None:
    points = PointFilter(unit=50.0)
    places = [float(k) for k in range(12)]
    states = [points.step(None if k in (5, 6) else np.full((4, 3), place)) for k, place in enumerate(places)]
    assert PointFilter.smoothed(states[5:]) == pytest.approx(np.full((4, 3), 5.0), abs=0.1)


# -- faces over time


def shares(frames: list[np.ndarray]) -> list[Tracked]:
    found = list(follow(pictures(frames)))
    assert [one.picture.time for one in found] == [one.time for one in pictures(frames)]
    return found


def test_a_face_is_followed_steadily(portrait: np.ndarray) -> None:
    found = shares(noisy(portrait, 16))
    eyes = np.stack([one.face.landmarks for one in found])
    raw = np.stack([find_faces(one.picture.pixels)[0].landmarks for one in found[:8]])
    unit = np.hypot(*(eyes[0, 1] - eyes[0, 0]))
    assert np.diff(eyes, axis=0).std() < 0.3 * np.diff(raw, axis=0).std()
    assert np.abs(eyes[:8].mean(0) - raw.mean(0)).max() < 0.01 * unit
    assert {(one.share, one.shot, one.run) for one in found} == {(1.0, 0, 1)}


def test_light_fades_where_a_face_leaves_and_starts_anew_at_a_cut(portrait: np.ndarray) -> None:
    gone = without_face(portrait)
    found = shares([portrait] * 14 + [gone] * 8 + [portrait] * 12)
    share = [one.share for one in found]
    assert share[: 14 - FADE] == [1.0] * (14 - FADE)
    assert all(a > b > 0 for a, b in zip(share[13 - FADE : 13], share[14 - FADE : 14], strict=True))
    assert share[14:22] == [0.0] * 8
    assert [one.face is None for one in found[14:22]] == [True] * 8
    assert 0 < share[22] < share[24] < share[29]
    other = np.ascontiguousarray(255 - portrait[::-1])
    found = shares([portrait] * 4 + [other] * 4 + [portrait] * 4)
    assert [one.share for one in found] == [1.0] * 4 + [0.0] * 4 + [1.0] * 4
    assert [one.shot for one in found] == [0] * 4 + [1] * 4 + [2] * 4


# -- what frames say together


def test_frames_are_evidence_of_one_person_in_one_light(relighter, portrait: np.ndarray) -> None:
    session = PhotoRelighter(portrait, relighter=relighter)
    crop, rotation = session._align(portrait, session.face.landmarks).crop, session._rotation
    rng, lights = np.random.default_rng(0), even_hemisphere(6).numpy()
    evidence, alone, together = Evidence(relighter), [], []
    for _ in range(8):
        seen = (crop + 0.02 * torch.from_numpy(rng.standard_normal(crop.shape)).float()).clamp_min(0)
        alone.append(Evidence(relighter).add(seen, rotation).radiance(lights))
        together.append(evidence.add(seen, rotation).radiance(lights))
    truth = Evidence(relighter).add(crop, rotation).radiance(lights)
    assert np.array_equal(alone[0], together[0])  # one frame is one photograph
    error = [np.sqrt(np.square(one - truth).mean()) for one in (alone[-1], together[-1])]
    assert error[1] < 0.6 * error[0]
    assert len(evidence.views) == 1
    turn = np.deg2rad(15)
    other = np.array(((np.cos(turn), 0, np.sin(turn)), (0, 1, 0), (-np.sin(turn), 0, np.cos(turn)))) @ rotation
    evidence.add(crop, other)
    assert len(evidence.views) == 2


# -- lamps


def test_a_lamp_moves_along_the_sphere() -> None:
    lamp = MovingLamp([(5.0, Lamp(80, 40, size=20, power=2)), (1.0, Lamp(-60, 20, size=10))])
    assert lamp.at(0) == Lamp(-60, 20, size=10)
    assert lamp.at(9) == Lamp(80, 40, size=20, power=2)
    one, two = (light_from_angles(*angles).double() for angles in ((-60.0, 20.0), (80.0, 40.0)))
    for share in (0.25, 0.5, 0.75):
        here = lamp.at(1 + 4 * share)
        place = light_from_angles(here.azimuth, here.elevation).double()
        whole = np.arccos(float(one @ two))
        assert np.arccos(float(one @ place)) == pytest.approx(share * whole, abs=1e-4)
        assert np.arccos(float(place @ two)) == pytest.approx((1 - share) * whole, abs=1e-4)
        assert (here.size, here.power) == pytest.approx((10 + 10 * share, 1 + share))
    assert largest_step([Lamp(10, 0)], [Lamp(14, 0)]) == pytest.approx(4, abs=1e-3)


def test_keyframes_are_read_from_the_command_line() -> None:
    moving, still = take_moving(["-60,20,at=0", "60,20,at=5,lamp=b", "0,0", "10,0,at=2,size=9", "1,2,at=0,lamp=b"], 7.0)
    assert still == ["0,0"]
    assert [[(stand.time, stand.lamp.azimuth, stand.lamp.size) for stand in one.stands] for one in moving] == [
        [(0.0, -60.0, 7.0), (2.0, 10.0, 9.0)],
        [(0.0, 1.0, 7.0), (5.0, 60.0, 7.0)],
    ]
    wrong = {"1,2,at=x": "seconds", "1,2,at=-1": "seconds", "1,at=0": "expected", "1,2,lamp=a": "at="}
    for text, said in wrong.items():
        with pytest.raises(ValueError, match=said):
            take_moving([text])
    for lamps, said in (
        ([(0, Lamp(0, 0)), (0, Lamp(1, 0))], "two at 0 s"),
        ([(0, Lamp(90, 0)), (1, Lamp(-90, 0))], "opposite"),
        ([], "at least one"),
    ):
        with pytest.raises(ValueError, match=said):
            MovingLamp(lamps)


# -- frames


def test_a_still_film_is_the_still_picture_and_does_not_flicker(relighter, portrait: np.ndarray) -> None:
    frames = noisy(portrait, 15)
    film = FilmRelighter(Lighting([Lamp(60, 20)]), relighter)
    out = [one.pixels for one in film.frames(pictures(frames))]
    still = PhotoRelighter(frames[0], relighter=relighter).render([Lamp(60, 20)])
    assert np.abs(out[0].astype(int) - still).mean() < 1  # grey levels
    before, after = np.stack(frames).astype(np.float32), np.stack(out).astype(np.float32)
    person = (before != after).any(-1).mean(0) > 0.9
    flicker = [np.square(np.diff(film, axis=0)[:, person]).mean() for film in (before, after)]
    assert flicker[1] < 1.2**2 * flicker[0]
    assert np.abs(after - before)[:, person].mean() > 5
    assert (film.seen, film.lit, film.keys, film.shots) == (15, 15, 3, 1)  # keys at 0, 12 and the end


def test_faces_come_and_go_in_a_film(relighter, portrait: np.ndarray) -> None:
    empty = without_face(portrait)
    film = FilmRelighter(Lighting([MovingLamp([(0, Lamp(-50, 0)), (0.2, Lamp(50, 0))])], strength=0.8), relighter)
    frames, left = [empty] * 2 + [portrait] * 5 + [empty] * 6, portrait.copy()
    out = [one.pixels for one in film.frames(pictures(frames))]
    assert len(out) == len(frames)
    for k in (0, 1, 7, 8, 12):
        assert np.array_equal(out[k], frames[k])
    assert not np.array_equal(out[4], portrait)
    assert np.array_equal(portrait, left)  # what came in is left alone
    assert (film.seen, film.lit) == (13, 3)  # every fourth frame is searched while nobody is there


# -- files


def written(path: Path, frames: list[np.ndarray], rate: int = 25, turn: int = 0, full: bool = False) -> Path:
    av = pytest.importorskip("av", reason="the extra video is not installed")
    with av.open(str(path), "w") as film:
        video = film.add_stream("libx264", rate=rate, options={"crf": "12"})
        video.height, video.width, video.pix_fmt = *frames[0].shape[:2], "yuv420p"
        video.codec_context.color_range = 2 if full else 1
        if turn:
            video.set_display_rotation(turn)
        sound = film.add_stream("aac", rate=44100)
        for pixels in frames:
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_color_range=2 if full else 1)
            frame.color_range = 2 if full else 1
            film.mux(video.encode(frame))
        tone = np.sin(np.arange(44100 * len(frames) // rate) / 16)[None].astype(np.float32)
        heard = av.AudioFrame.from_ndarray(tone, format="fltp", layout="mono")
        heard.sample_rate = 44100
        for packet in (*sound.encode(heard), *sound.encode(None), *video.encode(None)):
            film.mux(packet)
    return path


def contents(path: Path) -> tuple[list, list[bytes], object]:
    """Frames, sound packets, and the range of colours."""
    import av

    with av.open(str(path)) as film:
        sound = [bytes(packet) for packet in film.demux(audio=0) if packet.size]
    with av.open(str(path)) as film:
        frames = list(film.decode(video=0))
        return frames, sound, film.streams.video[0].codec_context.color_range


def test_a_file_keeps_times_turn_range_and_sound(tmp_path: Path, portrait: np.ndarray) -> None:
    turned = np.ascontiguousarray(np.rot90(portrait, -1)[:, 16:])
    source = written(tmp_path / "in.mov", noisy(turned, 6, 1.0), rate=10, turn=90, full=True)
    from facerelight.photo.film.video import convert_film, film_facts

    facts = film_facts(source)
    assert (facts.size, facts.rate, facts.frames, facts.turn) == ((240, 256), 10, 6, 1)
    seen = []

    def brighter(given):
        for picture in given:
            seen.append(picture)
            yield picture._replace(pixels=np.minimum(picture.pixels, 235) + np.uint8(20))

    assert convert_film(source, tmp_path / "out.mov", brighter) == []
    assert seen[0].pixels.shape == (240, 256, 3)
    assert [round(picture.time, 3) for picture in seen] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert np.abs(seen[0].pixels.astype(int) - np.rot90(turned)).mean() < 4
    before, sound, colours = contents(source)
    after, copied, kept = contents(tmp_path / "out.mov")
    assert copied == sound
    assert [frame.pts * frame.time_base for frame in after] == [frame.pts * frame.time_base for frame in before]
    assert (after[0].rotation, int(colours), int(kept)) == (90, 2, 2)
    shown = [frame.to_ndarray(format="rgb24").astype(int).mean() for frame in (before[2], after[2])]
    assert shown[1] - shown[0] == pytest.approx(20, abs=2.5)
    assert not list(tmp_path.glob("*.part*"))


def test_relight_takes_a_film(tmp_path: Path, portrait: np.ndarray, capsys: pytest.CaptureFixture[str]) -> None:
    source, output = written(tmp_path / "in.mp4", noisy(portrait, 8, 1.0)), tmp_path / "out.mp4"
    lamps = ["--light", "-60,20,at=0", "--light", "60,20,at=0.3", "--light", "0,60,power=0.2"]
    assert main(["relight", str(source), *lamps, "--output", str(output), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["frames"], report["relit"], report["output"]) == (8, 8, [str(output)])
    frames, sound, _ = contents(output)
    first, last = (frames[k].to_ndarray(format="rgb24").astype(int)[60:130] for k in (0, 7))
    brighter = first.mean((0, 2)) - last.mean((0, 2))  # along the face: the lamp has gone from one side to the other
    assert brighter[90:120].mean() < -3
    assert brighter[140:170].mean() > 3
    assert sound == contents(source)[1]
    assert main(["relight", str(source), "--output", str(output)]) == 2
    assert "exists already; --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["film.mp4", "--variance", "v.png"], 2, "variance: expected photos with it, got a film"),
        (["film.mp4", "--face", "all"], 2, "face: expected one face of a film"),
        (["film.mp4", "--method", "mle"], 2, "method: expected 'expected' or 'map' for a film"),
        (["film.mp4", "--azimuth", "0", "30"], 2, "expected one light for a film"),
        (["film.mp4", "--output", "film.gif"], 2, "expected a film's name"),
        (["film.mp4", "--output", "film.mp4", "--force"], 2, "is the film itself"),
        (["film.mp4", "--light", "1,2,at=0", "--studio", "loop"], 2, "beside other --light alone"),
        (["none.mp4"], 2, "none.mp4: expected a film, got no file"),
        (["text.mp4"], 2, "text.mp4: expected a film that can be read"),
        (["film.mp4"], 1, "film.mp4: found no face in any of 4 frames"),
    ],
)
def test_what_is_wrong_with_a_film_is_said(
    words: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "film.mp4", [np.full((64, 64, 3), 90, np.uint8)] * 4)
    Path("text.mp4").write_text("no film")
    before = sorted(tmp_path.iterdir())
    assert main(["relight", *words]) == code
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_films_are_known_by_their_names() -> None:
    assert is_film("a.MP4")
    assert is_film("a.strange", "b.mkv")
    assert not is_film("a.jpg", "b.mp4")
    assert not is_film("a.strange")


def test_without_pyav_it_is_said_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("film.mp4").touch()
    monkeypatch.setitem(sys.modules, "av", None)
    assert main(["relight", "film.mp4"]) == 3
    assert 'films need PyAV; pip install "facerelight[video]"' in capsys.readouterr().err
