"""Does light matter to a good recogniser? SFace where light is bad, with the photographs as they are and relit.

    python scripts/evaluate/hard_light.py --data yaleb_192x168.npz --csv

28 people of Extended Yale B, one photograph each enrolled, landmarks found. Each kind of bad light has its own probes:
`probe` relights these to even light, `gallery` enrolls five relit pictures beside the photograph and takes the best,
`both` does both. rank1 in percent with its 95 % interval (Wilson), a probe without a face counts as wrong; named:
rightly, at the threshold where 1 % of wrong people pass.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.config import PACKAGED
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.identification.scores import rank_one, wilson
from facerelight.evaluation.identification.shots import yale_photo
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.sources import Lamp
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter
from facerelight.photo.faces.landmarks import Face, find_faces
from facerelight.recognition.embedding import aligned_crop
from facerelight.recognition.sface import SFace

EVEN = Lamp(0, 0, size=40)
LIGHTS = [Lamp(azimuth, elevation, size=15) for azimuth, elevation in ((0, 0), (50, 10), (-50, 10), (0, 45), (0, -35))]
FRONT = ((0, 0),)
MILD = ((10, 0), (-25, 0), (35, 15))
Degrade = Callable[[torch.Tensor, torch.Generator], np.ndarray]


def as_it_is(radiance: torch.Tensor, generator: torch.Generator) -> np.ndarray:
    return yale_photo(radiance)


def under_exposed(radiance: torch.Tensor, generator: torch.Generator) -> np.ndarray:
    """Four stops under, with a small camera's shot and read noise."""
    dark = radiance / 16
    noise = torch.randn(radiance.shape, generator=generator) * (dark / 2000 + 0.001**2).sqrt()
    return yale_photo((dark + noise).clamp(0, 1))


def nearly_black(radiance: torch.Tensor, generator: torch.Generator) -> np.ndarray:
    """Six stops under, no noise but the eight bits'."""
    return yale_photo(radiance / 64)


def small(radiance: torch.Tensor, generator: torch.Generator) -> np.ndarray:
    """32 pixels between the eyes."""
    photo = yale_photo(radiance)
    size = round(photo.shape[1] / 3), round(photo.shape[0] / 3)
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA)


class Kind(NamedTuple):
    """Lights of the photographs enrolled (in turn) and of the probes, azimuth and elevation, and what is done to the
    probes."""

    enrolled: tuple[tuple[int, int], ...]
    probes: tuple[tuple[int, int], ...]
    degrade: Degrade = as_it_is


KINDS = {
    "mild light": Kind(FRONT, MILD),
    "subset 5: from behind the face's plane": Kind(FRONT, ((-110, 15), (110, 15), (95, 0))),
    "hard light from below": Kind(FRONT, ((-20, -40), (50, -40), (0, -35))),
    "four stops under, with noise": Kind(FRONT, MILD, under_exposed),
    "six stops under": Kind(FRONT, MILD, nearly_black),
    "32 pixels between the eyes, from the side": Kind(FRONT, ((70, 0), (-70, 0), (60, 20)), small),
    "enrolled under the worst light": Kind(((-110, 15), (110, 15), (95, 0), (-95, 0), (-20, -40)), MILD),
}


class Seen(NamedTuple):
    person: int
    photo: np.ndarray
    face: Face | None


def look(faces: FaceImages, person: int, angles: tuple[int, int], degrade: Degrade) -> Seen | None:
    """The photograph of a person under a light; None where there is none."""
    light = int((faces.angles - torch.tensor(angles)).abs().sum(1).argmin())
    found = ((faces.subject == person) & (faces.light == light)).nonzero()[:, 0].tolist()
    if not found:
        return None
    photo = degrade(faces.images[found[0]], torch.Generator().manual_seed(1000 * person + light))
    seen = find_faces(photo)
    return Seen(person, photo, seen[0] if seen else None)


def relit(seen: Seen, relighter: StatisticalRelighter, lamps: list[Lamp], fill: float) -> list[np.ndarray]:
    session = PhotoRelighter(seen.photo, None, relighter, face=seen.face)
    return [session.render(lamp, fill=fill) for lamp in lamps]


def vectors(network: SFace, photos: list[np.ndarray], face: Face) -> torch.Tensor:
    return network(np.stack([aligned_crop(photo, face, network.crop) for photo in photos]))


def enroll(
    angles: tuple[tuple[int, int], ...], faces: FaceImages, relighter: StatisticalRelighter, network: SFace
) -> torch.Tensor:
    """Everybody's photograph, from the first of the lights that shows a face, and its relit pictures, ``(N, 6, 128)``;
    zeros where none does."""
    several = torch.zeros(len(faces.names), len(LIGHTS) + 1, 128)
    for person in range(len(faces.names)):
        wanted = (angles[(person + i) % len(angles)] for i in range(len(angles)))
        shots = (look(faces, person, one, as_it_is) for one in wanted)
        shot = next((shot for shot in shots if shot and shot.face), None)
        if shot is not None and shot.face is not None:
            photos = [shot.photo, *relit(shot, relighter, LIGHTS, 0.1)]
            several[person] = vectors(network, photos, shot.face)
    return several


def measure(
    name: str, faces: FaceImages, relighter: StatisticalRelighter, several: torch.Tensor
) -> list[dict[str, object]]:
    kind, network, people = KINDS[name], SFace(), len(faces.names)
    plain, missing = several[:, 0], int((several[:, 0].square().sum(1) == 0).sum())
    shots = [look(faces, person, angles, kind.degrade) for person in range(people) for angles in kind.probes]
    probes = [shot for shot in shots if shot is not None]
    owners = torch.tensor([probe.person for probe in probes])
    shown, even = torch.zeros(len(probes), 128), torch.zeros(len(probes), 128)
    for row, probe in enumerate(probes):
        if probe.face is not None:
            shown[row] = vectors(network, [probe.photo], probe.face)[0]
            even[row] = vectors(network, relit(probe, relighter, [EVEN], 1.0), probe.face)[0]
    found = torch.tensor([probe.face is not None for probe in probes])
    best = (several @ shown.T).amax(1).T, (several @ even.T).amax(1).T
    scores = {"as it is": shown @ plain.T, "probe": even @ plain.T, "gallery": best[0], "both": best[1]}
    rows = []
    for which, table in scores.items():
        table = table.masked_fill(~found[:, None], -torch.inf)
        share = rank_one(table, owners)
        low, high = wilson(round(share * len(probes)), len(probes))
        own = torch.nn.functional.one_hot(owners, people).bool()
        wrong = table.masked_fill(own, -torch.inf).amax(1)
        limit = wrong[found].quantile(0.99)
        right = (table[own] > limit) & (table.argmax(1) == owners) & found
        rows.append(
            {
                "light": name,
                "relit": which,
                "rank1": round(100 * share, 1),
                "low": round(100 * low, 1),
                "high": round(100 * high, 1),
                "named": round(100 * float(right.double().mean()), 1),
                "found": round(100 * float(found.double().mean()), 1),
                "probes": len(probes),
                "not enrolled": missing,
            }
        )
    return rows


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--kind", nargs="+", choices=list(KINDS), default=list(KINDS), help="of bad light")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, 192, 168)
    relighter = StatisticalRelighter.from_pretrained(PACKAGED)
    rows = []
    enrolled: dict[tuple[tuple[int, int], ...], torch.Tensor] = {}
    for name in args.kind:
        angles = KINDS[name].enrolled
        if angles not in enrolled:
            enrolled[angles] = enroll(angles, faces, relighter, SFace())
        rows += measure(name, faces, relighter, enrolled[angles])
        print(markdown(rows[-4:]), flush=True)
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
