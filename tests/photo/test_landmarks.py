"""The faces of a photograph: rendered heads with known truth, one photograph, and pictures without a face."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from facerelight.photo import networks
from facerelight.photo.faces.copies import brighten
from facerelight.photo.faces.face_mesh import fit_face_mesh
from facerelight.photo.faces.head_pose import HeadPose, canonical_face, fit_rigid_face
from facerelight.photo.faces.landmarks import LandmarksNotFoundError, face_at, find_faces, find_landmarks

SCRIPT = Path(__file__).parents[2] / "scripts" / "measure" / "landmarks.py"
MARKS = np.array(((202.0, 101.0), (247.0, 103.0), (221.0, 144.0)))  # read off the photo by eye


@pytest.fixture(scope="module")
def rendering():
    spec = importlib.util.spec_from_file_location("measure_landmarks", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


def distances(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of the three landmarks, in eye distances."""
    return np.linalg.norm(found - truth, axis=1) / np.linalg.norm(truth[1] - truth[0])


def moved(photo: np.ndarray, degrees: float, scale: float, pad: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The photo turned clockwise, scaled and padded; where a point goes is ``linear @ point + shift``."""
    radians = np.deg2rad(degrees)
    linear = scale * np.array(((np.cos(radians), -np.sin(radians)), (np.sin(radians), np.cos(radians))))
    height, width = photo.shape[:2]
    size = np.ceil(np.abs(linear) @ (width, height)).astype(int) + 2 * pad
    shift = (size - 1) / 2 - linear @ ((width - 1) / 2, (height - 1) / 2)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    matrix = np.column_stack((linear, shift))
    copy = cv2.warpAffine(photo, matrix, tuple(size.tolist()), flags=way, borderValue=(120, 120, 120))
    return copy, linear, shift


def test_rendered_heads(rendering) -> None:
    """Heads that the canonical face was not measured on, tilted, turned, scaled, under random lights."""
    errors, angles = [], []
    for head in rendering.head_photos(31, 16, tilt=30.0, scales=(0.35, 1.5)):
        faces = find_faces(head.photo)
        assert len(faces) == 1
        assert faces[0].whole
        errors.append(distances(faces[0].landmarks, head.landmarks))
        angles.append(np.subtract(faces[0].pose, head.pose))
    assert np.mean(errors) < 0.03
    assert np.percentile(errors, 95) < 0.06
    assert (np.abs(angles).mean(0) < (3, 6, 1.5)).all()


@pytest.mark.parametrize("pose", [HeadPose(30, 0, 0), HeadPose(-30, 0, 0), HeadPose(0, 25, 0), HeadPose(0, -12, 0)])
def test_signs_of_the_pose(rendering, pose: HeadPose) -> None:
    (head,) = rendering.head_photos(5, 1, pose=pose)
    found = find_faces(head.photo)[0].pose
    assert np.abs(np.subtract(found, pose)).max() < 9


def test_rigid_fit_is_exact_on_rigid_faces() -> None:
    truth = HeadPose(-35.0, 15.0, 160.0)
    canonical = canonical_face()
    fit = fit_rigid_face(80 * (canonical.points @ truth.rotation.T)[:, :2] * (1, -1) + (300, 200))
    assert np.allclose(fit.pose, truth, atol=1e-6)
    assert np.allclose((fit.scale, *fit.shift), (80, 300, 200))
    assert fit.error < 1e-9
    assert (canonical.mirror[canonical.mirror] == np.arange(468)).all()


def test_a_photograph(astronaut: np.ndarray) -> None:
    (face,) = find_faces(astronaut)
    assert np.abs(face.landmarks - MARKS).max() < 4
    assert face.points.shape == (468, 3)
    assert face.whole
    assert face.mesh_score > 0.99
    assert np.abs(face.pose).max() < 10
    x0, y0, x1, y1 = face.box
    assert x0 < 202 < 247 < x1
    assert y0 < 101 < 144 < y1
    assert np.array_equal(find_landmarks(astronaut).numpy(), face.landmarks)
    again = find_faces(astronaut)[0]
    assert np.array_equal(again.points, face.points)


@pytest.mark.parametrize(
    ("degrees", "scale", "pad"),
    [(0, 0.5, 0), (0, 3.0, 0), (20, 1, 40), (-40, 1, 0), (90, 1, 0), (135, 1, 0), (180, 1, 30), (-75, 0.7, 0)],
)
def test_moved_copies_move_the_landmarks(astronaut: np.ndarray, degrees: float, scale: float, pad: int) -> None:
    """Also upside down: the eyes stay the same eyes, so that the way to the crop is a rotation."""
    photo, linear, shift = moved(astronaut, degrees, scale, pad)
    base, face = find_faces(astronaut)[0], find_faces(photo)[0]
    assert distances(face.landmarks, base.landmarks @ linear.T + shift).max() < 0.05
    turn = (face.pose.roll - base.pose.roll - degrees + 180) % 360 - 180
    assert abs(turn) < 2


def test_mirrored_copy(astronaut: np.ndarray) -> None:
    base, mirrored = find_faces(astronaut)[0], find_faces(np.ascontiguousarray(astronaut[:, ::-1]))[0]
    truth = (base.landmarks * (-1, 1) + (astronaut.shape[1] - 1, 0))[[1, 0, 2]]
    assert distances(mirrored.landmarks, truth).max() < 0.02
    assert np.abs(mirrored.pose.yaw + base.pose.yaw) < 1.5


def test_face_that_touches_the_border_and_dark_ones(astronaut: np.ndarray) -> None:
    tight = np.ascontiguousarray(astronaut[62:170, 172:272])
    assert distances(find_faces(tight)[0].landmarks, MARKS - (172, 62)).max() < 0.08
    dark = (astronaut / 12).astype(np.uint8)
    assert distances(find_faces(dark)[0].landmarks, MARKS).max() < 0.1
    assert brighten(dark).mean() > 3 * dark.mean()
    assert brighten(np.zeros((4, 4, 3), np.uint8)).max() == 0


def test_whole_faces_come_first(astronaut: np.ndarray) -> None:
    """Two people, the larger one cut by the picture's edge."""
    crop = astronaut[:250, 110:340]
    large = cv2.resize(crop, None, fx=2.2, fy=2.2)[:, :230]
    photo = np.full((600, 620, 3), 115, np.uint8)
    photo[40:290, 20:250] = crop
    photo[40 : 40 + large.shape[0], 390:] = large[:, :230]
    faces = find_faces(photo)
    assert faces[0].whole
    assert distances(faces[0].landmarks, MARKS - (110, -40) + (20, 0)).max() < 0.1


def test_two_faces(astronaut: np.ndarray) -> None:
    crop = astronaut[:300, 100:350]
    small = cv2.resize(crop, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    photo = np.full((320, 420, 3), 115, np.uint8)
    photo[:300, 170:] = crop
    photo[100 : 100 + small.shape[0], 10 : 10 + small.shape[1]] = small
    large_face, small_face = find_faces(photo)
    assert distances(large_face.landmarks, MARKS + np.array((70, 0))).max() < 0.1
    assert distances(small_face.landmarks, (MARKS - (100, 0)) * 0.6 + (10, 100)).max() < 0.1


def textures(seed: int, count: int) -> Iterator[np.ndarray]:
    """Clouds, blobs, stripes, and skin with spots where eyes could be."""
    rng = np.random.default_rng(seed)
    for kind in range(count):
        height, width = (int(n) for n in rng.integers(120, 420, 2))
        y, x = np.mgrid[:height, :width]
        picture = np.ones((height, width, 3)) * rng.uniform(60, 200, 3)
        if kind % 4 == 0:
            slope = np.hypot(*np.meshgrid(np.fft.fftfreq(width), np.fft.fftfreq(height))) + 1 / max(height, width)
            cloud = np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) / slope ** rng.uniform(1, 2)).real
            picture += 45 * (cloud / cloud.std())[..., None] * rng.uniform(0.5, 1, 3)
        elif kind % 4 == 1:
            for _ in range(40):
                place = int(rng.integers(width)), int(rng.integers(height))
                axes = tuple(int(n) for n in rng.integers(3, 70, 2))
                shade = tuple(float(v) for v in rng.uniform(20, 235, 3))
                picture = cv2.ellipse(picture, place, axes, float(rng.uniform(0, 180)), 0, 360, shade, -1)
        elif kind % 4 == 2:
            angle = rng.uniform(0, np.pi)
            waves = np.sin((x * np.cos(angle) + y * np.sin(angle)) * rng.uniform(0.05, 0.5))
            picture += 70 * waves[..., None] * rng.uniform(0.3, 1, 3) + rng.normal(0, 10, picture.shape)
        else:
            picture = np.ones_like(picture) * (205, 160, 130)
            unit = rng.uniform(15, 50)
            for side in (-1, 1):
                place = int(width / 2 + side * unit), int(height / 2 - 0.3 * unit)
                picture = cv2.circle(picture, place, int(unit * rng.uniform(0.1, 0.4)), (40.0, 30.0, 30.0), -1)
        yield np.clip(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.5, 5))), 0, 255).astype(np.uint8)


def test_no_face_in_textures() -> None:
    found = [index for index, photo in enumerate(textures(3, 28)) if find_faces(photo)]
    assert found == []


def test_no_face_in_photographs_of_things() -> None:
    """scikit-image's pictures without people; those that it does not carry are skipped."""
    data = pytest.importorskip("skimage.data", reason="scikit-image carries the pictures")
    folder = Path(data.__file__).parent
    names = """
        brick.png cell.png chelsea.png chessboard_GRAY.png clock_motion.png coffee.png coins.png color.png grass.png
        gravel.png horse.png hubble_deep_field.jpg ihc.png logo.png microaneurysms.png moon.png
        motorcycle_left.png motorcycle_right.png page.png phantom.png retina.jpg rocket.jpg text.png
    """
    there = [name for name in names.split() if (folder / name).is_file()]
    pictures = {name: cv2.imread(str(folder / name), cv2.IMREAD_COLOR) for name in there}
    if not pictures:
        pytest.skip("scikit-image carries no pictures here")
    found = [name for name, picture in pictures.items() if find_faces(np.ascontiguousarray(picture[..., ::-1]))]
    assert found == []


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (16, 16), (500, 20)])
def test_tiny_pictures_show_nothing(size: tuple[int, int]) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    assert find_faces(noise) == []
    with pytest.raises(LandmarksNotFoundError, match="by hand"):
        find_landmarks(noise)


def test_landmarks_by_hand(astronaut: np.ndarray) -> None:
    face = face_at(astronaut, MARKS)
    found = find_faces(astronaut)[0]
    assert np.array_equal(face.landmarks, MARKS)
    assert np.abs(face.points - found.points)[:, :2].max() < 1.5
    assert np.abs(np.subtract(face.pose, found.pose)).max() < 2
    for marks, words in ((MARKS[:2], "three"), (MARKS * np.nan, "finite"), (MARKS[[0, 0, 2]], "different eyes")):
        with pytest.raises(ValueError, match=words):
            face_at(astronaut, marks)
    with pytest.raises(ValueError, match="uint8"):
        find_faces(astronaut / 255)
    with pytest.raises(ValueError, match="detector"):
        find_landmarks(astronaut, "best")


def test_rough_guesses_lead_to_the_same_mesh(astronaut: np.ndarray) -> None:
    mirror = canonical_face().mirror
    base = fit_face_mesh(astronaut, MARKS, mirror).points
    rng = np.random.default_rng(1)
    for _ in range(3):
        other = fit_face_mesh(astronaut, MARKS + rng.normal(0, 5, (3, 2)), mirror).points
        assert np.abs(other - base)[:, :2].mean() < 0.03 * 45


def test_damaged_networks(astronaut: np.ndarray, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """They are named, with a remedy; the cascades stand in."""
    with pytest.raises(ValueError, match="expected one of"):
        networks.network_path("other.onnx")
    package = Path(networks.__file__).parent
    for name in networks.CHECKSUMS:
        assert networks.network_path(name) == package / name
        (tmp_path / name).write_bytes((package / name).read_bytes()[:-1])
    (tmp_path / networks.FACE_MESH).unlink()
    monkeypatch.setattr(networks, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(RuntimeError, match=r"yunet.*damaged.*pack_networks"):
        networks.network_path(networks.YUNET)
    with pytest.raises(RuntimeError, match=r"face_landmark.*No such file.*pack_networks"):
        networks.network_path(networks.FACE_MESH)


def test_cascades_stand_in(astronaut: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("yunet.onnx: the file is damaged")

    monkeypatch.setattr("facerelight.photo.faces.landmarks.detect_faces", broken)
    with pytest.warns(RuntimeWarning, match=r"damaged.*cascades"):
        (face,) = find_faces(astronaut)
    assert face.points is None
    assert face.pose is None
    assert face.whole
    assert np.abs(face.landmarks - MARKS).max() < 6
    with pytest.raises(RuntimeError, match="damaged"):
        find_landmarks(astronaut, "yunet")
    monkeypatch.setattr("facerelight.photo.faces.landmarks.fit_face_mesh", broken)
    with pytest.warns(RuntimeWarning, match="no dense points"):
        bare = face_at(astronaut, MARKS)
    assert np.array_equal(bare.landmarks, MARKS)
    assert bare.points is None
