"""The individual subspace without synthesis (6.2) against that of synthesised exemplars: angles, recognition rates and
time.

python scripts/measure_subspace.py --data yaleb_192x168.npz

Extended Yale B, four folds, real registered statistics, whole-face model: everybody enrolled from one image (front,
then side), all other images as probes, nine dimensions, no photometric normalisation. Light distributions: the thesis's
30 x 30 grid of angles (6.3) and the uniform hemisphere by quadrature (6.1), the same nodes and weights for both ways.
The moments of the features are computed once for all people.
"""

import argparse
import time
from pathlib import Path

import torch

from facerelight.evaluation import SOURCES
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.geometry.lights import light_from_angles, nearest_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.exemplars import direct_subspace, exemplar_lights, light_moments
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.subspaces import principal_angles, principal_subspace

DIMENSION = 9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="yaleb_192x168.npz or a CroppedYale folder")
    parser.add_argument("--height", type=int, default=96)
    parser.add_argument("--width", type=int, default=84)
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    images, valid = to_grid(faces)
    rows: dict[tuple[str, str], dict[str, list[float]]] = {}
    for fold in range(4):
        out = torch.arange(len(images)) % 4 == fold
        learned = FaceStatistics.fit(
            align_people(images[~out], faces.lights, valid[~out]),
            faces.lights,
            valid[~out],
            FitOptions(face_rank=18, brightness=True),
        )
        relighter = StatisticalRelighter(learned, "face")
        for case, angles in SOURCES.items():
            light = int(nearest_lights(light_from_angles(*angles)[None], faces.lights))
            people = (out & valid[:, light]).nonzero()[:, 0].tolist()
            posteriors = [relighter.condition(images[p, light][None, None], faces.lights[light][None]) for p in people]
            probes, labels = [], []
            for person in people:
                kept = [x for x in valid[person].nonzero()[:, 0].tolist() if x != light]
                probes.append(images[person, kept])
                labels += [person] * len(kept)
            for kind in ("grid", "hemisphere"):
                lights, weights = exemplar_lights(kind)
                moments = light_moments(posteriors[0], lights, weights)
                row = rows.setdefault(
                    (kind, case), {name: [] for name in ("angles", "slow", "fast", "synthesised", "direct")}
                )
                spaces: dict[str, list] = {"synthesised": [], "direct": []}
                for posterior in posteriors:
                    started = time.perf_counter()
                    made = posterior.mean(lights)[0].flatten(1)
                    spaces["synthesised"].append(principal_subspace(made, DIMENSION, weights=weights))
                    middle = time.perf_counter()
                    spaces["direct"].append(direct_subspace(posterior.people[0], moments, DIMENSION))
                    row["fast"].append(time.perf_counter() - middle)
                    row["slow"].append(middle - started)
                    row["angles"].append(
                        principal_angles(spaces["synthesised"][-1].basis, spaces["direct"][-1].basis).tolist()
                    )
                for name, found in spaces.items():
                    classifier = IndividualPCAClassifier(DIMENSION).fit_subspaces(found, people)
                    right = [a == b for a, b in zip(classifier.predict(torch.cat(probes)), labels, strict=True)]
                    row[name] += [float(r) for r in right]
    print(
        "| lights | input | angle, median of 9, largest | rank-1, synthesised | rank-1, direct"
        " | time, synthesised | direct | share |\n" + "|---" * 8 + "|"
    )
    for (kind, case), row in rows.items():
        angle = torch.tensor(row["angles"])
        slow, fast = (float(torch.tensor(row[name]).median()) for name in ("slow", "fast"))
        rates = [100 * sum(row[name]) / len(row[name]) for name in ("synthesised", "direct")]
        print(
            f"| {kind} | {case} | {float(angle.median()):.1f}, {float(angle.amax(1).median()):.1f}"
            f" | {rates[0]:.1f} | {rates[1]:.1f}"
            f" | {1e3 * slow:.0f} ms | {1e3 * fast:.1f} ms | 1/{slow / fast:.0f} |"
        )


if __name__ == "__main__":
    main()
