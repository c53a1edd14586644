"""What shades crops: the promise that the fast path and the exact one keep."""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor, nn

from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.sums import LightSum

__all__ = ["UNSEEN", "CropRelighter", "Radiances", "Source"]

Source = Literal["estimate", "front"]
UNSEEN = 1e3  # radiance: noise of what a crop does not show


class Radiances(NamedTuple):
    """Faces under several lights, ``maps (B, Q, h, w)``, the first being their own: radiance in units in which the crop
    under its own light is the crop. ``explained (B, h, w)``, what the average face and the whole-face code make of the
    crop. ``known (B,)`` bool, whether it may be a lit face."""

    maps: Tensor
    explained: Tensor
    known: Tensor


class CropRelighter(nn.Module):
    """Radiance of aligned faces under new lights, a batch at a time; subclasses implement :meth:`forward`.

    Args:
        full_size: height and width of the crops that it is given.
        block: pixels of these along each side of one of its maps.
        margin: of its crop, see :class:`~facerelight.geometry.alignment.CropFrame`.
        n_mean: ``(3, h, w)``, albedo times normal of the average face on its maps.
    """

    normals: Tensor

    def __init__(self, full_size: tuple[int, int], block: int, margin: float, n_mean: Tensor) -> None:
        super().__init__()
        normals = nn.functional.normalize(n_mean.detach().float().permute(1, 2, 0), dim=-1)
        self.register_buffer("normals", normals, persistent=False)
        self.full_size, self.block, self.margin = full_size, block, margin
        self.size = (full_size[0] // block, full_size[1] // block)

    @property
    def frame(self) -> CropFrame:
        """The crop that it is given."""
        return CropFrame(self.full_size[0], self.full_size[1], self.margin)

    @property
    def map_frame(self) -> CropFrame:
        """The crop of its maps."""
        return CropFrame(self.size[0], self.size[1], self.margin)

    def forward(
        self, luminance: Tensor, mask: Tensor, targets: list[LightSum], source: Source = "estimate"
    ) -> Radiances:
        """Faces under their own light and under ``targets``.

        Args:
            luminance: ``(B, H, W)`` radiance, on the crop of the exact model.
            mask: ``(B, H, W)``, or ``(1, H, W)`` where it is everybody's; 0 where the crop does not show the face.
            targets: amounts ``(B, n)`` of a lamp's points, a light each; in front of the face.
            source: "estimate" finds the crops' light, "front" takes it to stand at the camera.
        """
        raise NotImplementedError(f"{type(self).__name__}: expected a method forward(luminance, mask, targets, source)")
