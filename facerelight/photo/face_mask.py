"""Which pixels of an aligned crop show the face."""

from __future__ import annotations

import cv2
import torch
from torch import Tensor

from facerelight.geometry.alignment import CropFrame

__all__ = ["face_mask"]


def face_mask(crop: Tensor, frame: CropFrame) -> Tensor:
    """Where the face is in the crop, 0 to 1: an oval around the landmarks, less what does not look like its skin (hair,
    glasses, hats).

    Args:
        crop: ``(3, h, w)`` linear.
        frame: the crop.
    """
    radius, eyes = frame.oval(), frame.landmarks[:2]
    around = ((1.25 - radius) / 0.25).clamp(0, 1)  # jaw, ears and neck, where they look like skin
    y = torch.arange(frame.height)[:, None]
    core = (radius < 0.7) & ((y - eyes[0, 1]).abs() > 0.3 * (eyes[1, 0] - eyes[0, 0]))  # without the eyes
    brightness = crop.sum(0).clamp_min(1e-4)
    chroma = crop[:2] / brightness
    features = torch.cat((chroma * 12, 0.5 * torch.log(brightness)[None]))
    sample = features[:, core]
    centre = sample.median(1).values
    spread = (sample - centre[:, None]).abs().median(1).values.clamp_min(0.15) * 1.5
    distance = ((features - centre[:, None, None]) / spread[:, None, None]).clamp(-6, 6).square().sum(0).sqrt()
    skin = (1 - (distance - 2.5) / 1.5).clamp(0, 1)
    unit = float(eyes[1, 0] - eyes[0, 0])
    below_fringe = ((y - eyes[0, 1]) / unit + 0.5).div(0.15).clamp(0, 1)
    inner = ((0.72 - radius) / 0.15).clamp(
        0, 1
    ) * below_fringe  # brows, eyes, lips and shadows inside belong to the face
    mask = torch.maximum(around * skin, inner)
    guide = (0.5 * brightness / brightness[core].median().clamp_min(1e-4)).clamp(0, 1).sqrt()  # dark skin like fair
    edges = (guide * 255).round().byte().numpy()
    smooth = torch.from_numpy(cv2.ximgproc.guidedFilter(edges, mask.float().numpy(), 3, 1e-3 * 255**2)).clamp(0, 1)
    return (smooth * around).float()
