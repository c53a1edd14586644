"""StatisticalRelighter: the optimal image of a face under a new light, and its variance."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sums import LightSum
from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.inference.methods import RELIGHTING_METHODS, Method
from facerelight.inference.people import PeoplePosterior
from facerelight.inference.person import PersonPosterior
from facerelight.inference.posterior import Lights, Posterior, Relit, check_targets
from facerelight.inference.source_lights import known_sums, middle_light, source_sums
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.estimator import LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.compression import compress_estimator, decompress_estimator
from facerelight.model.covariance import prior_mean
from facerelight.model.file import replacing
from facerelight.model.light_terms import DirectionTerms, direction_terms
from facerelight.model.registration import deform
from facerelight.model.registration import register as find_deformation
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.checks import check_mask, check_noise, check_radiance, check_shape

__all__ = ["StatisticalRelighter"]

Covariance = Literal["pixel", "face"]
Made = TypeVar("Made")


class StatisticalRelighter(nn.Module):
    """Render faces under new lights as the conditional mean of a Gaussian model learned from other faces (3.17,
    Algorithm 2).

    Args:
        statistics: what the bootstrap taught; its maps are registered buffers of this module.
        covariance: "pixel" treats every pixel on its own, as the thesis does; "face" adds a code shared by the whole
            face.
        estimator: finds the input lights where they are not given; None: the statistics' own likelihood
            (:class:`~facerelight.light.likelihood.LikelihoodIlluminationEstimator`), made when it is first needed.
        noise: standard deviation of what an input holds besides the face (sensor, quantisation, compression, misfit of
            the model), in grey levels of 255; inputs are returned within about that. 0: exactly (Theorem 3), but then
            nearly equal lights blow up the least difference between their images.

    Example:
        >>> lights = torch.eye(3)
        >>> relighter = StatisticalRelighter(FaceStatistics.fit(torch.rand(5, 3, 8, 8), lights, rank=2))
        >>> relighter(torch.rand(1, 1, 8, 8), lights, source_lights=lights[None, :1]).mean.shape
        torch.Size([1, 3, 8, 8])
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        covariance: Covariance = "pixel",
        estimator: LightEstimator | None = None,
        noise: float = 1.0,
    ) -> None:
        super().__init__()
        if covariance not in ("pixel", "face"):
            raise ValueError(f"covariance: expected 'pixel' or 'face', got {covariance!r}")
        if statistics.pixel is None:
            raise RuntimeError("statistics: nothing is learned yet; call solve() after adding subjects")
        if covariance == "face" and statistics.face is None:
            raise ValueError(
                "covariance='face': these statistics have no whole-face loadings; fit them with face_rank > 0"
            )
        self.statistics = statistics
        self.covariance = covariance
        self.estimator = estimator
        check_noise(noise)
        self.noise = float(noise)
        self._kept: dict[str, tuple[object, Any]] = {}  # made of the statistics when first needed; no part of the state

    def condition(
        self,
        images: Tensor,
        source_lights: Lights | None = None,
        estimator: LightEstimator | None = None,
        draws: int = 32,
        generator: torch.Generator | None = None,
        mask: Tensor | None = None,
        register: bool = False,
        noise: Tensor | None = None,
    ) -> Posterior:
        """The expensive half, once: what is known of each person after seeing the images.

        Args:
            images: ``(B, K, H, W)`` linear radiance; K images of each of B persons, canonical crops of the statistics'
                size.
            source_lights: ``(K, 3)`` or ``(B, K, 3)`` unit vectors; rows of NaN mark unknown lights; a zero light takes
                its image out of the evidence. ``(B, M, K, 3)``: M equally likely sets of them. Sums of directions, with
                amounts ``(K, n)``, ``(B, K, n)`` or ``(B, M, K, n)``, or a scene's light where K = 1. None: all are
                unknown, and are estimated and integrated over.
            estimator: finds unknown lights; default: the module's own.
            draws: samples of each unknown light (Algorithm 2); with M sets of lights that are partly unknown, as many
                more as make it a multiple of M, and each set meets equally many.
            generator: makes the samples another set; by default they are the same at every call.
            mask: ``(B, H, W)``, 1 where the images show the face; elsewhere they say nothing about light or identity.
                None: everywhere.
            register: find where each face lies beside the model's, and render it there; for statistics of real, aligned
                faces (:func:`facerelight.model.registration.align_people`) and landmarks that are not exact.
            noise: standard deviation of what the images hold besides the face, radiance, ``(B, K)`` or
                ``(B, K, H, W)``: larger where they were made brighter on the way here. None: the module's own.

        Raises:
            ValueError: shapes or values out of range.
        """
        given, images = images, self._checked(images)
        if mask is not None:
            mask = check_mask(mask, "mask", "B H W", (len(images), *images.shape[2:])).to(images.device)

        def find(count: int) -> LightSum:
            finder = estimator or self.estimator or self._own_estimator()
            return finder.sample_sums(images, count, generator, mask=mask)

        hypotheses = source_sums(source_lights, images, draws, find)
        noise = self._input_noise(images, noise)  # (B, K, 1) or (B, K, P)
        deformations = None
        if register:
            deformations, images, mask, noise = self._registered(images, hypotheses, mask, noise)
            if source_lights is None:  # once more, now that it is in step with the model
                hypotheses = source_sums(None, images, draws, find)

        def one_by_one() -> list[PersonPosterior]:
            shared = self._shared_terms(hypotheses)
            return [
                PersonPosterior(
                    self.statistics,
                    person,
                    hypotheses[index],
                    self.covariance,
                    None if mask is None else mask[index],
                    noise[index],
                    self.noise / 255,
                    shared,
                )
                for index, person in enumerate(images)
            ]

        if not register and not images.requires_grad and _single(hypotheses):
            lights = unit_lights(hypotheses.directions[:, 0, 0, 0])
            return PeoplePosterior(
                self.statistics, self.covariance, images[:, 0], lights, noise[:, 0], mask, one_by_one, given.dtype
            )
        return Posterior(one_by_one(), self.statistics.size, deformations, given.dtype)

    def _shared_terms(self, lights: LightSum) -> DirectionTerms | None:
        """The terms of directions that all ``lights`` share, once for everybody; those of the bootstrap's lights are
        kept. None: they are not shared, or there is one light alone, which is cheaper without."""
        if not lights.shared:
            return None
        statistics, directions = self.statistics, lights.directions
        face = statistics.face if self.covariance == "face" else None
        pixel = statistics.pixel if face is None else face.residual
        assert pixel is not None
        own = directions.shape == statistics.lights.shape and torch.allclose(directions, statistics.lights, atol=1e-6)
        if not own or directions.requires_grad:
            few = lights.amounts.shape[:-1].numel() == 1
            return None if few else direction_terms(statistics, pixel, directions, face)
        return self._made_once(
            f"terms, {self.covariance}", lambda: direction_terms(statistics, pixel, statistics.lights, face)
        )

    def _made_once(self, what: str, make: Callable[[], Made]) -> Made:
        """What ``make`` makes of the statistics; anew where they have changed or moved."""
        here = self.statistics.n_mean
        state = (self.statistics.key, here.device, here.dtype)
        if what not in self._kept or self._kept[what][0] != state:
            self._kept[what] = (state, make())
        return self._kept[what][1]

    def soft_estimator(self) -> SoftLightEstimator:
        """Amounts of many lights under these statistics."""
        return self._made_once("amounts", lambda: SoftLightEstimator(self.statistics).to(self.statistics.n_mean))

    def _own_estimator(self) -> LikelihoodIlluminationEstimator:
        """The likelihood of the statistics."""
        return self._made_once(
            "likelihood", lambda: LikelihoodIlluminationEstimator(self.statistics).to(self.statistics.n_mean)
        )

    def _input_noise(self, images: Tensor, noise: Tensor | None) -> Tensor:
        """Standard deviation of the noise of ``images (B, K, H, W)``, radiance, ``(B, K, 1)`` or ``(B, K, P)``."""
        if noise is None:
            return images.new_full((*images.shape[:2], 1), self.noise / 255, dtype=torch.float64)
        known = isinstance(noise, Tensor) and noise.is_floating_point()
        if not known or tuple(noise.shape) not in (tuple(images.shape[:2]), tuple(images.shape)):
            shape = tuple(noise.shape) if known else repr(noise)
            raise ValueError(
                f"noise: expected a floating tensor {tuple(images.shape[:2])} or {tuple(images.shape)}, got {shape};"
                " give a standard deviation for each image, or for each pixel"
            )
        if not ((noise >= 0) & torch.isfinite(noise)).all():
            raise ValueError("noise: expected finite radiance of 0 or more, got less, NaN or infinity")
        pixels = noise.flatten(2) if noise.dim() == 4 else noise[..., None]
        return pixels.to(device=images.device, dtype=torch.float64)

    def _registered(
        self, images: Tensor, hypotheses: LightSum, mask: Tensor | None, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        """Deformations ``(B, 6)``, and images ``(B, K, H, W)``, mask ``(B, H, W)`` and noise brought into the model's
        place."""
        found = [
            self._registration(person, hypotheses[index], None if mask is None else mask[index], noise[index])
            for index, person in enumerate(images)
        ]
        images = torch.stack([deform(person, theta) for person, theta in zip(images, found, strict=True)])
        if mask is not None:
            mask = torch.stack([deform(m, theta).clamp(0, 1) for m, theta in zip(mask, found, strict=True)])
        noise = torch.stack([self._deformed(n, theta) for n, theta in zip(noise, found, strict=True)])
        return torch.stack(found), images, mask, noise

    def _deformed(self, noise: Tensor, theta: Tensor) -> Tensor:
        """Noise ``(K, P)`` as its images are deformed; ``(K, 1)`` stays."""
        if noise.shape[1] == 1:
            return noise
        return deform(noise.unflatten(1, self.statistics.size).to(theta), theta).clamp_min(0).flatten(1).to(noise)

    def _registration(self, images: Tensor, tried: LightSum, mask: Tensor | None, noise: Tensor) -> Tensor:
        """The deformation of one face under the mean of the lights ``tried``, amounts ``(M, K, n)``: to the average
        face first, then to what the whole-face code makes of it."""
        light = middle_light(tried)
        seen = light.amounts.sum(-1) > 0
        if not seen.any():
            return images.new_zeros(6)
        seen_images, light, noise = images[seen], light[seen], noise[seen]
        size = self.statistics.size
        theta = find_deformation(seen_images, prior_mean(self.statistics, light).unflatten(-1, size), weight=mask)
        if self.covariance == "pixel":
            return theta
        person = PersonPosterior(
            self.statistics, deform(images, theta), light.insert(0), "face", mask, self._deformed(noise, theta)
        )
        return find_deformation(seen_images, person.explained().unflatten(-1, size), theta, mask)

    def forward(
        self,
        images: Tensor,
        target_lights: Lights,
        source_lights: Lights | None = None,
        method: Method = "expected",
        estimator: LightEstimator | None = None,
        draws: int = 32,
        generator: torch.Generator | None = None,
    ) -> Relit:
        """Relight ``images (B, K, H, W)`` to ``target_lights``: :meth:`condition`, then render.

        Args:
            images, source_lights, estimator, draws, generator: see :meth:`condition`.
            target_lights: unit vectors ``(Q, 3)`` or ``(B, Q, 3)``, sums of directions with amounts ``(Q, n)`` or
                ``(B, Q, n)``, or a scene's light.
            method: "expected", the mean image (Algorithm 2; with known lights 3.17); "map", the most probable grey
                levels (Algorithm 1); "mle", n fixed and unknown (3.19, 3.20), for three or more known lights that are
                not in one plane.

        Returns:
            :class:`Relit` with ``mean`` and ``variance`` ``(B, Q, H, W)`` in the images' dtype; with "map", ``mean``
            holds the mode.
        """
        if method not in RELIGHTING_METHODS:
            raise ValueError(f"method: expected one of {', '.join(RELIGHTING_METHODS)}, got {method!r}")
        if method == "mle":
            mean, variance = self._fixed_normal(self._checked(images), target_lights, source_lights)
        else:
            posterior = self.condition(images, source_lights, estimator, draws, generator)
            mean = posterior.mean(target_lights) if method == "expected" else posterior.mode(target_lights)
            variance = posterior.variance(target_lights)
        return Relit(mean.to(images), variance.to(images))

    def _fixed_normal(self, images: Tensor, targets: Lights, lights: Lights | None) -> Relit:
        """The special case of 3.5.1, person by person."""
        if lights is None or (isinstance(lights, Tensor) and bool(lights.isnan().any())):
            raise ValueError(
                "method='mle': expected all source lights to be known; give `source_lights` or use method='expected'"
            )
        count, inputs = images.shape[:2]
        wanted = check_targets(targets, count).to(images)
        if isinstance(lights, Tensor):
            lights = lights.expand(count, -1, -1) if lights.dim() == 2 else lights
            lights = check_shape(lights, "source lights", "B K 3", (count, inputs, 3)).to(images)
            known = LightSum.single(unit_lights(lights)).insert(1)
        else:
            known = known_sums(lights, count, inputs).to(images)
        noise = self._input_noise(images, None)
        people = [
            MaximumLikelihood(
                self.statistics, person, known[index][0], noise[index], new_noise=self.noise / 255
            ).relight(wanted[index])
            for index, person in enumerate(images)
        ]
        if not people:
            empty = images.new_zeros(0, wanted.amounts.shape[1], *images.shape[2:])
            return Relit(empty, empty)
        return Relit(torch.stack([p.mean for p in people]), torch.stack([p.variance for p in people]))

    def _checked(self, images: Tensor) -> Tensor:
        """Aligned crops ``(B, K, H, W)``, see :mod:`facerelight.geometry.alignment`, in the statistics' dtype."""
        return check_radiance(images, "images", "B K H W", self.statistics.size).to(self.statistics.n_mean)

    def save_pretrained(self, folder: str | Path, compress: float = False) -> None:
        """Write ``statistics.safetensors`` and, where there is a kernel estimator, ``estimator.safetensors`` into
        ``folder``.

        A likelihood estimator is made from the statistics and needs no file.

        Args:
            folder: made where it does not exist.
            compress: True makes the files about twenty times smaller and relit faces a quarter of a grey level
                different, see :mod:`facerelight.model.compression`; 2.0 rounds twice as coarsely, and so on.
        """
        from safetensors.torch import save_file

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if isinstance(self.estimator, KernelIlluminationEstimator):
            tensors = self.estimator.state_dict()
            if compress:
                tensors = compress_estimator({k: v.cpu() for k, v in tensors.items()}, compress)
            with replacing(folder / "estimator.safetensors") as partial:
                tensors = {k: v.contiguous() for k, v in tensors.items()}
                save_file(tensors, partial, metadata={"statistics": self.statistics.key})
        self.statistics.save(folder / "statistics.safetensors", compress)

    @classmethod
    def from_pretrained(
        cls, folder: str | Path, covariance: Covariance | None = None, noise: float = 1.0
    ) -> StatisticalRelighter:
        """Read what :meth:`save_pretrained` wrote; ``covariance`` defaults to "face" where the statistics have
        loadings; ``noise`` as in the constructor."""
        from safetensors import SafetensorError, safe_open
        from safetensors.torch import load_file

        folder = Path(folder)
        statistics = FaceStatistics.load(folder / "statistics.safetensors")
        path = folder / "estimator.safetensors"
        estimator = None
        if path.exists():
            try:
                with safe_open(path, framework="pt") as file:
                    key = (file.metadata() or {}).get("statistics", statistics.key)
                if key != statistics.key:
                    raise ValueError(f"one of statistics {key} beside statistics {statistics.key}")
                estimator = KernelIlluminationEstimator(**decompress_estimator(load_file(path)))
            except (OSError, SafetensorError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{path}: expected a light estimator, got {error}; train anew with `facerelight train`"
                ) from error
        return cls(statistics, covariance or ("face" if statistics.face is not None else "pixel"), estimator, noise)


def _single(lights: LightSum) -> bool:
    """Whether each of several people was seen under one known direction alone."""
    one_each = lights.amounts.shape[0] > 1 and lights.amounts.shape[1:].numel() == 1
    still = not (lights.directions.requires_grad or lights.amounts.requires_grad)
    return one_each and not lights.shared and still and bool((lights.amounts == 1).all())
