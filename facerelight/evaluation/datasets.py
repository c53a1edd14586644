"""Bootstrap images from disk: Extended Yale B (as .npz or in its public folder layout) and CMU PIE."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from facerelight.geometry.lights import light_from_angles

__all__ = ["FaceImages", "load_pie", "load_yale", "to_grid"]


class FaceImages(NamedTuple):
    """Photographs of people under single lights, in linear radiance.

    ``images (M, H, W)`` float32 in 0..1; ``subject (M,)`` and ``light (M,)`` indices; ``lights (J, 3)``;
    ``angles (J, 2)`` azimuth and elevation in degrees; ``subset (M,)``: 1 to 5 by the light's angle from the camera
    axis (0 where not defined); ``names`` of subjects.
    """

    images: Tensor
    subject: Tensor
    light: Tensor
    lights: Tensor
    angles: Tensor
    subset: Tensor
    names: list[str]


def load_yale(path: str | Path, height: int = 96, width: int = 84) -> FaceImages:
    """Extended Yale B, cropped: the ``.npz`` file or a CroppedYale folder (``yaleB01/yaleB01_P00A+035E+40.pgm``).

    A positive azimuth is a light from image-left. Images of the ``.npz`` that are marked as bad captures, and files
    that end in ``.bad`` or hold no light (``Ambient``), are left out. Images are shrunk by area averages to
    ``height x width``.
    """
    path = Path(path)
    if path.is_dir():
        return _load_yale_folder(path, height, width)
    data = _open_npz(path, ("images", "subject", "azimuth_deg", "elevation_deg", "subset", "quality"))
    good = data["quality"] == 0
    images = _shrink(torch.from_numpy(data["images"][good]), height, width)
    angles = np.stack((data["azimuth_deg"], data["elevation_deg"]), 1)[good]
    return _index(images, data["subject"][good], angles, torch.from_numpy(data["subset"][good]).long())


def _load_yale_folder(folder: Path, height: int, width: int) -> FaceImages:
    pattern = re.compile(r"(yaleB\d+)_P00A([+-]\d{3})E([+-]\d{2})\.pgm$")
    images, subjects, angles = [], [], []
    for file in sorted(folder.glob("yaleB*/*.pgm")):
        match = pattern.search(file.name)
        if match:
            with Image.open(file) as image:
                pixels = torch.from_numpy(np.array(image.convert("L")))
            images.append(_shrink(pixels[None], height, width))
            subjects.append(match[1])
            angles.append((float(match[2]), float(match[3])))
    if not images:
        raise ValueError(f"{folder}: expected yaleBNN/yaleBNN_P00A+000E+00.pgm files, found none")
    table = np.array(angles)
    axis = np.rad2deg(np.arccos(np.cos(np.deg2rad(table[:, 0])) * np.cos(np.deg2rad(table[:, 1]))))
    subset = 1 + np.digitize(axis, (12.5, 25.5, 51.5, 77.5))
    return _index(torch.cat(images), np.array(subjects), table, torch.from_numpy(subset))


def load_pie(path: str | Path) -> FaceImages:
    """The ten people of CMU PIE under 21 flashes (``.npz``, 55 x 44), with the file's estimated flash directions."""
    data = _open_npz(
        Path(path), ("images", "subject", "flash", "flash_ids", "flash_est_azimuth_deg", "flash_est_elevation_deg")
    )
    place = {int(flash): i for i, flash in enumerate(data["flash_ids"])}
    order = np.array([place[int(flash)] for flash in data["flash"]])
    images = torch.from_numpy(data["images"]).float() / 255
    people, subject = np.unique(data["subject"], return_inverse=True)
    table = torch.from_numpy(np.stack((data["flash_est_azimuth_deg"], data["flash_est_elevation_deg"]), 1)).float()
    lights = light_from_angles(table[:, 0], table[:, 1])
    return FaceImages(
        images,
        torch.from_numpy(subject),
        torch.from_numpy(order),
        lights,
        table,
        torch.zeros(len(images), dtype=torch.long),
        [str(p) for p in people],
    )


def to_grid(faces: FaceImages) -> tuple[Tensor, Tensor]:
    """Arrange the photographs as ``images (N, J, H, W)``, zero where missing, and ``valid (N, J)``, for
    :meth:`FaceStatistics.fit`."""
    people, lights = len(faces.names), len(faces.lights)
    images = torch.zeros(people, lights, *faces.images.shape[1:])
    valid = torch.zeros(people, lights, dtype=torch.bool)
    images[faces.subject, faces.light] = faces.images
    valid[faces.subject, faces.light] = True
    return images, valid


def _open_npz(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as data:
            return {key: data[key] for key in keys}
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: expected an .npz file with {', '.join(keys)}; got {error}") from error


def _shrink(images: Tensor, height: int, width: int) -> Tensor:
    """uint8 ``(M, H, W)`` to float32 in 0..1 by area averages."""
    return torch.cat(
        [
            torch.nn.functional.interpolate(part[:, None].float() / 255, (height, width), mode="area")[:, 0]
            for part in images.split(256)
        ]
    )


def _index(images: Tensor, subjects: np.ndarray, angles: np.ndarray, subset: Tensor) -> FaceImages:
    people, subject = np.unique(subjects, return_inverse=True)
    table, light = np.unique(angles, axis=0, return_inverse=True)  # sorted by azimuth, then elevation
    degrees = torch.from_numpy(table).float()
    lights = light_from_angles(degrees[:, 0], degrees[:, 1])
    return FaceImages(
        images,
        torch.from_numpy(subject),
        torch.from_numpy(light.reshape(-1)),
        lights,
        degrees,
        subset,
        [str(p) for p in people],
    )
