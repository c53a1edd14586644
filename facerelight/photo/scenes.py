"""What the verbs of the command line share: the lights that are asked for, a scene of lamps for each picture, and file
names that tell pictures apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from facerelight.geometry.sources import Lamp, LightMixture

__all__ = [
    "QUALITIES",
    "Scene",
    "join_values",
    "parse_angles",
    "parse_environment",
    "parse_lamp",
    "parse_landmarks",
    "parse_scenes",
    "scene_paths",
]

QUALITIES = ("draft", "standard", "reference")  # those of config, so that help needs no torch
LAMP = "AZIMUTH,ELEVATION[,size=DEGREES][,power=NUMBER][,colour=RRGGBB]"
ENVIRONMENT = "FILE[,turn=DEGREES][,exposure=STOPS]"
TEXTS = ("--light", "--source-light", "--landmarks")  # options whose value may begin with a minus
DIGITS = 6  # most digits behind the point in a file name


class Scene(NamedTuple):
    """Lamps that shine together, or other lights; azimuth and elevation in degrees of the first, which name the
    picture."""

    lamps: tuple[Lamp | LightMixture, ...]
    azimuth: float
    elevation: float


def join_values(arguments: Sequence[str]) -> list[str]:
    """``--light -45,30`` as ``--light=-45,30``, which a parser does not take for another option.

    Example:
        >>> join_values(["me.jpg", "--light", "-45,30", "--json"])
        ['me.jpg', '--light=-45,30', '--json']
    """
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in TEXTS and argument[:1] == "-" and argument[1:2] in "0123456789.":
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def parse_lamp(text: str, size: float = 5.0) -> Lamp:
    """A lamp from ``AZIMUTH,ELEVATION[,size=DEGREES][,power=NUMBER][,colour=RRGGBB]``, the colour sRGB in hexadecimal.

    Args:
        text: as above; "color" is understood as well.
        size: angular radius in degrees where the text gives none.

    Raises:
        ValueError: another text, or a number out of range.

    Example:
        >>> parse_lamp("-45,30,size=15,power=.8").size
        15.0
    """
    from facerelight.geometry.sources import Lamp

    angles = [part for part in text.split(",") if "=" not in part]
    named = [part.split("=", 1) for part in text.split(",") if "=" in part]
    values: dict[str, float] = {"size": size, "power": 1.0}
    colour = (1.0, 1.0, 1.0)
    try:
        azimuth, elevation = (float(part) for part in angles)
        for name, value in named:
            key = name.strip().lower()
            if key in ("colour", "color"):
                colour = _linear(value.strip())
            elif key in values:
                values[key] = float(value)
            else:
                raise ValueError(name)
    except ValueError:
        raise ValueError(f"light: expected {LAMP}, got {text!r}") from None
    try:
        return Lamp(azimuth, elevation, values["size"], values["power"], colour)
    except ValueError as error:
        raise ValueError(f"light {text!r}: {error}") from None


def parse_environment(text: str) -> LightMixture:
    """The light of a map from ``FILE[,turn=DEGREES][,exposure=STOPS]``.

    Raises:
        ValueError: another text, or a file that is no map.
    """
    from facerelight.geometry.environment import environment_light
    from facerelight.photo.files.environment_map import read_environment

    values = {"turn": 0.0, "exposure": 0.0}
    path, *named = text.split(",")
    try:
        for part in named:
            name, value = part.split("=", 1)
            if name.strip() not in values:
                raise ValueError(name)
            values[name.strip()] = float(value)
    except ValueError:
        raise ValueError(f"environment: expected {ENVIRONMENT}, got {text!r}") from None
    radiance = read_environment(path)
    try:
        return environment_light(radiance, values["turn"], values["exposure"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_angles(text: str, name: str) -> tuple[float, float]:
    """Azimuth and elevation in degrees from ``AZ,EL``.

    Raises:
        ValueError: not two numbers in range; ``name`` says of what.
    """
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
        good = abs(azimuth) <= 180 and abs(elevation) <= 90
    except ValueError:
        good = False
    if not good:
        raise ValueError(f"{name}: expected AZIMUTH,ELEVATION in degrees, within 180 and 90, got {text!r}")
    return azimuth, elevation


def parse_landmarks(text: str) -> list[tuple[float, float]]:
    """Three (x, y) pairs from ``x,y,x,y,x,y``.

    Raises:
        ValueError: not six finite numbers.
    """
    try:
        values = [float(part) for part in text.replace(" ", "").split(",")]
    except ValueError:
        values = []
    if len(values) != 6 or not all(math.isfinite(v) for v in values):
        order = "eye at image-left, eye at image-right, mouth"
        raise ValueError(f"landmarks: expected six numbers x,y,x,y,x,y ({order}), got {text!r}")
    return list(zip(values[::2], values[1::2], strict=True))


def parse_scenes(
    lights: Sequence[str],
    azimuth: Sequence[float] | None,
    elevation: Sequence[float] | None,
    size: float = 5.0,
) -> list[Scene]:
    """One scene of all ``lights``, or one of a single lamp for each pair of angles; one angle goes with all others.

    Raises:
        ValueError: both ways at once, lists that do not pair up, the same lamp twice, or a number out of range.
    """
    from facerelight.geometry.sources import Lamp

    if lights:
        if azimuth is not None or elevation is not None:
            raise ValueError("lights: expected --light, or --azimuth and --elevation, got both")
        lamps = tuple(parse_lamp(text, size) for text in lights)
        return [Scene(lamps, lamps[0].azimuth, lamps[0].elevation)]
    across, up = list(azimuth or [0.0]), list(elevation or [0.0])
    count = max(len(across), len(up))
    if not {len(across), len(up)} <= {1, count}:
        got = f"{len(across)} and {len(up)}"
        raise ValueError(f"lights: expected as many azimuths as elevations, or one of either, got {got}")
    pairs = list(zip(across * (count // len(across)), up * (count // len(up)), strict=True))
    twice = next((pair for k, pair in enumerate(pairs) if pair in pairs[:k]), None)
    if twice:
        raise ValueError(f"lights: expected different lights, got azimuth {twice[0]:g}, elevation {twice[1]:g} twice")
    return [Scene((Lamp(a, e, size),), a, e) for a, e in pairs]


def scene_paths(path: Path, scenes: Sequence[Scene]) -> list[Path]:
    """A file for each scene: ``path`` itself for one, else with ``_AZ_EL``, to as many digits as tell them apart.

    Example:
        >>> scenes = [Scene((), 10.2, 0), Scene((), 10.4, 0)]
        >>> [path.name for path in scene_paths(Path("relit.png"), scenes)]
        ['relit_+10.2_+0.0.png', 'relit_+10.4_+0.0.png']
    """
    if len(scenes) == 1:
        return [path]
    for digits in range(DIGITS + 1):
        labels = ["_".join(f"{round(v, digits) + 0.0:+.{digits}f}" for v in scene[1:]) for scene in scenes]
        if len(set(labels)) == len(scenes):
            break
    else:
        raise ValueError(f"lights: expected lights that differ by more than 1e-{DIGITS} degrees")
    return [path.with_name(f"{path.stem}_{label}{path.suffix}") for label in labels]


def _linear(colour: str) -> tuple[float, float, float]:
    """Linear RGB of ``RRGGBB`` or ``RGB`` in hexadecimal, with or without a hash."""
    digits = colour.removeprefix("#")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    if len(digits) != 6:
        raise ValueError(colour)
    coded = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    red, green, blue = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in coded)
    return red, green, blue
