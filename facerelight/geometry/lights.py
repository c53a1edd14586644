"""Light directions: angles and unit vectors, sampling designs, moments and quadrature over the hemisphere of lights.

A light is a unit 3-vector that points from the face to the light: x to image-right, y up, z to the viewer. Angles are
in degrees: positive azimuth is a light from image-LEFT (hence the minus sign of eq. 4.1), positive elevation a light
from above.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = [
    "angle_grid",
    "angle_pairs",
    "angles_from_light",
    "angular_distance",
    "even_hemisphere",
    "hemisphere_moments",
    "hemisphere_quadrature",
    "light_from_angles",
    "merge_repeats",
    "nearest_lights",
    "thesis_grid",
    "unit_lights",
]


def light_from_angles(azimuth: Tensor | float, elevation: Tensor | float) -> Tensor:
    """Unit light vectors from angles (eq. 4.1).

    Args:
        azimuth: degrees, any shape; positive from image-left; 0 is the camera axis and +-180 lies behind the face.
        elevation: degrees in [-90, 90], broadcast against ``azimuth``; positive from above.

    Returns:
        Unit vectors, shape ``(..., 3)``, in the inputs' floating dtype (float32 for numbers).

    Raises:
        ValueError: an angle is not finite, or an elevation lies outside [-90, 90].

    Example:
        >>> light_from_angles(30.0, 0.0)
        tensor([-0.5000,  0.0000,  0.8660])
    """
    turn = azimuth if isinstance(azimuth, Tensor) else torch.tensor(azimuth, dtype=torch.float32)
    rise = elevation if isinstance(elevation, Tensor) else torch.tensor(elevation, dtype=torch.float32)
    if not (torch.isfinite(turn).all() and torch.isfinite(rise).all()):
        raise ValueError("light angles: expected finite degrees, got NaN or infinity")
    if (rise.abs() > 90).any():
        raise ValueError(f"elevation: expected degrees in [-90, 90], got {float(rise.abs().max()):g} in magnitude")
    try:
        turn, rise = torch.broadcast_tensors(torch.deg2rad(turn), torch.deg2rad(rise))
    except RuntimeError as error:
        raise ValueError(
            f"light angles: expected shapes that fit together, got {tuple(turn.shape)} and {tuple(rise.shape)}"
        ) from error
    horizontal = torch.cos(rise)
    return torch.stack((-horizontal * torch.sin(turn), torch.sin(rise), horizontal * torch.cos(turn)), dim=-1)


def angles_from_light(light: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth and elevation in degrees of light vectors ``(..., 3)`` of any positive length; the inverse of
    :func:`light_from_angles`.

    At the two poles, straight above and below, azimuth is undefined and 0 is returned.

    Example:
        >>> [round(float(a), 3) for a in angles_from_light(torch.tensor([-1.0, 0.0, 0.0]))]
        [90.0, 0.0]
    """
    x, y, z = unit_lights(light).unbind(-1)
    horizontal = torch.hypot(x, z)
    at_pole = horizontal < 4 * torch.finfo(light.dtype).eps
    azimuth = torch.where(at_pole, torch.zeros_like(x), torch.atan2(-x, z))
    return torch.rad2deg(azimuth), torch.rad2deg(torch.atan2(y, horizontal))


def angle_pairs(lights: Tensor) -> list[tuple[float, float]]:
    """``lights (J, 3)`` as (azimuth, elevation) in degrees, to a thousandth, the way a training config lists them."""
    return [(round(float(a), 3), round(float(e), 3)) for a, e in zip(*angles_from_light(lights), strict=True)]


def unit_lights(lights: Tensor) -> Tensor:
    """``lights`` ``(..., 3)`` scaled to unit length; a zero or non-finite light is a ``ValueError``."""
    if not isinstance(lights, Tensor):
        raise ValueError(f"lights: expected a tensor (..., 3), got {type(lights).__name__}; try torch.as_tensor")
    if lights.shape[-1:] != (3,) or not lights.is_floating_point():
        raise ValueError(f"lights: expected floating (..., 3), got {lights.dtype} {tuple(lights.shape)}")
    length = torch.linalg.vector_norm(lights, dim=-1, keepdim=True)
    if not torch.isfinite(length).all() or (length == 0).any():
        raise ValueError("lights: expected finite non-zero vectors, got a zero, NaN or infinite one")
    return lights / length


def angular_distance(a: Tensor, b: Tensor) -> Tensor:
    """Angle in degrees between lights ``(..., 3)``; exact to rounding for nearly equal and for opposite lights
    alike."""
    a, b = unit_lights(a), unit_lights(b)
    half = torch.linalg.vector_norm(a - b, dim=-1), torch.linalg.vector_norm(a + b, dim=-1)
    return torch.rad2deg(2 * torch.atan2(*half))


def nearest_lights(wanted: Tensor, lights: Tensor) -> Tensor:
    """For each of ``wanted (Q, 3)``, which of ``lights (J, 3)`` is nearest in angle: indices ``(Q,)``."""
    return angular_distance(wanted[:, None], lights[None]).argmin(1)


def thesis_grid() -> Tensor:
    """The thesis's 101 lights (4.2.1): 10 x 10 angles from -90 to 90 in steps of 20, and the frontal light last;
    ``(101, 3)``.

    Each pole stands in it ten times; :func:`merge_repeats` leaves 83 directions.
    """
    return torch.cat((angle_grid(10), torch.tensor([[0.0, 0.0, 1.0]])))


def angle_grid(count: int = 30) -> Tensor:
    """``count * count`` lights, evenly spaced in azimuth and elevation from -90 to 90 degrees (6.3 uses 30); poles
    repeat."""
    if count < 2:
        raise ValueError(f"count: expected at least 2, got {count}")
    angles = torch.linspace(-90.0, 90.0, count, dtype=torch.float64)
    azimuth, elevation = torch.meshgrid(angles, angles, indexing="ij")
    return light_from_angles(azimuth.flatten(), elevation.flatten()).float()


def even_hemisphere(count: int) -> Tensor:
    """``count`` lights spread evenly over the hemisphere in front of the face, the frontal one first; ``(count, 3)``.

    A golden-angle spiral of equal areas (Vogel 1979), so every light stands for the same solid angle.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    index = torch.arange(count, dtype=torch.float64)
    z = 1 - index / max(count, 1)
    turn = index * math.pi * (3 - math.sqrt(5))
    radius = torch.sqrt(1 - z**2)
    return torch.stack((radius * torch.cos(turn), radius * torch.sin(turn), z), dim=-1).float()


def merge_repeats(lights: Tensor, tolerance: float = 1e-3) -> tuple[Tensor, Tensor]:
    """Distinct directions among ``lights`` ``(J, 3)`` and, for each light, the index of its direction.

    Args:
        lights: unit vectors.
        tolerance: degrees within which two lights count as one.

    Returns:
        ``(directions (D, 3), index (J,))``, directions in the order in which they first occur.
    """
    same = angular_distance(lights[:, None].double(), lights[None].double()) <= tolerance  # (J, J)
    first = same.int().argmax(dim=1)
    kept, index = torch.unique(first, return_inverse=True)
    return lights[kept], index


def hemisphere_moments() -> tuple[Tensor, Tensor]:
    """``E[s]`` ``(3,)`` and ``E[s s^T]`` ``(3, 3)`` of a light uniform over the hemisphere (Appendix B, eq. 6.1)."""
    return torch.tensor([0.0, 0.0, 0.5]), torch.eye(3) / 3


def hemisphere_quadrature(order: int = 12) -> tuple[Tensor, Tensor]:
    """Nodes ``(Q, 3)`` and weights ``(Q,)``, which sum to 1, for means over the uniform hemisphere;
    ``Q = 2 * order**2``.

    Gauss-Legendre along the camera axis times equal steps around it: exact for polynomials of the light up to degree
    ``2 order - 1``.

    Example:
        >>> nodes, weights = hemisphere_quadrature(4)
        >>> torch.allclose(weights @ nodes, hemisphere_moments()[0], atol=1e-6)
        True
    """
    if order < 1:
        raise ValueError(f"order: expected at least 1, got {order}")
    # Golub and Welsch: Legendre nodes are the eigenvalues of the Jacobi matrix.
    k = torch.arange(1, order, dtype=torch.float64)
    jacobi = torch.diag(k / torch.sqrt(4 * k**2 - 1), 1)
    nodes, vectors = torch.linalg.eigh(jacobi + jacobi.T)
    z, weight = (nodes + 1) / 2, vectors[0] ** 2
    turn = torch.arange(2 * order, dtype=torch.float64) * math.pi / order
    radius = torch.sqrt(1 - z**2)
    light = torch.stack(
        (
            radius[:, None] * torch.cos(turn),
            radius[:, None] * torch.sin(turn),
            z[:, None].expand(-1, 2 * order),
        ),
        dim=-1,
    )
    return light.reshape(-1, 3).float(), (weight[:, None].expand(-1, 2 * order) / (2 * order)).flatten().float()
