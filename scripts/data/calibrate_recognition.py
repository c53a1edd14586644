"""Learn the levels of the recognisers' scores, four numbers each, on ten people of CMU PIE.

    python scripts/data/calibrate_recognition.py --data pie10_55x44.npz

Every tenth photograph is enrolled, and all are probes. Prints mean and standard
deviation of scores between different people, and the logistic that turns a score, in such standard deviations above the
mean, into the probability that two photographs are of one person (Platt 1999): `SFACE_LEVELS` and `PIE_LEVELS` in
`facerelight/recognition/gallery`. What a gallery says of its own people outweighs them from five people on.
"""

from pathlib import Path

import cv2
import numpy as np
import torch
from sklearn.linear_model import LogisticRegression

from facerelight.config import PACKAGED
from facerelight.evaluation.datasets import load_pie
from facerelight.evaluation.identification.shots import yale_photo
from facerelight.evaluation.results import ScriptParser
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo.faces.landmarks import find_faces
from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer
from facerelight.recognition.gallery.individual import IndividualRecognizer
from facerelight.recognition.gallery.recognizer import Recognizer
from facerelight.recognition.sface import SFace

ENLARGED = 4  # times, for the face detector


def levels(recognizer: Recognizer, photos: list[np.ndarray], people: torch.Tensor, step: int) -> list[float]:
    """Mean and standard deviation of strangers' scores, slope and intercept of the logistic."""
    faces = [find_faces(photo)[0] for photo in photos]
    probes = [recognizer.describe(photo, face) for photo, face in zip(photos, faces, strict=True)]
    enrolled = torch.arange(0, len(photos), step)
    templates = [recognizer.enroll(photos[i], faces[i]) for i in enrolled.tolist()]
    whole = {part: torch.cat([one[part] for one in templates]) for part in templates[0]}
    owners = people[enrolled]
    index = recognizer.index(whole, owners)
    same, other = [], []
    for person in owners.unique():
        rest = (owners != person).nonzero()[:, 0]
        without = recognizer.index({part: values[rest] for part, values in whole.items()}, owners[rest])
        for number in (people == person).nonzero()[:, 0].tolist():
            scores, rows = index.search(probes[number], len(owners))
            same.append(scores[(owners[rows] == person) & (enrolled[rows] != number)])
            other.append(without.search(probes[number], len(rest))[0])
    right, wrong = torch.cat(same), torch.cat(other)
    mean, std = float(wrong.mean()), float(wrong.std())
    values = torch.cat((right, wrong)).sub(mean).div(std).double().numpy()[:, None]
    count, against = len(right), len(wrong)
    of_one = np.concatenate((np.full(count, (count + 1) / (count + 2)), np.full(against, 1 / (against + 2))))
    even = np.concatenate((np.full(count, 0.5 / count), np.full(against, 0.5 / against)))  # one pair in two
    both = np.concatenate((np.ones(len(values)), np.zeros(len(values))))
    weights = np.concatenate((of_one * even, (1 - of_one) * even)) * len(values)
    fitted = LogisticRegression(C=1e6).fit(np.concatenate((values, values)), both, weights)
    return [mean, std, float(fitted.coef_[0, 0]), float(fitted.intercept_[0])]


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--data", type=Path, required=True, help="pie10_55x44.npz")
    parser.add_argument("--step", type=int, default=10, help="every so many photographs are enrolled, 1 for all")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    pie = load_pie(args.data)
    size = pie.images.shape[2] * ENLARGED, pie.images.shape[1] * ENLARGED
    enlarged = [cv2.resize(image.numpy(), size, interpolation=cv2.INTER_CUBIC) for image in pie.images]
    photos = [yale_photo(torch.from_numpy(image)) for image in enlarged]
    relighter = StatisticalRelighter.from_pretrained(PACKAGED)
    for recognizer in (EmbeddingRecognizer(SFace()), IndividualRecognizer(relighter)):
        print(recognizer.name, [round(value, 4) for value in levels(recognizer, photos, pie.subject, args.step)])


if __name__ == "__main__":
    main()
