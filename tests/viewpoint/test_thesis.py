"""The thesis's own ways."""

import torch

from facerelight.geometry.lights import even_hemisphere
from facerelight.model.statistics import FaceStatistics
from facerelight.viewpoint.pose import View
from facerelight.viewpoint.regions import GroupRelighter, make_regions, random_groups
from facerelight.viewpoint.thesis import POSES, GridViews, PrintedGroups
from facerelight.viewpoint.views import LightViews


class Ramp:
    """Three people whose grey level is the azimuth."""

    size = (2, 3)

    def images(self, view: View) -> torch.Tensor:
        return torch.full((3, *self.size), view.azimuth / 90) + torch.arange(3.0)[:, None, None]


def test_poses_lie_between_those_rendered() -> None:
    assert len(set(POSES)) == 45
    views = GridViews(Ramp(), 4.0)  # type: ignore[arg-type]
    at, between = POSES[21], View((POSES[21].azimuth + POSES[24].azimuth) / 2, POSES[21].elevation)
    found = views.fields([at, between])
    assert torch.allclose(found.mean[0], torch.full((6,), at.azimuth / 90 + 1), atol=1e-3)
    assert POSES[21].azimuth / 90 < float(found.mean[1, 0]) - 1 < POSES[24].azimuth / 90
    assert torch.allclose(found.fields[0, :, :, 0], torch.tensor([-1.0, 0, 1]).expand(2, -1), atol=1e-4)


def test_as_printed_another_block_is_inverted() -> None:
    """(5.2) takes the deviation's covariance at the output light: right where both lights are one."""
    lights = even_hemisphere(8)
    people = torch.rand(12, 8, 4, 5, generator=torch.Generator().manual_seed(0))
    views = LightViews(FaceStatistics.fit(people, lights, rank=2, kernel_width=0.05))
    regions = make_regions(random_groups(20, 2, torch.Generator().manual_seed(0)))
    image = people[:1, :1]
    for target, same in ((lights[0], True), (lights[5], False)):
        right = GroupRelighter(views, regions, "sample")(image, lights[:1], target).mean
        printed = PrintedGroups(views, regions, "sample")(image, lights[:1], target).mean
        assert torch.allclose(right, printed, atol=1e-4) == same
