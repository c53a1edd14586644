"""The augmentation among torchvision's transforms (v2), without asking for torchvision."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten, tree_unflatten

from facerelight.augment.random_face_relight import RandomFaceRelight

__all__ = ["TorchvisionFaceRelight"]

TENSORS = "torchvision.tv_tensors"


class TorchvisionFaceRelight(nn.Module):
    """:class:`~facerelight.augment.random_face_relight.RandomFaceRelight` as a step of
    ``torchvision.transforms.v2.Compose``.

    It takes samples as those transforms do: an image, or dictionaries, lists and tuples with images in them. Images are
    Pillow's, ``tv_tensors.Image``, or, where a sample has neither, its first plain tensor; ``(..., C, H, W)``, 8-bit or
    floating. All images of a sample get one lamp, and come back as they came in; whatever else there is passes.

    Args:
        relight: what is applied, with its own probability and frame.

    Example:
        >>> step = TorchvisionFaceRelight(RandomFaceRelight(p=1.0))
        >>> image, label = step(torch.randint(256, (3, 112, 112), dtype=torch.uint8), 3)
        >>> image.dtype, label
        (torch.uint8, 3)
    """

    def __init__(self, relight: RandomFaceRelight) -> None:
        super().__init__()
        self.relight = relight

    def forward(self, *inputs: Any) -> Any:
        """Relight the images of a sample."""
        flat, structure = tree_flatten(inputs if len(inputs) > 1 else inputs[0])
        chosen = [index for index, part in enumerate(flat) if isinstance(part, Image.Image) or _is_tv_image(part)]
        if not chosen:
            chosen = [index for index, part in enumerate(flat) if type(part) is Tensor][:1]
        lamp = self.relight.forward_parameters(torch.Size((1, 3, 112, 112)))
        for index in chosen:
            flat[index] = self._relit(flat[index], lamp)
        return tree_unflatten(flat, structure)

    def _relit(self, image: Any, lamp: dict[str, Tensor]) -> Any:
        if isinstance(image, Image.Image):
            if image.mode not in ("L", "RGB"):
                raise ValueError(f"image: expected a picture of mode L or RGB, got {image.mode}; try .convert('RGB')")
            pixels = torch.from_numpy(np.array(image)).reshape(image.height, image.width, -1).permute(2, 0, 1)
            relit = self._relit_tensor(pixels, lamp).permute(1, 2, 0).numpy()
            return Image.fromarray(relit[..., 0] if image.mode == "L" else relit)
        return self._relit_tensor(image.as_subclass(Tensor), lamp).as_subclass(type(image))

    def _relit_tensor(self, image: Tensor, lamp: dict[str, Tensor]) -> Tensor:
        """Of ``(..., C, H, W)``."""
        if image.dtype != torch.uint8 and not image.is_floating_point():
            raise ValueError(f"image: expected 8-bit or floating values, got {image.dtype}")
        values = image / 255 if image.dtype == torch.uint8 else image
        batch = values.reshape(-1, *image.shape[-3:])
        drawn = {name: part.expand(len(batch)) if part.shape == (1,) else part for name, part in lamp.items()}
        relit = self.relight(batch, params=drawn).reshape(image.shape)
        return (relit * 255).round().to(torch.uint8) if image.dtype == torch.uint8 else relit


def _is_tv_image(part: Any) -> bool:
    return type(part).__module__.startswith(TENSORS) and type(part).__name__ == "Image"
