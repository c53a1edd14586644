"""Registration: small affine deformations that bring faces into step with the model, each with a Gaussian prior.

Landmarks are marked or found inexactly and faces differ in proportion, so the same pixel is not the same place on two
faces. A deformation ``theta (6,)`` takes places of the model to places of the image: shifts (in image widths), scale,
rotation (radians), stretch and shear. It is found by Gauss and Newton's method on the correlation of local contrast,
which light hardly changes, with its prior as the penalty.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from facerelight.numerics.checks import check_radiance, check_valid
from facerelight.numerics.gaussian import safe_cholesky

__all__ = ["align_people", "congeal", "deform", "register", "undeform"]

SPREAD = (0.02, 0.02, 0.05, 0.03, 0.04, 0.03)
"""Standard deviations of the prior: shifts in image widths, scale, rotation, stretch, shear."""

ROUNDS = 12
COARSE_TO_FINE = (4, 2, 1)  # so that a large shift is not missed; places are in image widths, whatever the resolution
COARSEST = 20  # pixels of width
NEAR_CAMERA = 0.85  # cosine
REACH = 3.0  # standard deviations; no step goes further


def deform(images: Tensor, theta: Tensor) -> Tensor:
    """Bring ``images (..., H, W)`` into the model's place by ``theta (6,)``; bicubic, borders repeated."""
    return _warp(images, torch.linalg.inv(_matrix(theta, images.shape[-2:])))


def undeform(images: Tensor, theta: Tensor) -> Tensor:
    """The way back: ``images (..., H, W)`` of the model into the photographed face's place."""
    return _warp(images, _matrix(theta, images.shape[-2:]))


def register(
    images: Tensor, template: Tensor, start: Tensor | None = None, weight: Tensor | None = None, penalty: float = 0.006
) -> Tensor:
    """The deformation that takes ``template`` to ``images``, ``(M, H, W)`` each, one for all M.

    Args:
        images: of one face.
        template: what the model expects under the same lights.
        start: ``(6,)``, where to begin, at full resolution; None: at the model's own place, from coarse to fine.
        weight: ``(H, W)``, where the images show the face; None: everywhere.
        penalty: what one standard deviation of the prior costs beside 1 - correlation; on real faces 0.004 to 0.012 do
            equally well.

    Returns:
        ``theta (6,)``; zero for images without any contrast.

    Example:
        >>> face = torch.rand(1, 32, 28).cumsum(1).cumsum(2) / 400
        >>> register(face, face).abs().max() < 1e-3
        tensor(True)
    """
    theta = torch.zeros(6, dtype=torch.float64) if start is None else start.double().cpu()  # six numbers
    weight = images.new_ones(images.shape[-2:]) if weight is None else weight.to(images)
    for scale in COARSE_TO_FINE if start is None else (1,):
        height, width = images.shape[-2] // scale, images.shape[-1] // scale
        if scale == 1 or width >= COARSEST:
            seen, wanted, mask = (_shrink(x, (height, width)) for x in (images, template, weight[None]))
            theta = _descend(seen, wanted, theta, mask[0], penalty)
    return theta.to(images)


def _descend(images: Tensor, template: Tensor, theta: Tensor, weight: Tensor, penalty: float) -> Tensor:
    """Gauss and Newton's steps from ``theta`` at one resolution."""
    size = images.shape[-2:]
    weight = _middle(size).to(weight) * weight
    contrast = local_contrast(images)
    wanted = (local_contrast(template) * weight).flatten()
    wanted = wanted / wanted.norm().clamp_min(1e-12)
    ways = _ways(size).to(images)  # d place / d theta, (6, 2, H, W)
    spread = torch.tensor(SPREAD, dtype=torch.float64)
    prior = torch.diag(2 * penalty / spread.square())
    if float(contrast.abs().max()) < 1e-6:
        return theta
    for _ in range(ROUNDS):
        moved = deform(contrast, theta.to(images))
        down, right = torch.gradient(moved, dim=(1, 2))
        slope = (right * ways[:, None, 0] + down * ways[:, None, 1]) * size[1]  # (6, M, H, W)
        length = (moved * weight).norm().clamp_min(1e-12)
        seen = (moved * weight).flatten() / length
        jacobian = (slope * weight).flatten(1) / length
        jacobian = (jacobian - torch.outer(jacobian @ seen, seen)).double()  # of the normalised contrast
        factor = safe_cholesky((jacobian @ jacobian.T).cpu() + prior)
        descent = (jacobian @ (wanted - seen).double()).cpu() - prior @ theta
        theta = theta + torch.cholesky_solve(descent[:, None], factor)[:, 0]
        theta = torch.maximum(torch.minimum(theta, REACH * spread), -REACH * spread)
    return theta


def _shrink(images: Tensor, size: tuple[int, int]) -> Tensor:
    """``images (M, H, W)`` by area averages."""
    return images if images.shape[-2:] == size else interpolate(images[:, None], size, mode="area")[:, 0]


def congeal(faces: Tensor, rounds: int = 4) -> Tensor:
    """Deformations ``(N, 6)`` that bring ``faces (N, H, W)`` into step with each other, their mean being none
    (Learned-Miller 2006).

    Args:
        faces: one picture a person, all under the same light or mean light.
        rounds: how often every face is registered to the mean of the others.
    """
    theta = torch.zeros(len(faces), 6)
    for turn in range(rounds):
        moved = torch.stack([deform(face[None], t)[0] for face, t in zip(faces, theta, strict=True)])
        moved = moved / moved.mean((1, 2), keepdim=True).clamp_min(1e-6)
        total = moved.sum(0)
        theta = torch.stack(
            [
                register(face[None], (total - own)[None], t if turn else None)
                for face, own, t in zip(faces, moved, theta, strict=True)
            ],
        )
        theta = theta - theta.mean(0)
    return theta


def align_people(images: Tensor, lights: Tensor, valid: Tensor | None = None) -> Tensor:
    """A bootstrap of photographs, every person moved into step with the others; for :meth:`FaceStatistics.fit`.

    Args:
        images: ``(N, J, H, W)`` linear radiance.
        lights: ``(J, 3)`` unit vectors; a person is judged by the mean picture under the lights near the camera.
        valid: ``(N, J)``, which images exist; None: all.

    Raises:
        ValueError: somebody without any picture under those lights.
    """
    check_radiance(images, "images", "N J H W", (len(lights), None, None), missing=True)
    there = torch.ones(images.shape[:2], dtype=torch.bool)
    if valid is not None:
        there = check_valid(valid, "valid", "N J", images.shape[:2])
    there = there & (lights[:, 2] > NEAR_CAMERA)
    if not there.any(1).all():
        raise ValueError(
            "images: expected one within 32 degrees of the camera for everybody,"
            f" got none for {int((~there.any(1)).sum())}"
        )
    shown = torch.where(there[..., None, None], images, 0.0)
    average = (shown.sum((0, 2, 3)) / there.sum(0).clamp_min(1)).clamp_min(1e-6)  # brightness under each light
    faces = (shown / average[:, None, None]).sum(1) / there.sum(1)[:, None, None]
    return torch.stack(
        [deform(person, theta).clamp_min(0) for person, theta in zip(images, congeal(faces), strict=True)]
    )


def local_contrast(images: Tensor) -> Tensor:
    """``(image - blurred) / blurred`` of ``(M, H, W)``: edges and features, whatever the shading; near zero in the
    dark."""
    side = max(3, images.shape[-1] // 9 | 1)
    from kornia.filters import box_blur  # only registration needs it

    blurred = box_blur(images[:, None], (side, side), "replicate")[:, 0]
    return (images - blurred) / (blurred.clamp_min(0) + 0.1 * images.mean((1, 2), keepdim=True).clamp_min(1e-6))


def _ways(size: tuple[int, int] | torch.Size) -> Tensor:
    """How each of the six moves a place, ``(6, 2, H, W)`` in image widths, about the middle."""
    height, width = size
    y, x = torch.meshgrid(
        (torch.arange(height) - (height - 1) / 2) / width,
        (torch.arange(width) - (width - 1) / 2) / width,
        indexing="ij",
    )
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    return torch.stack([torch.stack(way) for way in ((one, zero), (zero, one), (x, y), (-y, x), (x, -y), (y, x))])


def _matrix(theta: Tensor, size: tuple[int, int] | torch.Size) -> Tensor:
    """``(3, 3)`` from pixels of the model to pixels of the image, float64."""
    height, width = size
    right, down, scale, rotation, stretch, shear = theta.double().cpu().unbind()
    linear = torch.stack(
        (torch.stack((1 + scale + stretch, shear - rotation)), torch.stack((shear + rotation, 1 + scale - stretch))),
    )
    middle = torch.tensor(((width - 1) / 2, (height - 1) / 2), dtype=torch.float64)
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2, :2] = linear
    matrix[:2, 2] = middle - linear @ middle + width * torch.stack((right, down))
    return matrix


def _warp(images: Tensor, matrix: Tensor) -> Tensor:
    """kornia's affine warp of ``(..., H, W)``; ``matrix (3, 3)`` from places in ``images`` to places in the result."""
    flat = images.reshape(1, -1, *images.shape[-2:])
    from kornia.geometry.transform import warp_affine

    moved = warp_affine(
        flat,
        matrix[None, :2].to(flat),
        (images.shape[-2], images.shape[-1]),
        mode="bicubic",
        padding_mode="border",
        align_corners=True,
    )
    return moved.reshape(images.shape)


def _middle(size: tuple[int, int] | torch.Size) -> Tensor:
    """Weights ``(H, W)`` that fall off towards the borders, where hair and background begin."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size[0]), torch.linspace(-1, 1, size[1]), indexing="ij")
    return torch.exp(-2 * (x.square() + y.square()).square())
