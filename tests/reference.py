"""Slow float64 NumPy versions of the thesis's equations, one pixel at a time, written from the text and not from the
package."""

import numpy as np


def fit(images: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(4.2) for one pixel: ``images (N, J)``, ``lights (J, 3)`` -> n ``(N, 3)``, v ``(N, J)``."""
    n = np.array([np.linalg.lstsq(lights, row, rcond=None)[0] for row in images])
    return n, images - n @ lights.T


class Pixel:
    """(3.16), (3.17) for one pixel with the completed correlation of the design."""

    def __init__(self, statistics, y: int, x: int, residual: bool = False) -> None:
        parts = statistics.face.residual if residual else statistics.pixel
        self.lights = statistics.lights.double().numpy()
        self.widths = statistics.light_widths.double().numpy()
        self.narrow = float(statistics.nugget_width)
        self.n_mean = statistics.n_mean[:, y, x].double().numpy()
        self.v_mean = statistics.v_mean[:, y, x].double().numpy()
        factor = parts.n_factor[..., y, x].double().numpy()
        self.n_cov = factor @ factor.T
        self.std = parts.v_std[:, y, x].double().numpy()
        learned = parts.v_factor[..., y, x].double().numpy()
        self.correlation = learned @ learned.T + np.diag(1 - (learned**2).sum(1))

    def weights(self, s: np.ndarray) -> np.ndarray:
        kernel = np.exp(-0.5 * ((s - self.lights) ** 2).sum(1) / self.widths**2)
        return kernel / kernel.sum()

    def mean(self, s: np.ndarray) -> float:
        return float(s @ self.n_mean + self.weights(s) @ self.v_mean)

    def covariance(self, p: np.ndarray, q: np.ndarray) -> float:
        wp, wq = self.weights(p), self.weights(q)
        rho = wp @ self.correlation @ wq
        gap_p, gap_q = 1 - wp @ self.correlation @ wp, 1 - wq @ self.correlation @ wq
        rho += np.sqrt(max(gap_p, 0) * max(gap_q, 0)) * np.exp(-0.5 * ((p - q) ** 2).sum() / self.narrow**2)
        return float(p @ self.n_cov @ q + np.sqrt(wp @ self.std**2) * np.sqrt(wq @ self.std**2) * rho)

    def relight(
        self,
        y: np.ndarray,
        sources: np.ndarray,
        target: np.ndarray,
        gain: float = 1.0,
        spread: float = 0.0,
        noise: float = 0.0,
    ) -> tuple[float, float]:
        """Mean and variance of images ``gain`` times as bright as the model's, the gain known to within ``spread`` of
        its logarithm, noise as in the inputs."""
        r_yy = np.array([[self.covariance(a, b) for b in sources] for a in sources])
        r_yy += (noise / gain) ** 2 * np.eye(len(sources))
        r_xy = np.array([self.covariance(target, a) for a in sources])
        average = np.array([self.mean(s) for s in sources])
        mean, black = (self.mean(target) + r_xy @ np.linalg.solve(r_yy, x - average) for x in (y / gain, 0 * y))
        left = self.covariance(target, target) - r_xy @ np.linalg.solve(r_yy, r_xy)
        variance = gain**2 * (left + spread**2 * black**2) + noise**2
        return float(gain * mean), float(variance)


class Face:
    """The whole-face model at every pixel of small statistics: residuals as in :class:`Pixel`, and loadings."""

    def __init__(self, statistics) -> None:
        face, (height, width) = statistics.face, statistics.size
        self.pixels = [Pixel(statistics, y, x, residual=True) for y in range(height) for x in range(width)]
        self.n = face.n.flatten(2).double().numpy()  # (k, 3, P)
        self.v = np.einsum("mj,kmp->kjp", face.basis.double().numpy(), face.v.flatten(2).double().numpy())
        self.power = face.v_power.flatten(1).double().numpy()  # (J, P)
        self.temper = float(face.temper)

    def loadings(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(P, k)`` of an image, and the standard deviation ``(P,)`` that the basis over the lights loses."""
        weights = self.pixels[0].weights(s)
        of_v = np.einsum("j,kjp->pk", weights, self.v)
        lost = np.sqrt(np.maximum(weights @ self.power - (of_v**2).sum(1), 0))
        return np.einsum("c,kcp->pk", s, self.n) + of_v, lost

    def covariance(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Of what the code leaves to each pixel, ``(P,)``."""
        narrow = np.exp(-0.5 * ((p - q) ** 2).sum() / self.pixels[0].narrow ** 2)
        local = np.array([pixel.covariance(p, q) for pixel in self.pixels])
        return local + narrow * self.loadings(p)[1] * self.loadings(q)[1]

    def relight(
        self,
        y: np.ndarray,
        sources: np.ndarray,
        target: np.ndarray,
        gain: float = 1.0,
        spread: float = 0.0,
        noise: float = 0.0,
        weight: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance ``(P,)`` given images ``y (K, P)``: the code from the whitened pixels, each counting
        ``weight`` and ``1 / temper``, then every pixel on its own."""
        count = len(self.pixels)
        weight = np.ones(count) if weight is None else weight
        local = np.array([[self.covariance(a, b) for b in sources] for a in sources]).transpose(2, 0, 1)
        local = local + (noise / gain) ** 2 * np.eye(len(sources))
        cross = np.array([self.covariance(target, a) for a in sources]).T  # (P, K)
        inside = np.array([self.loadings(a)[0] for a in sources]).transpose(1, 0, 2)  # (P, K, k)
        out = self.loadings(target)[0]
        average = np.array([[pixel.mean(a) for a in sources] for pixel in self.pixels])  # (P, K)
        inverse = np.linalg.inv(local)
        at = np.array([pixel.mean(target) for pixel in self.pixels])
        precision = np.eye(out.shape[1])
        for p in range(count):
            precision = precision + weight[p] / self.temper * inside[p].T @ inverse[p] @ inside[p]
        means = []
        for images in (y / gain, 0 * y):
            pull = sum(
                weight[p] / self.temper * inside[p].T @ inverse[p] @ (images[:, p] - average[p]) for p in range(count)
            )
            code = np.linalg.solve(precision, pull)
            rest = [images[:, p] - average[p] - inside[p] @ code for p in range(count)]
            means.append(at + out @ code + np.array([cross[p] @ inverse[p] @ rest[p] for p in range(count)]))
        mean, black = means
        own = self.covariance(target, target)
        left = np.array([out[p] - cross[p] @ inverse[p] @ inside[p] for p in range(count)])
        variance = own - np.array([cross[p] @ inverse[p] @ cross[p] for p in range(count)])
        variance = variance + np.einsum("pk,kl,pl->p", left, np.linalg.inv(precision), left)
        variance = gain**2 * (variance + spread**2 * black**2) + noise**2
        return gain * mean, variance


def gain(
    images: np.ndarray,
    expected: np.ndarray,
    spread: float,
    noise: np.ndarray,
    lights: np.ndarray,
    sigma: float = 0.0,
    mask: np.ndarray | None = None,
) -> tuple[float, float]:
    """The brightness of a person: weighted least squares for each of ``images (K, P)``, readings whose logarithms err
    by ``noise (K,)``, alike under ``lights (K, 3)`` near each other, and by the images' own noise ``sigma``; people's
    logarithms normal about 0 with ``spread``; and the standard deviation that is left."""
    count = len(images)
    read, own = np.empty(count), np.empty(count)
    for k, (image, face) in enumerate(zip(images, expected, strict=True)):
        weight = (np.ones(len(face)) if mask is None else mask) / (1 + sigma**2 / (face**2).mean())
        root = np.sqrt(weight)
        read[k] = np.linalg.lstsq((face * root)[:, None], image * root, rcond=None)[0][0]
        own[k] = sigma * np.linalg.norm(weight * face) / (weight @ (image * face))
    apart = ((lights[:, None] - lights) ** 2).sum(-1)
    errors = np.outer(noise, noise) * (0.95 * np.exp(-apart / (2 * 0.95**2)) + 0.05 * np.eye(count))
    shared = np.full(count, spread**2)
    weights = np.linalg.solve(spread**2 + errors + np.diag(own**2), shared)
    return float(np.exp(weights @ np.log(read))), float(np.sqrt(spread**2 - weights @ shared))
