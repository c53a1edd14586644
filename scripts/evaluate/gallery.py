"""`facerelight recognize` end to end, from photographs: one of each person enrolled, landmarks found by the package.

    python scripts/evaluate/gallery.py --data yaleb_192x168.npz --json gallery.json --csv
    python scripts/evaluate/gallery.py --data people/ --json people.json

Extended Yale B as a person would photograph it: sRGB, in a larger picture. Everybody is enrolled from one of five mild
lights; probes are six other lights, up to 70 degrees to the side. Of a folder NAME/*.jpg the first photo is enrolled.

All figures but seconds are percent. rank1: all enrolled, a probe without a face counts as wrong. Open set: every other
person is enrolled and the rest are strangers, then the other way round (or N random halves, with --halves N), averaged:
eer, the equal error; far1, named rightly where 1 % of strangers are let in; let_in and named, at the threshold that
`--far 0.01` calibrates on the enrolled alone. seconds: finding the face, describing it and comparing it with everybody.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
from facerelight.recognition.gallery.individual import (
    IndividualRecognizer,
    NearestPhotoRecognizer,
    SubspaceIndex,
    leave_out_shared,
)
from facerelight.recognition.gallery.recognizer import Levels, Recognizer
from facerelight.recognition.sface import SFace, sface_weights

FAR = 0.01
EVEN = Lamp(0, 0, size=40)  # light from everywhere before the face
LIGHTS = [Lamp(azimuth, elevation, size=15) for azimuth, elevation in ((0, 0), (50, 10), (-50, 10), (0, 45), (0, -35))]
TURN, SCALE = 10.0, 1.3


class Split(NamedTuple):
    """The people ``known (M,)`` are enrolled: scores of probes ``(P, M)`` with each person's best template, minus
    infinity for who is not known, and of the known themselves ``(M, M)``, as strangers would score."""

    known: torch.Tensor
    probes: torch.Tensor
    enrolled: torch.Tensor


class Scores(NamedTuple):
    """With everybody enrolled, then with halves of them; the recogniser's levels; seconds a probe."""

    splits: list[Split]
    levels: Levels
    personal: bool
    seconds: float


def halved(people: int, count: int | None) -> list[torch.Tensor]:
    """Who is enrolled, ``(people,)`` each: every other person and the rest, or ``count`` random halves."""
    if count is None:
        even = torch.arange(people) % 2 == 0
        return [even, ~even]
    generator = torch.Generator().manual_seed(0)
    return [torch.randperm(people, generator=generator) < people // 2 for _ in range(count)]


def compare(
    recognizer: Recognizer,
    seen: list[tuple[Shot, Face | None]],
    relighter: StatisticalRelighter,
    relight: str,
    halves: int | None,
) -> Scores:
    one_by_one, owners = [], []
    for shot, face in seen:
        if not shot.enrolled:
            continue
        assert face is not None
        photos = [shot.photo]
        if relight == "gallery":
            session = PhotoRelighter(shot.photo, None, relighter, face=face)
            photos += [session.render(lamp) for lamp in LIGHTS]
        one_by_one += [recognizer.enroll(photo, face) for photo in photos]
        owners += [shot.person] * len(photos)
    templates = {part: torch.cat([one[part] for one in one_by_one]) for part in one_by_one[0]}
    people = torch.tensor(owners)
    everybody = people.unique()
    index = recognizer.index(templates, people)

    def compared(probe: torch.Tensor | None) -> torch.Tensor | None:
        """With every template, ``(M,)``, once for all who may be enrolled."""
        if probe is None:
            return None
        if isinstance(index, SubspaceIndex):
            return index.cosines(probe)
        scores, rows = index.search(probe, len(people))
        return torch.empty_like(scores).index_copy_(0, rows, scores)

    def table(probes: Sequence[torch.Tensor | None], known: torch.Tensor) -> torch.Tensor:
        """Scores ``(P, M)`` of probes, as :func:`compared`, with the people ``known (M,)`` alone enrolled."""
        rows = known[people].nonzero()[:, 0]
        found = torch.full((len(probes), len(everybody)), -torch.inf)
        for line, probe in zip(found, probes, strict=True):
            if len(rows) and probe is not None:
                own = probe[rows]
                scores = leave_out_shared(own, people[rows]) if isinstance(index, SubspaceIndex) else own
                line.scatter_reduce_(0, people[rows], scores, "amax")
        return found

    def described(shot: Shot, face: Face | None) -> torch.Tensor | None:
        if face is None:
            return None
        if relight == "probe":
            lit = PhotoRelighter(shot.photo, None, relighter, face=face).render(EVEN, fill=1.0)
            return recognizer.describe(lit, face)
        return recognizer.describe(shot.photo, face)

    def as_strangers(known: torch.Tensor) -> torch.Tensor:
        others = [known & (everybody != person) for person in everybody]
        rows = [table([one], who) for one, who in zip(photographs, others, strict=True)]
        return torch.cat(rows).nan_to_num(neginf=0)

    firsts = [int((people == person).nonzero()[0]) for person in everybody]
    photographs = [compared(templates["probe"][row]) for row in firsts]
    started = time.perf_counter()
    probes = [compared(described(shot, face)) for shot, face in seen if not shot.enrolled]
    all_of_them = torch.ones(len(everybody), dtype=torch.bool)
    first = table(probes, all_of_them)
    seconds = (time.perf_counter() - started) / len(probes)
    tables = [(known, table(probes, known)) for known in halved(len(everybody), halves)]
    splits = [Split(known, scores, as_strangers(known)) for known, scores in [(all_of_them, first), *tables]]
    return Scores(splits, recognizer.levels, recognizer.personal, seconds)


def summary(scores: Scores, owners: torch.Tensor) -> dict[str, float]:
    _, probes, enrolled = scores.splits[0]
    how = scores.levels, scores.personal
    each = []
    for split in scores.splits[1:]:
        half = open_set(split.probes, owners, split.enrolled, split.known, *how, FAR)
        each.append(
            {
                "eer": equal_error(half.genuine, half.strangers),
                "far1": identified_at(half.genuine, half.strangers, FAR),
                "let_in": float((half.strangers >= half.threshold).double().mean()),
                "named": float((half.genuine >= half.threshold).double().mean()),
            }
        )
    figures = {"rank1": 100 * rank_one(standardised(probes, enrolled, *how), owners)}
    figures |= {name: 100 * float(np.mean([half[name] for half in each])) for name in each[0]}
    figures["eer_worst"] = 100 * max(half["eer"] for half in each)
    return {name: round(value, 2) for name, value in figures.items()} | {"seconds": round(scores.seconds, 4)}


def summed(one: Scores, other: Scores) -> Scores:
    """The sum rule (Kittler et al. 1998) over scores standardised by who is enrolled."""
    splits = []
    for parts in zip(one.splits, other.splits, strict=True):
        known = parts[0].known
        probes, enrolled = torch.zeros_like(parts[0].probes), torch.zeros_like(parts[0].enrolled)
        for split, (_, levels, personal, _) in zip(parts, (one, other), strict=True):
            own = split.enrolled[known][:, known]
            probes[:, known] += standardised(split.probes[:, known], own, levels, personal)
            enrolled[:, known] += standardised(split.enrolled[:, known], own, levels, personal)
        splits.append(Split(known, probes.masked_fill(~known, -torch.inf), enrolled))
    return Scores(splits, Levels(0.0, 2**0.5, 1.0, 0.0), False, one.seconds + other.seconds)


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
    parser.add_argument("--halves", type=int, metavar="N", help="random halves of the people for the open set")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="of them; also sface_probe_relit")
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
                scores[part] = compare(made[part][0], seen, relighter, made[part][1], args.halves)
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
