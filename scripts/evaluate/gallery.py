"""`facerelight recognize` end to end, from photographs: one of each person enrolled, landmarks found by the package.

    python scripts/evaluate/gallery.py --data yaleb_192x168.npz --json gallery.json --csv
    python scripts/evaluate/gallery.py --data people/ --json people.json

Extended Yale B as a person would photograph it: sRGB, in a larger picture. Everybody is enrolled from one of five mild
lights; probes are six other lights, up to 70 degrees to the side. Of a folder NAME/*.jpg the first photo is enrolled.

All figures but seconds are percent. rank1: all enrolled, a probe without a face counts as wrong. Open set: every other
person is enrolled and the rest are strangers, then the other way round, averaged: eer, the equal error; far1, named
rightly where 1 % of strangers are let in; let_in and named, at the threshold that `--far 0.01` calibrates on the
enrolled alone. seconds: finding the face, describing it and comparing it with everybody.
"""

import time
from pathlib import Path

import numpy as np
import torch

from facerelight.config import find_statistics
from facerelight.evaluation.identification.scores import equal_error, identified_at, open_set, rank_one, standardised
from facerelight.evaluation.identification.shots import Shot, find_face, folder_shots, turn_photo, yale_shots
from facerelight.evaluation.results import FACES, ScriptParser, markdown
from facerelight.geometry.sources import Lamp
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter
from facerelight.photo.faces.landmarks import Face
from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer
from facerelight.recognition.gallery.individual import IndividualRecognizer, NearestPhotoRecognizer
from facerelight.recognition.gallery.recognizer import Levels, Recognizer
from facerelight.recognition.sface import SFace, sface_weights

FAR = 0.01
EVEN = Lamp(0, 0, size=40)  # light from everywhere before the face
LIGHTS = [Lamp(azimuth, elevation, size=15) for azimuth, elevation in ((0, 0), (50, 10), (-50, 10), (0, 45), (0, -35))]
TURN, SCALE = 10.0, 1.3
Scores = tuple[torch.Tensor, torch.Tensor, Levels, bool, float]


def compare(
    recognizer: Recognizer, seen: list[tuple[Shot, Face | None]], relighter: StatisticalRelighter, relight: str
) -> Scores:
    """Scores of probes ``(P, M)`` and of the enrolled ``(M, M)`` with each person's best template, the recogniser's
    levels, and seconds a probe."""
    templates, owners, enrolled = [], [], []
    for shot, face in seen:
        if not shot.enrolled:
            continue
        assert face is not None
        photos = [shot.photo]
        if relight == "gallery":
            session = PhotoRelighter(shot.photo, None, relighter, face=face)
            photos += [session.render(lamp) for lamp in LIGHTS]
        templates += [recognizer.enroll(photo, face) for photo in photos]
        owners += [shot.person] * len(photos)
        enrolled.append(templates[-len(photos)]["probe"][0])
    index = recognizer.index({part: torch.cat([one[part] for one in templates]) for part in templates[0]})
    people = torch.tensor(owners)

    def scored(probe: torch.Tensor) -> torch.Tensor:
        found, rows = index.search(probe, len(owners))
        empty = torch.full((len(enrolled),), -torch.inf)
        return empty.scatter_reduce(0, people[rows], found, "amax")

    started, rows = time.perf_counter(), []
    for shot, face in seen:
        if shot.enrolled:
            continue
        if face is None:
            rows.append(torch.full((len(enrolled),), -torch.inf))
            continue
        photo = shot.photo
        if relight == "probe":
            photo = PhotoRelighter(photo, None, relighter, face=face).render(EVEN, fill=1.0)
        rows.append(scored(recognizer.describe(photo, face)))
    seconds = (time.perf_counter() - started) / len(rows)
    own = torch.stack([scored(probe) for probe in enrolled])
    return torch.stack(rows), own, recognizer.levels, recognizer.personal, seconds


def summary(scores: Scores, owners: torch.Tensor) -> dict[str, float]:
    probes, enrolled, levels, personal, seconds = scores
    even = torch.arange(len(enrolled)) % 2 == 0
    halves = [open_set(probes, owners, enrolled, known, levels, personal, FAR) for known in (even, ~even)]
    each = [
        {
            "eer": equal_error(half.genuine, half.strangers),
            "far1": identified_at(half.genuine, half.strangers, FAR),
            "let_in": float((half.strangers >= half.threshold).double().mean()),
            "named": float((half.genuine >= half.threshold).double().mean()),
        }
        for half in halves
    ]
    figures = {"rank1": 100 * rank_one(standardised(probes, enrolled, levels, personal), owners)}
    figures |= {name: 50 * sum(half[name] for half in each) for name in each[0]}
    return {name: round(value, 2) for name, value in figures.items()} | {"seconds": round(seconds, 4)}


def summed(one: Scores, other: Scores) -> Scores:
    """The sum rule (Kittler et al. 1998) over standardised scores."""
    probes = standardised(one[0], *one[1:4]) + standardised(other[0], *other[1:4])
    enrolled = standardised(one[1], *one[1:4]) + standardised(other[1], *other[1:4])
    return probes, enrolled, Levels(0.0, 2**0.5, 1.0, 0.0), False, one[4] + other[4]


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--data", type=Path, required=True, help=f"{FACES}, or a folder of people, NAME/*.jpg")
    parser.add_argument("--landmarks", choices=["found", "exact"], default="found", help="exact: of Yale B alone")
    parser.add_argument(
        "--turned", type=int, default=0, metavar="N", help="turn and enlarge the first N people's photos"
    )
    parser.add_argument(
        "--every", action="store_true", help="all other good images of Yale B as probes, not six lights"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", help="of the recognisers; sface_probe_relit is slow")
    parser.add_results("csv", "json")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    people = args.data.is_dir() and not list(args.data.glob("yaleB*"))
    shots = folder_shots(args.data) if people else yale_shots(args.data, args.every)
    shots = [turn_photo(shot, TURN, SCALE) if shot.person < args.turned else shot for shot in shots]
    started = time.perf_counter()
    seen = [(shot, find_face(shot, args.landmarks == "exact")) for shot in shots]
    finding = (time.perf_counter() - started) / len(shots)
    missing = {shot.person for shot, face in seen if shot.enrolled and face is None}
    order = {person: i for i, person in enumerate(sorted({shot.person for shot, _ in seen} - missing))}
    seen = [(shot._replace(person=order[shot.person]), face) for shot, face in seen if shot.person in order]
    probes = [(shot, face) for shot, face in seen if not shot.enrolled]
    owners = torch.tensor([shot.person for shot, _ in probes])
    detected = 100 * float(np.mean([face is not None for _, face in probes]))
    relighter = StatisticalRelighter.from_pretrained(find_statistics())

    made: dict[str, tuple[Recognizer, str]] = {
        "individual_pca": (IndividualRecognizer(relighter), ""),
        "nearest_photo": (NearestPhotoRecognizer(relighter), ""),
    }
    if sface_weights():
        sface = EmbeddingRecognizer(SFace())
        made |= {"sface": (sface, ""), "sface_gallery_relit": (sface, "gallery"), "sface_probe_relit": (sface, "probe")}
    plain = [name for name in made if name != "sface_probe_relit"]
    wanted = args.only or [*plain, *(["sface+individual_pca", "sface+nearest_photo"] if sface_weights() else [])]
    unknown = {part for name in wanted for part in name.split("+")} - set(made)
    if unknown:
        parser.error(f"--only: expected of {', '.join(made)}, or two of them joined by +; got {', '.join(unknown)}")
    scores: dict[str, Scores] = {}
    results, rows = {}, []
    for name in sorted(wanted, key=lambda name: "+" in name):
        for part in name.split("+"):
            if part not in scores:
                scores[part] = compare(made[part][0], seen, relighter, made[part][1])
        first, *more = (scores[part] for part in name.split("+"))
        figures = summary(summed(first, more[0]) if more else first, owners)
        results[name] = figures | {"seconds": round(figures["seconds"] + finding, 4)}
        rows.append({"recogniser": name, **results[name]})
        print(rows[-1], flush=True)
    told = {"people": len(order), "probes": len(probes), "detected": round(detected, 2), "not_enrolled": len(missing)}
    print(told)
    print(markdown(rows))
    parser.save_rows(args.csv, [row | told for row in rows])
    parser.save_report(args.json, {"results": results, **told, "landmarks": args.landmarks})


if __name__ == "__main__":
    main()
