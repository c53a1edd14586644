"""RandomFaceRelight keeps what kornia promises of its augmentations, and lights faces the way lamps do."""

import builtins
import copy
import io
import pickle

import kornia.augmentation as kornia
import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.augment import RandomFaceRelight
from facerelight.augment.colour import raised_radiance, scene_luminance, to_display
from facerelight.augment.exact import ExactRelighter
from facerelight.augment.frames import ARCFACE_POINTS, FaceWarp, frame_landmarks
from facerelight.augment.lamps import LampGenerator, lamp_points
from facerelight.augment.torchvision_v2 import TorchvisionFaceRelight
from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.geometry.sources import Lamp
from facerelight.photo import colour

ONE_LAMP = {"fill": (0.1, 0.1), "mix": (0.0, 0.0), "size": (5.0, 5.0)}


def lit_from(azimuth, elevation, quick, **options):
    """The augmentation with one lamp."""
    options = {**ONE_LAMP, "encoding": "linear", "p": 1.0, **options}
    return RandomFaceRelight(azimuth=(azimuth, azimuth), elevation=(elevation, elevation), relighter=quick, **options)


@pytest.fixture(scope="module")
def faces(crops):
    """Coded colour crops ``(6, 3, 112, 112)``."""
    return crops(10, 5) ** (1 / 2.2) * torch.tensor([1.0, 0.85, 0.75])[:, None, None]


class TestKornia:
    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
    def test_shape_dtype_and_range_are_kept(self, faces, quick, dtype):
        augment = RandomFaceRelight(relighter=quick, p=1.0)
        relit = augment(faces.to(dtype))
        assert relit.shape == faces.shape
        assert relit.dtype == dtype
        assert (relit >= 0).all()
        assert (relit <= 1).all()
        assert augment._params["relit"].all()
        assert not torch.allclose(relit.float(), faces, atol=0.02)

    @pytest.mark.parametrize(
        ("shape", "out"),
        [((1, 3, 64, 64), None), ((2, 1, 56, 40), None), ((3, 50, 50), (1, 3, 50, 50)), ((40, 40), (1, 1, 40, 40))],
    )
    def test_cardinality(self, quick, shape, out):
        crops = torch.rand(shape)
        assert RandomFaceRelight(relighter=quick, p=1.0)(crops).shape == (out or shape)
        assert RandomFaceRelight(relighter=quick, p=1.0, keepdim=True)(crops).shape == shape

    def test_an_empty_batch_stays_empty(self, quick):
        assert RandomFaceRelight(relighter=quick, p=1.0)(torch.rand(0, 3, 32, 32)).shape == (0, 3, 32, 32)

    def test_probability(self, faces, quick):
        assert torch.equal(RandomFaceRelight(relighter=quick, p=0.0)(faces), faces)
        torch.manual_seed(1)
        augment = RandomFaceRelight(relighter=quick, p=0.5)
        relit = augment(faces)
        applied = augment._params["batch_prob"] > 0.5
        assert 0 < applied.sum() < len(faces)
        assert torch.equal((relit != faces).flatten(1).any(1), applied)
        assert torch.equal(augment._params["relit"], applied)

    def test_parameters_replay(self, faces, quick):
        augment = RandomFaceRelight(relighter=quick, p=0.6)
        relit = augment(faces)
        drawn = augment._params
        assert not torch.equal(augment(faces), relit)
        assert torch.equal(augment(faces, params=drawn), relit)
        assert torch.equal(RandomFaceRelight(relighter=quick, p=0.6)(faces, params=drawn), relit)

    def test_one_lamp_on_a_batch(self, faces, quick):
        augment = RandomFaceRelight(relighter=quick, p=1.0, same_on_batch=True)
        same = faces[:1].expand(3, -1, -1, -1)
        relit = augment(same)
        assert torch.allclose(relit, relit[:1].expand(3, -1, -1, -1), atol=1e-5)
        assert len(augment._params["azimuth"].unique()) == 1

    def test_among_other_modules(self, faces, quick):
        steps = kornia.AugmentationSequential(
            RandomFaceRelight(relighter=quick, p=1.0), kornia.RandomHorizontalFlip(p=0.5), data_keys=["input", "mask"]
        )
        mask = torch.ones(len(faces), 1, 112, 112)
        relit, kept = steps(faces, mask)
        again, _ = steps(faces, mask, params=steps._params)
        assert torch.equal(relit, again)
        assert torch.equal(kept, mask)
        one = torch.nn.Sequential(RandomFaceRelight(relighter=quick, p=1.0), kornia.Normalize(0.5, 0.5))
        assert one(faces).shape == faces.shape

    def test_serialisation(self, faces, quick):
        augment = RandomFaceRelight(relighter=quick, p=1.0)
        relit, drawn = augment(faces), augment._params
        buffer = io.BytesIO()
        torch.save(augment.state_dict(), buffer)
        assert buffer.tell() < 1e4  # the packaged statistics are no part of it
        buffer.seek(0)
        augment.load_state_dict(torch.load(buffer))
        for other in (copy.deepcopy(augment), pickle.loads(pickle.dumps(augment))):
            assert torch.equal(other(faces, params=drawn), relit)
        assert "azimuth=(-75.0, 75.0)" in repr(augment)

    @pytest.mark.parametrize("encoding", ["srgb", "linear"])
    def test_gradients(self, crops, quick, encoding):
        small = torch.nn.functional.interpolate(crops(20, 10)[:1], (14, 14), mode="area").double().requires_grad_()
        augment = RandomFaceRelight(relighter=quick, p=1.0, encoding=encoding)
        augment(small)
        assert augment._params["relit"].all()
        drawn = augment._params
        assert torch.autograd.gradcheck(lambda x: augment(x, params=dict(drawn)), small, fast_mode=True, atol=1e-4)

    def test_no_file_is_opened(self, faces, quick, monkeypatch):
        augment = RandomFaceRelight(relighter=quick, p=1.0)
        augment(faces)

        def refuse(*_, **__):
            raise AssertionError("a file was opened")

        monkeypatch.setattr(builtins, "open", refuse)
        augment(faces)


def test_lamps_are_uniform_over_the_sphere():
    torch.manual_seed(0)
    drawn = LampGenerator((-75, 75), (-30, 60), (2, 20), (0, 0.3), (0, 0.2))(torch.Size((20000,)))
    height = torch.sin(torch.deg2rad(drawn["elevation"]))
    for values, low, high in ((height, -0.5, 3**0.5 / 2), (drawn["azimuth"], -75, 75), (drawn["fill"], 0, 0.3)):
        quantiles = torch.quantile(values, torch.tensor([0.1, 0.5, 0.9]))
        assert torch.allclose(quantiles, low + (high - low) * torch.tensor([0.1, 0.5, 0.9]), atol=0.02 * (high - low))


def test_a_lamp_has_the_points_of_one_lamp():
    lamp = Lamp(40, 25, size=7)  # of seven points as well
    points = lamp_points(*(torch.tensor([value]) for value in (40.0, 25.0, 7.0)))
    assert torch.allclose(points.directions[0].float(), lamp.light().directions, atol=1e-5)


@pytest.mark.parametrize("side", [1, -1])
def test_a_positive_azimuth_lights_image_left(crops, quick, side):
    relit = lit_from(60.0 * side, 0.0, quick)(crops(0, 0))
    left, right = relit[..., 40:100, 30:54].mean((1, 2, 3)), relit[..., 40:100, 58:82].mean((1, 2, 3))
    assert (left > 1.5 * right if side > 0 else right > 1.5 * left).all()


def test_a_lamp_behind_the_face_lights_its_rim_alone(packaged, crops, quick):
    faces = crops(0, 0)[:2]
    options = {"fill": (0.0, 0.0), "size": (0.0, 0.0)}
    beside, just, rim, none = (lit_from(azimuth, 0.0, quick, **options)(faces) for azimuth in (90, 90.5, 135, 180))
    assert (just - beside).abs().mean() < 0.01  # it does not jump
    front, edge = (..., slice(50, 90), slice(48, 64)), (..., slice(50, 90), slice(14, 24))
    assert rim[front].mean() < 0.3 * beside[front].mean()
    assert rim[edge].mean() > 2 * rim[front].mean()
    assert (none[front] < 0.1 * faces[front]).all()
    exact = lit_from(135, 0.0, ExactRelighter(packaged), **options)(faces)
    assert 255 * (rim - exact).square().mean().sqrt() < 6


def test_the_light_that_was_there_changes_little(crops, quick):
    faces = crops(0, 0)
    options = {"fill": (0.0, 0.0), "size": (0.0, 0.0)}
    for source, most in (("front", 3), ("estimate", 20)):  # grey levels; a light is told to some degrees
        relit = lit_from(0.0, 0.0, quick, source=source, **options)(faces)
        assert 255 * (relit - faces)[..., 30:100, 25:87].square().mean().sqrt() < most
    assert torch.allclose(lit_from(70.0, 0.0, quick, mix=(1.0, 1.0))(faces), faces, atol=1e-6)


@pytest.mark.parametrize("source", [(0, 0), (-40, 10)])
def test_relit_crops_are_near_the_truth(crops, quick, source):
    """The person under the new light is known: the model made them up."""
    faces, truth = crops(*source), crops(45, 20)
    relit = lit_from(45.0, 20.0, quick, fill=(0.0, 0.0), size=(0.0, 0.0))(faces)
    here = (slice(None), slice(None), slice(35, 100), slice(28, 84))
    scale = (truth[here] * relit[here]).sum() / relit[here].square().sum()  # exposures differ
    before = (truth[here] - faces[here]).square().mean().sqrt()
    assert (truth[here] - scale * relit[here]).square().mean().sqrt() < 0.5 * before


def test_the_fast_path_is_near_the_exact_one(packaged, crops, quick):
    faces = torch.cat((crops(0, 0)[:2], crops(50, 20)[:2], crops(-30, 40)[:2]))
    augment = RandomFaceRelight(relighter=quick, encoding="linear", mix=(0, 0), p=1.0)
    torch.manual_seed(2)
    relit, drawn = augment(faces), augment._params
    exact = RandomFaceRelight(relighter=ExactRelighter(packaged), encoding="linear", p=1.0)(faces, params=drawn)
    assert 255 * (relit - exact).square().mean().sqrt() < 6  # with the default block of 2 a half of it
    assert 255 * (exact - faces).square().mean().sqrt() > 20


def test_what_is_black_not_finite_or_of_strong_contrast_passes_and_is_said(faces, quick):
    odd = faces.clone()
    odd[0], odd[1] = 0.0, float("nan")
    odd[2] = (
        torch.rand(1, 14, 14, generator=torch.Generator().manual_seed(0))
        .repeat_interleave(8, 1)
        .repeat_interleave(8, 2)
        > 0.5
    ).float()
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    relit = augment(odd)
    assert augment._params["relit"].tolist() == [False, False, False, True, True, True]
    assert torch.equal(relit[[0, 2]], odd[[0, 2]])
    assert relit[1].isnan().all()
    assert torch.isfinite(relit[3:]).all()
    augment(torch.stack((torch.ones(3, 112, 112), torch.rand(3, 112, 112))))
    assert augment._params["relit"].all()  # no face is looked for


@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_another_range_is_refused(faces, quick, encoding):
    augment = RandomFaceRelight(relighter=quick, encoding=encoding, p=0.5)
    mean, std = (torch.tensor(part)[:, None, None] for part in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    for other in (255 * faces, 2 * faces - 1, (faces - mean) / std):
        with pytest.raises(
            ValueError, match=r"expected values in 0\.\.1, got .* to .*; divide values of 0\.\.255 by 255"
        ):
            augment(other)
    mixed = faces.clone()
    mixed[2] *= 255
    with pytest.raises(ValueError, match="expected values in"):
        augment(mixed)


def test_noise_counts_as_black_and_white(faces, quick):
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    noisy = faces + 0.15 * torch.randn(faces.shape, generator=torch.Generator().manual_seed(0))
    assert noisy.min() < -0.3
    relit = augment(noisy)
    assert augment._params["relit"].all()
    assert torch.equal(augment(noisy.clamp(0, 1), params=augment._params), relit)


def test_landmarks_say_where_a_face_is(faces, quick):
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    there = frame_landmarks("arcface112", 112, 112)
    relit, drawn = augment(faces), augment._params
    assert torch.allclose(augment(faces, params=drawn, landmarks=there.expand(6, -1, -1)), relit, atol=1e-3)
    fixed = RandomFaceRelight(frame=tuple(map(tuple, there.tolist())), relighter=quick, p=1.0)
    assert torch.equal(fixed(faces, params=drawn), relit)
    moved = torch.nn.functional.pad(faces, (12, 0, 8, 0), mode="replicate")
    marks = (there + torch.tensor([12.0, 8.0])).expand(len(faces), -1, -1)
    shifted = augment(moved, params=drawn, landmarks=marks)[..., 8:, 12:]
    inside = (..., slice(20, 95), slice(20, 92))
    assert (shifted - relit)[inside].abs().mean() < 0.004


def test_neighbours_of_other_sizes_change_nothing(faces, quick):
    """Faces that fill the crop, and one of a third of that size between them."""
    large = torch.nn.functional.interpolate(faces[:3], (448, 448), mode="bilinear")
    marks = frame_landmarks("arcface112", 448, 448).expand(3, -1, -1).clone()
    marks[1] = marks[1] / 3 + 100
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    relit, drawn = augment(large, landmarks=marks), augment._params
    for one in range(3):
        alone = {name: drawn[name][one : one + 1] for name in ("azimuth", "elevation", "size", "fill", "mix")}
        alone["batch_prob"] = torch.ones(1)
        single = augment(large[one : one + 1], params=alone, landmarks=marks[one : one + 1])
        assert torch.allclose(single[0], relit[one], atol=1e-4)


@pytest.mark.parametrize("side", [56, 448])
def test_a_size_is_as_good_as_another(faces, quick, side):
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    relit, drawn = augment(faces), augment._params
    other = augment(torch.nn.functional.interpolate(faces, (side, side), mode="area"), params=drawn)
    least = min(side, 112)
    small = [torch.nn.functional.interpolate(images, (least, least), mode="area") for images in (relit, other)]
    assert (small[0] - small[1]).abs().mean() < 0.01


def test_grey_is_colour_without_colour(crops, quick):
    grey = crops(0, 0) ** (1 / 2.2)
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    relit = augment(grey)
    assert torch.allclose(augment(grey.expand(-1, 3, -1, -1), params=augment._params), relit.expand(-1, 3, -1, -1))


def test_frames():
    points = frame_landmarks("arcface112", 224, 224)
    assert torch.allclose(points[0] / 2 - 0.25, torch.tensor(ARCFACE_POINTS[0], dtype=torch.float64), atol=1e-9)
    assert torch.equal(frame_landmarks("yale", 96, 84), CropFrame(96, 84).landmarks)
    crop, model = torch.rand(2, 3, 60, 50), CropFrame(64, 56, 0.25)
    marks = frame_landmarks("yale", 60, 50)
    matrix = fit_similarity(marks, model.landmarks).expand(2, -1, -1)
    warped = FaceWarp(marks[None], (60, 50), model).to_model(crop)
    assert torch.allclose(warped, warp_to_crop(crop, matrix, model), atol=1e-4)


def test_the_curve_is_that_of_photographs():
    coded = torch.rand(1, 3, 9, 9)
    raised = raised_radiance(coded)
    scene = colour.to_scene(coded[0].permute(1, 2, 0).numpy())
    assert np.allclose(scene_luminance(raised[:, :1])[0, 0].numpy(), scene[..., 0], atol=1e-4)
    assert torch.allclose(to_display(raised, torch.ones(1, 1, 9, 9)), coded, atol=2e-4)
    for ratio in (0.2, 1.7):
        expected = colour.to_display(scene * np.float32(ratio), scene)
        made = to_display(raised, torch.full((1, 1, 9, 9), ratio))[0].permute(1, 2, 0).numpy()
        assert np.abs(made - expected).max() < 1e-3


def test_among_the_transforms_of_torchvision(faces, quick):
    step = TorchvisionFaceRelight(RandomFaceRelight(relighter=quick, p=1.0))
    bytes_ = (faces[0] * 255).to(torch.uint8)
    picture = Image.fromarray(bytes_.permute(1, 2, 0).numpy())
    made = step({"image": picture, "grey": picture.convert("L"), "label": torch.tensor(3), "name": "me"})
    assert (made["image"].mode, made["image"].size, made["grey"].mode) == ("RGB", (112, 112), "L")
    assert made["label"] == 3
    assert made["name"] == "me"
    assert np.abs(np.array(made["image"], int) - np.array(picture, int)).mean() > 2
    relit, label = step(bytes_, 5)
    assert (relit.dtype, relit.shape, label) == (torch.uint8, bytes_.shape, 5)
    with pytest.raises(ValueError, match="mode L or RGB, got RGBA"):
        step(picture.convert("RGBA"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"frame": "vggface"}, "'arcface112' or three landmarks, got 'vggface'"),
        ({"frame": ((1, 2), (3, 4))}, "three finite points"),
        ({"azimuth": (30, -30)}, "azimuth: expected two numbers"),
        ({"elevation": (-100, 0)}, "elevation: expected two numbers from -90 to 90"),
        ({"source": "side"}, "source: expected 'estimate' or 'front'"),
        ({"encoding": "hdr"}, "encoding: expected 'srgb' or 'linear'"),
    ],
)
def test_options_that_are_none(quick, options, said):
    with pytest.raises(ValueError, match=said):
        RandomFaceRelight(relighter=quick, **options)


def test_crops_that_are_none(quick):
    augment = RandomFaceRelight(relighter=quick, p=1.0)
    with pytest.raises(ValueError, match="one channel or three, got 2"):
        augment(torch.rand(1, 2, 32, 32))
    with pytest.raises(ValueError, match=r"landmarks: expected a tensor \(2, 3, 2\)"):
        augment(torch.rand(2, 3, 32, 32), landmarks=torch.rand(2, 5, 2))
