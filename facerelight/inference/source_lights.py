"""Source lights as they are given, known or not, brought to one form: equally likely sums of directions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from facerelight.geometry.sources import LightMixture
from facerelight.geometry.sums import LightSum, check_light_sum
from facerelight.inference.posterior import Lights

__all__ = ["known_sums", "middle_light", "source_sums"]


def source_sums(given: Lights | None, images: Tensor, draws: int, find: Callable[[int], LightSum]) -> LightSum:
    """Equally likely lights of ``images (B, K, H, W)``, amounts ``(B, M, K, n)``: those ``given``, and samples of those
    that are not, of which ``find`` makes as many as it is asked for.

    Raises:
        ValueError: lights that do not fit the images, or less than one draw of unknown ones.
    """
    count, inputs = images.shape[:2]
    if given is None:
        lights = torch.full((count, inputs, 3), float("nan")).to(images)
    elif isinstance(given, LightSum | LightMixture):
        return known_sums(given, count, inputs).to(images)
    elif not isinstance(given, Tensor) or given.dim() < 2:
        raise ValueError(f"source lights: expected a tensor (K, 3) or more of them, got {given!r}")
    else:
        lights = given.to(images)
    if lights.dim() == 2:
        lights = lights.expand(count, -1, -1)
    known = lights if lights.dim() == 4 else lights[:, None]
    if known.dim() != 4 or not known.shape[1] or (len(known), *known.shape[2:]) != (count, inputs, 3):
        raise ValueError(
            f"source lights: expected (K, 3), (B, K, 3) or (B, M, K, 3) for images {tuple(images.shape[:2])},"
            f" got {tuple(lights.shape)}"
        )
    unknown = known.isnan().any(-1)  # (B, M, K)
    if not unknown.any():
        return LightSum.single(known)
    if draws < 1:
        raise ValueError(f"draws: expected at least 1, got {draws}")
    each = -(-draws // known.shape[1])  # every set meets as many draws, which are an even sample by blocks
    drawn = find(each * known.shape[1])
    if unknown.all():
        return drawn
    known, unknown = (part.repeat_interleave(each, 1) for part in (known, unknown))
    return _filled_in(known.nan_to_num(0.0), unknown, drawn)


def known_sums(given: LightSum | LightMixture, people: int, inputs: int) -> LightSum:
    """Known source lights as amounts ``(people, M, inputs, n)``."""
    if not isinstance(given, LightSum | LightMixture):
        raise ValueError(f"source lights: expected a tensor, a LightSum or a LightMixture, got {given!r}")
    lights = LightSum.of(given) if isinstance(given, LightMixture) else given
    lights = check_light_sum(lights, "source lights")
    shape = tuple(lights.amounts.shape[:-1])
    if shape == (inputs,):
        lights = lights.insert(0).expand(people, -1)
    if len(lights.amounts.shape) == 3:
        lights = lights.insert(1)
    shape = tuple(lights.amounts.shape[:-1])
    if len(shape) != 3 or (shape[0], shape[2]) != (people, inputs) or not shape[1]:
        raise ValueError(
            f"source lights: expected amounts (K, n), (B, K, n) or (B, M, K, n) for images ({people}, {inputs}),"
            f" got {tuple(lights.amounts.shape)}"
        )
    return lights


def _filled_in(known: Tensor, unknown: Tensor, drawn: LightSum) -> LightSum:
    """``known (B, M, K, 3)`` single lights, with ``drawn`` ones, amounts ``(B, M, K, n)``, where they are
    ``unknown (B, M, K)``."""
    single = LightSum.single(known)
    count = drawn.amounts.shape[-1]
    amounts = torch.nn.functional.pad(single.amounts, (0, count - 1))  # of one direction, the others nothing
    directions = drawn.directions.expand(*drawn.amounts.shape, 3)
    return LightSum(
        torch.where(unknown[..., None, None], directions, single.directions),
        torch.where(unknown[..., None], drawn.amounts, amounts),
    )


def middle_light(tried: LightSum) -> LightSum:
    """The mean light, amounts ``(K, n)``, of equally likely ones, amounts ``(M, K, n)``; of single directions the mean
    direction."""
    if tried.shared:
        return LightSum(tried.directions, tried.amounts.mean(0))
    if tried.amounts.shape[-1] == 1:
        mean = tried.vector.mean(0)  # (K, 3)
        length = mean.norm(dim=-1, keepdim=True)
        return LightSum.single(torch.where(length > 0, mean / length.clamp_min(1e-12), 0.0))
    inputs = tried.amounts.shape[1]
    amounts = tried.amounts.transpose(0, 1).reshape(inputs, -1) / len(tried.amounts)
    return LightSum(tried.directions.transpose(0, 1).reshape(inputs, -1, 3), amounts)
