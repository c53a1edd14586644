"""Poses and expressions on demand (5.6, 7.3), on a handful of small rendered heads."""

from dataclasses import replace

import pytest
import torch

from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.bootstrap.posture import rotate
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter

INPUTS = [View(-30.0), View(30.0), View()]


@pytest.fixture(scope="module")
def strangers(posed: BootstrapViews) -> BootstrapViews:
    """People who are not in the bootstrap."""
    return BootstrapViews(replace(posed.config, heads=2), posed.folder, first=posed.config.heads)


def test_views_are_rendered_once_and_the_same(posed: BootstrapViews) -> None:
    first = posed.images(View(15.0))
    files = sorted(posed.folder.glob("*.npy"))
    stamps = [file.stat().st_mtime_ns for file in files]
    assert torch.equal(posed.images(View(15.0)), first)
    assert [file.stat().st_mtime_ns for file in files] == stamps
    assert not list(posed.folder.glob("*.part"))


def test_a_turned_head_shows_its_other_side(posed: BootstrapViews) -> None:
    """A positive azimuth shows the side at image-left: what lies in front of the pivot goes to image-right, and
    mirrored poses mirror it."""
    frontal, turned = posed.images(View()).mean(0), posed.images(View(40.0)).mean(0)
    mirrored = posed.images(View(-40.0)).mean(0)
    assert (turned - frontal).abs().mean() > 0.02
    assert (turned - mirrored.flip(-1)).abs().mean() < 0.5 * (turned - mirrored).abs().mean()
    head = MakeHumanHeads(0).head(0)
    assert rotate(head, 40, 0).landmarks[2, 0] > 0  # the mouth, in front of the pivot, goes to image-right


def test_consistency_over_views(posed: BootstrapViews, strangers: BootstrapViews) -> None:
    images = torch.stack([strangers.images(view) for view in INPUTS], 1)
    for rank in (0, 6):
        for view, image in zip(INPUTS, images.unbind(1), strict=True):
            out = ViewRelighter(posed, rank, noise=0)(images, INPUTS, view)
            assert (out.mean - image).abs().max() < 0.5 / 255
            assert out.variance.max() < 1e-6


def test_the_whole_face_carries_identity_across_poses(posed: BootstrapViews, strangers: BootstrapViews) -> None:
    images = torch.stack([strangers.images(view) for view in INPUTS], 1)
    target = View(-52.0)
    truth, average = strangers.images(target), posed.images(target).mean(0)
    errors = [
        float((ViewRelighter(posed, rank, 30.0)(images, INPUTS, target).mean - truth).square().mean())
        for rank in (0, 6)
    ]
    assert errors[1] < errors[0] < float((average - truth).square().mean())
    assert ViewRelighter(posed, 6)(images, INPUTS, target).code.shape == (2, 6)


def test_an_unknown_pose_is_integrated_over(posed: BootstrapViews, strangers: BootstrapViews) -> None:
    truth = View(30.0)
    candidates = [View(-30.0), View(0.0), truth]
    images = strangers.images(truth)[:, None]
    relighter = ViewRelighter(posed, 6)
    out = relighter(images, [candidates], View())
    assert (out.weight.argmax(1) == 2).all()
    assert torch.allclose(out.weight.sum(1), torch.ones(2))
    known = relighter(images, [truth], View())
    sure = out.weight[:, 2] > 0.99
    assert torch.allclose(out.mean[sure], known.mean[sure], atol=0.02)


def test_an_expression_is_one_more_viewing_parameter(posed: BootstrapViews, strangers: BootstrapViews) -> None:
    """A laughing, side-lit face relit to the front with statistics at its expression beats those of neutral faces."""
    laugh = (("jawOpen", 0.7), ("mouthSmileLeft", 0.6), ("mouthSmileRight", 0.6))
    seen, wanted = View(light=(50.0, 0.0), expression=laugh), View(expression=laugh)
    images = strangers.images(seen)[:, None]
    truth = strangers.images(wanted)
    assert (truth - strangers.images(View())).abs().mean() > 0.003
    relighter = ViewRelighter(posed, 6, 30.0)
    right = float((relighter(images, [seen], wanted).mean - truth).square().mean())
    wrong = float(
        (relighter(images, [replace(seen, expression=())], replace(wanted, expression=())).mean - truth).square().mean()
    )
    assert right < wrong


def test_bad_views(posed: BootstrapViews) -> None:
    with pytest.raises(ValueError, match="azimuth within 90"):
        posed.images(View(170.0))
    with pytest.raises(ValueError, match="unknown"):
        posed.images(View(expression=(("wink", 1.0),)))
    with pytest.raises(ValueError, match="K >= 1 views"):
        ViewRelighter(posed)(torch.zeros(1, 2, 48, 42), [View()], View())
    with pytest.raises(ValueError, match="rank >= 0"):
        ViewRelighter(posed, -1)
