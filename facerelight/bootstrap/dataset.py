"""The bootstrap: rendered people under a set of lights, as a torch dataset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.heads import HeadSource
from facerelight.bootstrap.look.hair import SHORN, Hairstyle
from facerelight.bootstrap.look.scalp import Scalp, grow_hair
from facerelight.bootstrap.look.skin import Look
from facerelight.bootstrap.posture import place_in_frame, rotate, stand
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.bootstrap.surface import Surface, view_surface
from facerelight.geometry.alignment import CropFrame

__all__ = ["BootstrapDataset", "RenderedHead", "open_renderer"]

HEAD_REACH = (
    3.2  # half the side of the shadow map, in distances between the eyes: the head, turned or not, not its shoulders
)


class RenderedHead(NamedTuple):
    """``subject`` index, ``images (J, H, W)`` linear radiance, ``work``: effect passes and pixels run and skipped."""

    subject: int
    images: Tensor
    work: Counter[str]


def open_renderer(frame: CropFrame, supersample: int = 1) -> MeshRenderer:
    """A renderer for heads placed in ``frame``."""
    eyes = frame.landmarks[:2]
    extent = HEAD_REACH * float(torch.linalg.vector_norm(eyes[1] - eyes[0]))
    return MeshRenderer(frame.height, frame.width, extent=extent, supersample=supersample)


class BootstrapDataset(Dataset[RenderedHead]):
    """Rendered people: item ``i`` is person ``i`` under all ``lights``.

    Args:
        source: where heads come from.
        count: how many people.
        lights: ``(J, 3)`` unit vectors.
        frame: the crop to render.
        domain: settings of paint and light.
        seed: of the paint; the heads have their own.
        effects: "auto" (only what each scene calls for), "all", or names; the images are the same for the first two.
        supersample: samples a pixel along each side, averaged.
        pose: azimuth and elevation of the camera in degrees; a turned head stays at the size and place of its upright
            landmarks.

    A renderer is opened in the process (or worker) that first asks for an item.
    """

    def __init__(
        self,
        source: HeadSource,
        count: int,
        lights: Tensor,
        frame: CropFrame,
        domain: Domain | None = None,
        seed: int = 0,
        effects: str | Iterable[str] = "auto",
        supersample: int = 1,
        pose: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        if count < 1:
            raise ValueError(f"count: expected at least 1 head, got {count}")
        self.source, self.count, self.lights, self.frame = source, count, lights, frame
        self.domain, self.seed, self.effects, self.supersample = domain or Domain(), seed, effects, supersample
        self.pose = pose
        self._renderer: MeshRenderer | None = None
        self._scalp: Scalp | None = None

    def __len__(self) -> int:
        return self.count

    @property
    def renderer(self) -> MeshRenderer:
        """This process's renderer, opened when it is first asked for."""
        if self._renderer is None:
            self._renderer = open_renderer(self.frame, self.supersample)
        return self._renderer

    def look(self, index: int) -> Look:
        """Person ``index``'s paint and hair."""
        look = Look.random(np.random.default_rng((self.seed, index, 1)), self.domain)
        return replace(look, style=Hairstyle.random(np.random.default_rng((self.seed, index, 4))))

    def surface(self, index: int) -> tuple[Surface, Material]:
        """Person ``index``, painted and seen by the camera, and their material."""
        look, head = self.look(index), self.source.head(index)
        if head.reference is head.vertices:  # a scan of one's own, with no average head behind it and hair of its own
            look = replace(look, style=SHORN)
        else:
            if self._scalp is None:
                self._scalp = Scalp.fit(head)
            head = grow_hair(head, self._scalp, look)
        upright = stand(head, np.random.default_rng((self.seed, index, 2)), self.domain)
        head = place_in_frame(rotate(upright, *self.pose), self.frame, upright.landmarks)
        return view_surface(self.renderer, head, look), look.material

    def __getitem__(self, index: int) -> RenderedHead:
        if not 0 <= index < self.count:
            raise IndexError(f"head {index} of {self.count}")
        surface, material = self.surface(index)
        work: Counter[str] = Counter(geometry=1)
        images = []
        for light in self.lights:
            plan = plan_effects(surface, light, material, self.effects)
            images.append(shade(surface, light, material, plan, self.renderer, work))
        stack = torch.stack(images)
        if self.supersample > 1:
            stack = torch.nn.functional.avg_pool2d(stack[:, None], self.supersample)[:, 0]
        return RenderedHead(index, stack, work)

    def images(self, indices: Iterable[int] | None = None) -> Tensor:
        """Images ``(N, J, H, W)`` of the heads ``indices`` (default: all); the renderer is released."""
        rendered = torch.stack([self[index].images for index in (range(self.count) if indices is None else indices)])
        self.close()
        return rendered

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
