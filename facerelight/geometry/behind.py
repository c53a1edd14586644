"""Light from behind a face, of which a model of lights in front says nothing: its nearest side, and what it reaches."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["nearest_side", "share_reached"]

NORMALS_ERR = 0.15  # cosine: beyond the edge of a light, how far the average face's normals may be off


def nearest_side(directions: Tensor) -> Tensor:
    """Unit ``directions (..., 3)``, those behind the face moved to its nearest side; zero where one is exactly behind.

    Example:
        >>> nearest_side(torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.6, 0.8]]))
        tensor([[1.0000, 0.0000, 0.0000],
                [0.0000, 0.6000, 0.8000]])
    """
    front = torch.cat((directions[..., :2], directions[..., 2:].clamp_min(0)), -1)
    return front / torch.linalg.vector_norm(front, dim=-1, keepdim=True).clamp_min(1e-6)


def share_reached(normals: Tensor, directions: Tensor) -> Tensor:
    """What is left of a lamp where those of its points that are behind the face are taken for their nearest side: by
    Lambert's cosine on the average face, softened as far as its normals may err.

    Args:
        normals: unit, ``(h, w, 3)``.
        directions: ``(..., n, 3)`` unit vectors to the lamp's points.

    Returns:
        ``(..., h, w)`` in 0 to 1; 1 for a lamp in front.

    Example:
        >>> ahead = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> share_reached(ahead, torch.tensor([[0.6, 0.0, -0.8]]))
        tensor([[0.]])
    """
    towards = normals.flatten(0, 1).T  # (3, P)
    full = (nearest_side(directions) @ towards + NORMALS_ERR).clamp_min(1e-3)  # (..., n, P)
    left = torch.minimum((directions @ towards + NORMALS_ERR).clamp_min(0), full)
    left = torch.where(directions[..., 2:] < 0, left, full)
    return (left.sum(-2) / full.sum(-2)).unflatten(-1, normals.shape[:2])
