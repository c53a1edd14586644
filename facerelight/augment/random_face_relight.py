"""The augmentation that knows what a face is: crops under random lamps, shaded by the model."""

from __future__ import annotations

from typing import Any, Literal

import torch
from kornia.augmentation import IntensityAugmentationBase2D
from torch import Tensor

from facerelight.augment.colour import linear_luminance, raised_radiance, scene_luminance, to_display
from facerelight.augment.crop_relighter import CropRelighter, Source
from facerelight.augment.frames import FaceWarp, Frame, frame_landmarks
from facerelight.augment.lamps import LampGenerator, Range, camera_lamps, fill_lamps, lamp_points
from facerelight.augment.quick import QuickRelighter
from facerelight.augment.ratio import face_mask, log_ratio
from facerelight.geometry.behind import nearest_side, share_reached
from facerelight.geometry.sums import LightSum

__all__ = ["RandomFaceRelight"]

Encoding = Literal["srgb", "linear"]

FARTHEST = 0.5  # beyond 0..1: what noise and other augmentations leave there is clamped
BEYOND = 0.01  # share of a crop that may lie farther: more of it is in another range


class RandomFaceRelight(IntensityAugmentationBase2D):
    """Relight aligned crops of faces by a lamp at a random place.

    The statistics are read and the fast path is made at construction, which takes some seconds; ``forward`` opens no
    file and looks for no face: a plain wall is relit as a face would be. Crops that are black, not finite, or of a
    contrast far from any that light makes on the average face, such as large black and white tiles, come back as they
    were, and ``params["relit"] (B,)`` bool says which were relit.

    Args:
        frame: where the face lies: "arcface112" or "yale", at any size, or three landmarks in pixels (x, y), eye at
            image-left, other eye, middle of the mouth. A call with ``landmarks=(B, 3, 2)`` overrides it.
        azimuth: limits of the lamp's azimuth in degrees, positive at image-left; beyond 90 it stands behind the face
            and lights its rim alone.
        elevation: limits of its elevation, positive above; within both, lamps are uniform over the sphere.
        size: limits of its angular radius: 1 a bare bulb, 15 a soft box.
        fill: limits of the share of light from all around.
        mix: limits of the share of its own light that a crop keeps.
        source: "estimate" finds each crop's own light; "front" takes it to come from the camera, which is wrong for
            any other.
        encoding: "srgb", as pictures are, or "linear" radiance.
        relighter: what shades faces; None: the packaged statistics on the fast path. An
            :class:`~facerelight.augment.exact.ExactRelighter` is many times slower.
        p, same_on_batch, keepdim: as in kornia.

    Input is ``(B, C, H, W)``, ``(C, H, W)`` or ``(H, W)`` floating in 0..1, of one channel or three; output is of the
    same dtype and device. What noise or another augmentation leaves a little outside counts as 0 or 1; normalise after
    this, not before.

    Example:
        >>> crops = torch.rand(2, 3, 112, 112)
        >>> augment = RandomFaceRelight(p=1.0)
        >>> augment(crops).shape
        torch.Size([2, 3, 112, 112])
        >>> bool((augment(crops, params=augment._params) == augment(crops, params=augment._params)).all())
        True
    """

    def __init__(
        self,
        frame: Frame = "arcface112",
        azimuth: Range = (-75.0, 75.0),
        elevation: Range = (-30.0, 60.0),
        size: Range = (2.0, 20.0),
        fill: Range = (0.05, 0.3),
        mix: Range = (0.0, 0.2),
        source: Source = "estimate",
        encoding: Encoding = "srgb",
        relighter: CropRelighter | None = None,
        p: float = 0.5,
        same_on_batch: bool = False,
        keepdim: bool = False,
    ) -> None:
        super().__init__(p=p, same_on_batch=same_on_batch, p_batch=1.0, keepdim=keepdim)
        for name, value, known in (
            ("source", source, ("estimate", "front")),
            ("encoding", encoding, ("srgb", "linear")),
        ):
            if value not in known:
                raise ValueError(f"{name}: expected {known[0]!r} or {known[1]!r}, got {value!r}")
        frame_landmarks(frame, 112, 112)
        self._param_generator = LampGenerator(azimuth, elevation, size, fill, mix)
        self.flags = {"frame": frame, "source": source, "encoding": encoding}
        if relighter is None:
            from facerelight.photo.face_model import load_relighter

            relighter = QuickRelighter(load_relighter())
        self.relighter = relighter

    def forward(  # type: ignore[override]
        self, input: Tensor, params: dict[str, Tensor] | None = None, landmarks: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        """Relight ``input``.

        Args:
            input: crops.
            params: of an earlier call, to do the same again.
            landmarks: ``(B, 3, 2)`` pixels, where each face lies; None: where ``frame`` says.

        Raises:
            ValueError: landmarks that do not fit, channels that are neither one nor three, or crops in another range.
        """
        if landmarks is not None:
            params = self.forward_parameters(self.transform_tensor(input).shape) if params is None else dict(params)
            params["landmarks"] = landmarks
        return super().forward(input, params, **kwargs)

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Relight crops ``(B, C, H, W)`` by the lamps of ``params``."""
        count, channels, *size = input.shape
        if channels not in (1, 3):
            raise ValueError(f"crops: expected one channel or three, got {channels}")
        marks = self._landmarks(params, flags, count, size).to(input.device)
        work = input.to(torch.float64 if input.dtype == torch.float64 else torch.float32)
        finite = torch.isfinite(work).flatten(1).all(1)
        clean = torch.where(finite[:, None, None, None], work, 0)
        _refuse_other_ranges(clean)
        clean = clean.clamp(0, 1)
        coded = flags["encoding"] == "srgb"
        raised = raised_radiance(clean) if coded else clean
        seen = scene_luminance(raised) if coded else linear_luminance(raised)
        shift, known = self._log_ratios(seen, marks, params, flags["source"])
        known = known & finite
        if self.p < 1:  # at 1 kornia does not ask it
            known = known & (params["batch_prob"].to(known.device) > 0.5)
        mix = params["mix"].to(seen)[:, None, None, None]
        ratio = (1 - mix) * shift.exp() + mix
        relit = to_display(raised, ratio) if coded else (raised * ratio).clamp(0, 1)
        params["relit"] = known
        self._params["relit"] = known
        return torch.where(known[:, None, None, None], relit.to(input), input)

    def _landmarks(self, params: dict[str, Tensor], flags: dict[str, Any], count: int, size: list[int]) -> Tensor:
        """``(B or 1, 3, 2)`` float64."""
        given = params.get("landmarks")
        if given is None:
            return frame_landmarks(flags["frame"], size[0], size[1])[None]
        if not isinstance(given, Tensor) or given.shape != (count, 3, 2):
            got = tuple(given.shape) if isinstance(given, Tensor) else repr(given)
            raise ValueError(f"landmarks: expected a tensor ({count}, 3, 2) in pixels, got {got}")
        return given.double()

    def _log_ratios(
        self, seen: Tensor, marks: Tensor, params: dict[str, Tensor], source: Source
    ) -> tuple[Tensor, Tensor]:
        """Log ratios ``(B, 1, H, W)`` on the crops of luminance ``seen (B, 1, H, W)``, and which are known to be faces,
        ``(B,)``."""
        relighter = self.relighter.to(seen.device)
        full, frame = relighter.frame, relighter.map_frame
        warp = FaceWarp(marks, (seen.shape[2], seen.shape[3]), full)
        on_model = warp.to_model(seen)[:, 0]  # (B, h, w)
        shown = warp.shown().to(seen) * face_mask(full).to(seen)
        count = len(seen)
        lamp = lamp_points(*(params[name].to(seen.device) for name in ("azimuth", "elevation", "size")))
        side = LightSum(nearest_side(lamp.directions), lamp.amounts)
        faces = relighter(on_model, shown, [camera_lamps(count), side, fill_lamps(count)], source)
        if bool((lamp.directions[..., 2] < 0).any()):
            reached = share_reached(relighter.normals.to(seen), lamp.directions.to(seen))
            whole = torch.ones_like(reached)
            faces = faces._replace(maps=faces.maps * torch.stack((whole, whole, reached, whole), 1))
        coarse, where = (
            torch.nn.functional.avg_pool2d(part[:, None], relighter.block)[:, 0] for part in (on_model, shown)
        )
        shift = log_ratio(faces, coarse, where, params["fill"].to(seen), params["size"].to(seen), frame)
        return warp.to_crop(shift[:, None]), faces.known


def _refuse_other_ranges(crops: Tensor) -> None:
    beyond = (crops < -FARTHEST) | (crops > 1 + FARTHEST)
    if bool((beyond.flatten(1).float().mean(1) > BEYOND).any()):
        raise ValueError(
            f"crops: expected values in 0..1, got {float(crops.min()):g} to {float(crops.max()):g};"
            " divide values of 0..255 by 255, and normalise after this augmentation"
        )
