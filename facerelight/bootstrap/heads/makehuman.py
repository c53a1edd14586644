"""Seeded random people of the packed CC0 model."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import numpy as np

from facerelight.bootstrap.heads.head import Head, normalise

__all__ = ["MakeHumanHeads"]


class MakeHumanHeads:
    """Random people from MakeHuman's morph targets (CC0, packed with the package): sex, age, origin, build, 100 local
    shapes, asymmetry.

    Args:
        seed: another seed gives other people; person ``index`` depends on ``(seed, index)`` alone.
        spread: standard deviation of the local shapes; 0.25 looks like people, 0.35 like caricatures.
        expression: weights in 0..1 of named expression shapes (:attr:`expressions`), the same for everybody, on top of
            how each person's face rests: lids at ease, a little squint, for some a smile or a frown.
    """

    ORIGINS = ("african", "asian", "caucasian")

    def __init__(self, seed: int = 0, spread: float = 0.25, expression: dict[str, float] | None = None) -> None:
        self.seed, self.spread, self.expression = seed, spread, dict(expression or {})
        self._data = _packed_heads()
        unknown = set(self.expression) - set(self.expressions)
        if unknown:
            raise ValueError(f"expression: unknown {sorted(unknown)}; choose from {', '.join(self.expressions)}")
        self._reference = self._place(self._data["vertices"])[0]

    @property
    def expressions(self) -> list[str]:
        """Names of the expression shapes."""
        return [name.split("/")[1] for name in self._data if name.startswith("expression/")]

    def head(self, index: int) -> Head:
        """Person ``index``."""
        recipe = {name: weight for name, weight in self._weights(index).items() if weight}
        vertices = self._data["vertices"] + np.tensordot(
            np.array(list(recipe.values()), np.float32), np.stack([self._data[name] for name in recipe]), 1
        )
        placed, landmarks = self._place(vertices)
        is_eye = np.zeros(len(vertices), np.float32)
        is_eye[np.concatenate((self._data["eye_left"], self._data["eye_right"]))] = 1
        return Head(placed, self._data["triangles"], self._reference, is_eye, landmarks)

    def _place(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data = self._data  # MakeHuman's left is the viewer's right
        points = np.stack([vertices[data[name]].mean(0) for name in ("eye_right", "eye_left", "mouth")])
        return normalise(vertices, points)

    def _weights(self, index: int) -> dict[str, float]:
        """Of all morph targets: who a person is, how the face rests, and what was asked for."""
        resting = _resting(np.random.default_rng((self.seed, index, 3)))  # 1 and 2: paint and posture
        for name, weight in self.expression.items():
            resting[name] = min(resting.get(name, 0.0) + weight, max(1.0, weight))
        recipe = self._recipe(np.random.default_rng((self.seed, index)))
        return recipe | {f"expression/{name}": weight for name, weight in resting.items()}

    def _recipe(self, rng: np.random.Generator) -> dict[str, float]:
        """Random weights of the morph targets."""
        male = float(rng.choice((rng.beta(1, 6), rng.beta(6, 1))))
        old = float(rng.beta(1.2, 1.5))
        muscle, weight = _tent(rng.uniform(0.2, 0.8)), _tent(rng.uniform(0.15, 0.9))
        origin = dict(zip(self.ORIGINS, rng.dirichlet((0.4,) * 3), strict=True))
        recipe: dict[str, float] = {}
        for sex, by_sex in (("female", 1 - male), ("male", male)):
            for age, by_age in (("young", 1 - old), ("old", old)):
                for name, share in origin.items():
                    recipe[f"macro/{name}-{sex}-{age}"] = by_sex * by_age * share
                for m, by_m in zip(("minmuscle", "averagemuscle", "maxmuscle"), muscle, strict=True):
                    for w, by_w in zip(("minweight", "averageweight", "maxweight"), weight, strict=True):
                        recipe[f"macro/universal-{sex}-{age}-{m}-{w}"] = by_sex * by_age * by_m * by_w
        locals_ = sorted({name.rsplit("/", 1)[0] for name in self._data if name.startswith("local/")})
        drawn: dict[str, float] = {}
        for name in locals_:  # a right side follows its left side; asymmetry has targets of its own
            stem, side = name.split("@")
            value = float(np.clip(rng.normal(0, self.spread), -1, 1))
            value = drawn.setdefault(stem, value) if side != "unsided" else value
            value *= 0.5 if name.split("/")[1] in ("head", "ears") else 1.0
            recipe[f"{name}/{'+' if value > 0 else '-'}"] = abs(value)
        for name in (n for n in self._data if n.startswith("asymmetry/")):
            if rng.random() < 0.3:
                recipe[name] = abs(float(rng.normal(0, 0.2)))
        shapes = [name for name in self._data if name.startswith("shape/")]
        for name, share in zip(shapes, rng.dirichlet((0.3,) * len(shapes)) * rng.uniform(0, 0.8), strict=True):
            recipe[name] = float(share)
        return recipe


def _resting(rng: np.random.Generator) -> dict[str, float]:
    """Random weights of the expression shapes of a face that nobody asked for anything, both sides alike."""
    smile, frown = max(0.0, rng.normal(0, 0.25)), max(0.0, rng.normal(0, 0.15))
    weights = {
        "eyeBlink": rng.uniform(0.05, 0.35),
        "eyeSquint": rng.uniform(0, 0.3),
        "mouthSmile": smile,
        "cheekSquint": smile / 2,
        "browDown": frown,
    }
    return {f"{name}{side}": float(weight) for name, weight in weights.items() for side in ("Left", "Right")}


def _tent(x: float) -> tuple[float, float, float]:
    """Weights of minimum, average and maximum for x in 0..1."""
    return max(0.0, 1 - 2 * x), 1 - abs(2 * x - 1), max(0.0, 2 * x - 1)


@lru_cache(maxsize=1)
def _packed_heads() -> dict[str, np.ndarray]:
    """The packed morph targets; read once a process."""
    with (
        files("facerelight.bootstrap").joinpath("data/heads.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as data,
    ):
        return {name: data[name].astype(np.float32) if data[name].dtype == np.float16 else data[name] for name in data}
