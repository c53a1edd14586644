"""What a bootstrap of other people's faces teaches: the Gaussian statistics of n and v at every pixel, and over the
whole face.

The model (3.13) is ``i(x; s) = n(x)^T s + v(x; s)``: n is the albedo-scaled normal, v(s) the deviation from Lambert
(shadows, highlights), correlated over lights. How they are learned: :mod:`facerelight.model.learning`.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from facerelight.geometry.lights import angular_distance, merge_repeats, unit_lights
from facerelight.model.compression import checksum
from facerelight.model.file import KEY_LENGTH, read_tensors, write_tensors
from facerelight.model.image_store import ImageStore
from facerelight.model.learning import FitOptions, learn
from facerelight.numerics.buffers import LearnedModule
from facerelight.numerics.checks import check_radiance, check_shape, check_unit, check_valid
from facerelight.numerics.kernels import kernel_weights

__all__ = ["FaceLoadings", "FaceStatistics", "PixelStatistics"]

FACE_PARTS = ("n", "v", "basis", "v_power", "temper")
NEGLIGIBLE = 1e-6  # kernel weights that no picture shows


class PixelStatistics(LearnedModule):
    """Second-order statistics of n and of v at the J bootstrap lights, pixel by pixel (4.3).

    Buffers: ``n_factor (3, 3, H, W)`` with ``C_n = L L^T``; ``v_std (J, H, W)``; ``v_factor (J, r, H, W)``, the factor
    F of the correlation ``F F^T + diag(1 - rowsum F^2)`` of v over the lights.
    """

    n_factor: Tensor
    v_std: Tensor
    v_factor: Tensor

    def __init__(self, n_factor: Tensor, v_std: Tensor, v_factor: Tensor) -> None:
        super().__init__()
        self.register_buffer("n_factor", n_factor)
        self.register_buffer("v_std", v_std)
        self.register_buffer("v_factor", v_factor)


class FaceLoadings(LearnedModule):
    """The low-rank part of the whole-face model: ``i = mu + (Lambda_n^T s + w(s).Lambda_v)^T c + e``,
    ``c ~ N(0, I_k)``.

    Buffers: ``n (k, 3, H, W)``; ``v (k, m, H, W)``, loadings of v in a basis over the lights; ``basis (m, J)``;
    ``v_power (J, H, W)``, the variance that the loadings give v at each light; ``temper ()``. ``residual`` holds the
    per-pixel statistics of e.
    """

    n: Tensor
    v: Tensor
    basis: Tensor
    v_power: Tensor
    temper: Tensor

    def __init__(
        self, n: Tensor, v: Tensor, basis: Tensor, v_power: Tensor, temper: Tensor, residual: PixelStatistics
    ) -> None:
        super().__init__()
        for name, tensor in (("n", n), ("v", v), ("basis", basis), ("v_power", v_power), ("temper", temper)):
            self.register_buffer(name, tensor)
        self.residual = residual


class FaceStatistics(LearnedModule):
    """Statistics of n and v learned from a bootstrap, as registered buffers.

    Build them with :meth:`fit`, or subject by subject: ``FaceStatistics(lights)``, :meth:`update` for each,
    :meth:`solve`.

    Args:
        lights: unit vectors ``(J, 3)`` of the bootstrap lights; repeats are merged.
        options: how to learn.
        store: where the subjects' images are kept until solved (default: in memory).

    Buffers after :meth:`solve`: ``lights (J, 3)``, ``light_widths (J,)``, ``nugget_width ()``, ``gain_spread ()``,
    ``gain_noise (J,)``, ``n_mean (3, H, W)``, ``v_mean (J, H, W)``, the submodule ``pixel`` (:class:`PixelStatistics`)
    and, with a ``face_rank``, ``face`` (:class:`FaceLoadings`).
    """

    lights: Tensor
    light_widths: Tensor
    nugget_width: Tensor
    n_mean: Tensor
    v_mean: Tensor
    gain_spread: Tensor
    gain_noise: Tensor

    def __init__(self, lights: Tensor, options: FitOptions | None = None, store: ImageStore | None = None) -> None:
        super().__init__()
        self.options = options or FitOptions()
        self.store: ImageStore | None = ImageStore() if store is None else store
        self.metadata: dict[str, object] = {}
        self._key: str | None = None
        check_shape(lights, "lights", "J 3", (None, 3))
        distinct, index = merge_repeats(unit_lights(lights.detach().float()))
        self._light_index = index.cpu()
        if torch.linalg.matrix_rank(distinct.double(), rtol=1e-4) < 3:
            raise ValueError(
                f"lights: expected at least 3 linearly independent directions, got {len(distinct)} that are not"
            )
        self.register_buffer("lights", distinct)
        self.register_buffer("light_widths", torch.ones(len(distinct)))
        self.register_buffer("nugget_width", torch.tensor(1.0))
        self.register_buffer("gain_spread", torch.tensor(0.0))
        self.register_buffer("gain_noise", torch.ones(len(distinct)))
        self.register_buffer("n_mean", None)
        self.register_buffer("v_mean", None)
        self.pixel: PixelStatistics | None = None
        self.face: FaceLoadings | None = None

    @classmethod
    def fit(
        cls,
        images: Tensor,
        lights: Tensor,
        valid: Tensor | None = None,
        options: FitOptions | None = None,
        store: ImageStore | None = None,
        **overrides: object,
    ) -> FaceStatistics:
        """Learn from ``images (N, J, H, W)`` in linear radiance under ``lights (J, 3)``.

        Args:
            images: float, 1.0 = full scale; N >= 2 subjects.
            lights: bootstrap lights, rank 3.
            valid: ``(N, J)`` bool (or 0 and 1), False where an image does not exist; None: all do.
            options: see :class:`FitOptions`; ``overrides`` replace single fields of it (``rank=8``).
            store: where to keep the images.

        Example:
            >>> lights = torch.eye(3)
            >>> FaceStatistics.fit(torch.rand(4, 3, 8, 8), lights, rank=2).n_mean.shape
            torch.Size([3, 8, 8])
        """
        check_shape(lights, "lights", "J 3", (None, 3))
        check_shape(images, "images", "N J H W", (len(lights), None, None))
        if valid is not None:
            valid = check_valid(valid, "valid", "N J", images.shape[:2])
        settings = {**asdict(options or FitOptions()), **overrides}
        statistics = cls(lights, FitOptions(**settings), store)  # type: ignore[arg-type]
        for index, subject in enumerate(images):
            statistics.update(subject, None if valid is None else valid[index])
        return statistics.solve()

    def update(self, images: Tensor, valid: Tensor | None = None, subject: int | None = None) -> FaceStatistics:
        """Add one subject's ``images (J, H, W)``, ``valid (J,)`` saying which exist; takes effect at the next
        :meth:`solve`."""
        if self.store is None:
            raise RuntimeError(
                "update: these statistics were loaded, and the images they came from are not kept; fit anew"
            )
        check_shape(images, "images, one a light", "J H W", (len(self._light_index), None, None))
        kept = torch.ones(len(images), dtype=torch.bool)
        if valid is not None:
            kept = check_valid(valid, "valid", "J", (len(images),)).cpu()
        images = images.detach().cpu()
        check_radiance(images[kept], "images that are not marked as missing in `valid`", "J H W")
        merged = torch.full((len(self.lights), *images.shape[1:]), float("nan"))
        for light in range(len(self.lights)):
            same = kept & (self._light_index == light)
            if same.any():
                merged[light] = images[same].float().mean(0)
        self.store.add(merged, subject)
        return self

    def merge(self, other: FaceStatistics) -> FaceStatistics:
        """Add all subjects of ``other``, learned under the same lights; takes effect at the next :meth:`solve`."""
        if self.store is None or other.store is None:
            raise RuntimeError("merge: expected statistics that still keep their images; loaded ones do not")
        if self.lights.shape != other.lights.shape or not torch.allclose(self.lights, other.lights, atol=1e-5):
            raise ValueError(
                f"merge: expected the same lights, got {len(self.lights)} and {len(other.lights)} that differ"
            )
        if other.store is self.store or (self.store.folder and self.store.folder == other.store.folder):
            raise ValueError("merge: expected other statistics, got the same people; they would count twice")
        for array in other.store:
            self.store.add(torch.from_numpy(array.copy()))
        return self

    def solve(self) -> FaceStatistics:
        """Learn every statistic from the subjects added so far."""
        if self.store is None or len(self.store) < 2:
            raise ValueError(
                f"statistics: expected at least 2 subjects, got {0 if self.store is None else len(self.store)}"
            )
        shapes = {array.shape for array in self.store}
        if len(shapes) > 1:
            raise ValueError(f"statistics: expected images of one size, got {sorted(shapes)}")
        self._key = None
        learned = learn(self.store, self.lights.cpu().float(), self.options)
        self.light_widths, self.nugget_width = learned.light_widths, learned.nugget_width
        self.gain_spread, self.gain_noise = learned.gain_spread, learned.gain_noise
        self.n_mean, self.v_mean = learned.n_mean, learned.v_mean
        self.pixel = PixelStatistics(*learned.pixel)
        if learned.face is not None:
            face = learned.face
            residual = PixelStatistics(*face.residual)
            temper = torch.tensor(self.options.temper)
            self.face = FaceLoadings(face.n, face.v, learned.basis, face.v_power, temper, residual)
        return self.to(self.lights)  # learned in float32 beside the images

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """What was learned replaces all that was; the images it came from are not in it, so it cannot be updated."""

        def pixel(at: str) -> PixelStatistics:
            return PixelStatistics(*(state_dict[f"{at}.{name}"].clone() for name in ("n_factor", "v_std", "v_factor")))

        self.pixel, self.face = None, None
        if f"{prefix}pixel.v_std" in state_dict:
            self.pixel = pixel(f"{prefix}pixel")
        if f"{prefix}face.n" in state_dict:
            parts = {name: state_dict[f"{prefix}face.{name}"].clone() for name in FACE_PARTS}
            self.face = FaceLoadings(**parts, residual=pixel(f"{prefix}face.residual"))
        self.to(self.lights)
        self.store, self._key = None, None
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def mean_images(self) -> Tensor:
        """The average face under every bootstrap light, ``n^T s + v`` of the means, ``(J, H, W)``."""
        return self.v_mean + torch.einsum("jc,chw->jhw", self.lights, self.n_mean)

    def weights(self, lights: Tensor) -> Tensor:
        """Kernel weights ``w(s)`` over the bootstrap lights (4.5), ``(..., 3) -> (..., J)``; below 1e-6 they are 0, so
        few count; lights that are not unit vectors are a ``ValueError``."""
        check_unit(lights, "lights")
        squared = (lights[..., None, :] - self.lights).square().sum(-1)
        weights = kernel_weights(squared, self.light_widths)
        weights = torch.where(weights > NEGLIGIBLE, weights, 0.0)
        return weights / weights.sum(-1, keepdim=True)

    def nugget(self, a: Tensor, b: Tensor) -> Tensor:
        """The narrow kernel ``k(|p - q|)`` between lights ``(A, 3)`` and ``(B, 3)``; 1 where they meet."""
        squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)
        return torch.exp(-0.5 * squared / self.nugget_width**2)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the maps, in pixels."""
        if self.n_mean is None:
            raise RuntimeError("statistics: nothing is learned yet; call solve() after adding subjects")
        return int(self.n_mean.shape[-2]), int(self.n_mean.shape[-1])

    @property
    def key(self) -> str:
        """What was learned, as 16 hexadecimal digits: what is made with these statistics (light estimators, galleries)
        keeps it, and is refused by others. It outlives saving, compression and conversion."""
        _ = self.size
        if self._key is None:
            self._key = checksum({n: t.detach().cpu().float() for n, t in self.state_dict().items()})[:KEY_LENGTH]
        return self._key

    def save(self, path: str | Path, coarseness: float = 0.0) -> None:
        """Write a safetensors file, atomically: tensors, and as metadata the format version, options and
        ``self.metadata``.

        With a ``coarseness`` above 0 it is compressed, see :mod:`facerelight.model.compression`.
        """
        _ = self.size
        write_tensors(
            path, self.state_dict(), {"options": asdict(self.options), "key": self.key, **self.metadata}, coarseness
        )

    @classmethod
    def load(cls, path: str | Path) -> FaceStatistics:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: no such file, not a statistics file, of an unknown version, or with tensors missing, misshapen
                or not finite.
        """
        tensors, header = read_tensors(path)
        try:
            options = header.pop("options")
            statistics = cls(tensors["lights"], FitOptions(**options))  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}: expected the options and lights of a fit, got {error}; train anew with `facerelight train`"
            ) from error
        key = header.pop("key", None)
        statistics.store, statistics.metadata, statistics._key = None, header, None if key is None else str(key)

        def pixel(prefix: str) -> PixelStatistics:
            return PixelStatistics(*(tensors[f"{prefix}.{name}"] for name in ("n_factor", "v_std", "v_factor")))

        for name in ("lights", "light_widths", "nugget_width", "gain_spread", "gain_noise", "n_mean", "v_mean"):
            setattr(statistics, name, tensors[name])
        statistics.pixel = pixel("pixel")
        if "face.n" in tensors:
            parts = {name: tensors[f"face.{name}"] for name in FACE_PARTS}
            statistics.face = FaceLoadings(**parts, residual=pixel("face.residual"))
        return statistics

    def describe(self) -> dict[str, object]:
        """What ``facerelight train`` reports: size, lights, spacing, the kernel width chosen, ranks."""
        spacing = angular_distance(self.lights[:, None].double(), self.lights[None].double()).kthvalue(2, dim=-1).values
        return {
            "height": self.size[0],
            "width": self.size[1],
            "lights": len(self.lights),
            "median_spacing_deg": float(spacing.median()),
            "kernel_width": float(torch.rad2deg(self.light_widths.median())),
            "rank": self.options.rank if self.pixel is None else self.pixel.v_factor.shape[1],
            "face_rank": 0 if self.face is None else len(self.face.n),
            "temper": self.options.temper,
        }
