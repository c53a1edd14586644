"""Recognition across light, pose and expression (6.4, 7.3): one frontal photograph a person, held-out rendered heads.

Exemplars of each person are rendered under other lights, poses and expressions from the one photograph, with statistics
rendered on demand; a person is the PCA subspace of them. Probes lie between the exemplars' views.

python scripts/evaluate/views.py --markdown views.md
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.photometric import make_normalizer
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter

LIGHTS = [(0.0, 0.0), (45.0, 0.0), (-45.0, 0.0), (0.0, 40.0), (0.0, -35.0), (70.0, 10.0), (-70.0, 10.0)]
POSES = [0.0, 20.0, -20.0, 40.0, -40.0]


def exemplar_views(expressions: list[tuple[tuple[str, float], ...]]) -> dict[str, list[View]]:
    """Views of the exemplars, by what they vary over."""
    lights = [View(light=light) for light in LIGHTS]
    poses = [View(azimuth, light=light) for azimuth in POSES for light in LIGHTS[:4]]
    moods = [View(light=light, expression=expression) for expression in expressions for light in LIGHTS[:4]]
    return {"light": lights, "light, pose": lights + poses, "light, pose, expression": lights + poses + moods}


def probe_views(expressions: list[tuple[tuple[str, float], ...]]) -> dict[str, list[View]]:
    """Views of the probes, by what is new in them."""
    half = [tuple((name, 0.7 * weight) for name, weight in expression) for expression in expressions]
    return {
        "light": [View(light=light) for light in ((30.0, 20.0), (-60.0, 0.0), (60.0, -10.0))],
        "pose": [View(azimuth) for azimuth in (10.0, -30.0, 30.0, -45.0)],
        "expression": [View(expression=expression) for expression in half],
        "light and pose": [View(-15.0, light=(40.0, 10.0)), View(30.0, light=(-40.0, 0.0))],
        "all three": [View(15.0, light=(-35.0, 15.0), expression=expression) for expression in half],
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=80)
    parser.add_argument("--people", type=int, default=20, help="held-out heads, all enrolled")
    parser.add_size(64, 56)
    parser.add_argument("--expressions", nargs="+", default=None, help="names of two or more expression shapes")
    parser.add_argument("--markdown", type=Path, default=None, help="the table as Markdown")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    names = args.expressions or ["mouthSmileLeft+mouthSmileRight", "jawOpen"]
    expressions = [tuple((part, 0.8) for part in name.split("+")) for name in names]
    config = TrainConfig(args.heads, "makehuman", height=args.height, width=args.width, supersample=1)
    with tempfile.TemporaryDirectory() as folder:
        source = BootstrapViews(config, folder)
        people = BootstrapViews(replace(config, heads=args.people), folder, first=args.heads)
        photos, labels = people.images(View()).clamp(0, 1), list(range(args.people))
        relighter = ViewRelighter(source, rank=40)
        rendered: dict[View, torch.Tensor] = {}
        every = exemplar_views(expressions)["light, pose, expression"]
        for view in tqdm(every, desc="rendering exemplars"):
            rendered[view] = relighter(photos[:, None], [View()], view).mean.clamp(0, 1)
        probes = {
            name: torch.cat([people.images(view) for view in views]).clamp(0, 1)
            for name, views in probe_views(expressions).items()
        }
    rows: list[dict[str, object]] = []

    def row(name: str, classifier: NearestNeighborClassifier | IndividualPCAClassifier) -> None:
        scores = {
            what: round(100 * classifier.score(images, labels * (len(images) // len(labels))))
            for what, images in probes.items()
        }
        rows.append({"exemplars over": name, **scores})

    normalizer = make_normalizer("weber")
    row("(none) the photograph", NearestNeighborClassifier().fit(photos, labels))
    row(
        "(none) the photograph, Weber faces",
        NearestNeighborClassifier("cosine", normalizer=normalizer).fit(photos, labels),
    )
    for name, views in exemplar_views(expressions).items():
        images = torch.cat([photos, *(rendered[view] for view in views)])
        owners = labels * (len(images) // len(labels))
        row(name, IndividualPCAClassifier(9).fit(images, owners))
        row(f"{name}, Weber faces", IndividualPCAClassifier(9, normalizer=normalizer).fit(images, owners))
        row(f"{name}, nearest exemplar", NearestNeighborClassifier().fit(images, owners))
    parser.print_rows(rows, args.markdown)
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
