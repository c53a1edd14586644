"""The individual subspace without synthesis (6.2) against that of synthesised exemplars: angles, recognition rates and
time.

python scripts/measure/subspace.py --data yaleb_192x168.npz

Extended Yale B, four folds, real registered statistics, whole-face model: everybody enrolled from one image (front,
then side), all other images as probes, nine dimensions, no photometric normalisation. Light distributions: the thesis's
30 x 30 grid of angles (6.3) and the uniform hemisphere by quadrature (6.1), the same nodes and weights for both ways.
The moments of the features are computed once for all people.
"""

import time

import torch

from facerelight.evaluation import SOURCES
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, markdown
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
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_size(96, 84)
    parser.add_results("csv")
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
    lines: list[dict[str, object]] = []
    for (kind, case), row in rows.items():
        angle = torch.tensor(row["angles"])
        slow, fast = (float(torch.tensor(row[name]).median()) for name in ("slow", "fast"))
        rates = [round(100 * sum(row[name]) / len(row[name]), 1) for name in ("synthesised", "direct")]
        lines.append(
            {"lights": kind, "input": case, "angle, median of 9": round(float(angle.median()), 1)}
            | {"largest": round(float(angle.amax(1).median()), 1)}
            | {"rank-1, synthesised": rates[0], "rank-1, direct": rates[1]}
            | {"ms, synthesised": round(1e3 * slow), "ms, direct": round(1e3 * fast, 1)}
            | {"share": f"1/{slow / fast:.0f}"}
        )
    print(markdown(lines))
    parser.save_rows(args.csv, lines)


if __name__ == "__main__":
    main()
