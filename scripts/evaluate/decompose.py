"""How good shading, reflectance, normals and light of a decomposed portrait are, beside pictures whose parts are known.

python scripts/evaluate/decompose.py --csv
python scripts/evaluate/decompose.py --data FOLDER_OF_THE_SCAN --heads 0 --tones tan --csv part.csv
python scripts/evaluate/decompose.py --join part.csv other_part.csv --csv

Rendered heads that no statistics have seen, and with ``--data`` Lee Perry-Smith's scan, ray traced, in three skin
tones; under lamps and taken by a camera that the package does not know. Errors are of the face: the median angle of
normals, the root mean square of reflectance and shading after one gain (percent of their mean), the angle of the
light's middle; and how many percent lie inside the 95 % interval that is claimed.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.rendered.decomposition import measure_decomposition
from facerelight.evaluation.rendered.truth import SETUPS, TruePicture, rendered_pictures, scanned_pictures
from facerelight.evaluation.results import ScriptParser, joined_rows, markdown
from facerelight.evaluation.scan import TONES, ScannedHead
from facerelight.photo import PhotoRelighter, load_relighter


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=5, help="rendered, held out; 0: none")
    parser.add_argument("--seed", type=int, default=7919)
    parser.add_size(420, 368)
    parser.add_argument("--margin", type=float, default=0.6, help="around the face, of the canonical crop")
    parser.add_argument("--data", type=Path, help="folder of the scan: lps_head.npz and color.jpg")
    parser.add_argument("--setups", nargs="+", choices=list(SETUPS), default=list(SETUPS))
    parser.add_argument("--tones", nargs="+", choices=list(TONES), default=list(TONES), help="of the scan's skin")
    parser.add_argument("--join", type=Path, nargs="+", metavar="CSV", help="make the table of several runs' files")
    parser.add_results("csv")
    args = parser.parse_args()
    if args.join:
        rows = joined_rows(args.join, ("heads", "setup", "row"), "pictures")
        rows.sort(key=lambda row: (str(row["heads"]), row["setup"] != "all"))
        print(markdown(rows))
        parser.save_rows(args.csv, rows)
        return 0
    torch.set_grad_enabled(False)
    relighter = load_relighter()
    config = replace(
        DEFAULT_CONFIG,
        heads=max(args.heads, 2),
        seed=args.seed,
        height=args.height,
        width=args.width,
        margin=args.margin,
        supersample=1,
    )

    def pictures() -> Iterator[tuple[str, str, TruePicture]]:
        setups = {name: SETUPS[name] for name in args.setups}
        if args.heads:
            for name, truth in rendered_pictures(config, setups):
                yield "rendered", name, truth
        if args.data:
            head = ScannedHead(args.data)
            for tone in args.tones:
                for name, truth in scanned_pictures(head, tone, setups):
                    yield "scan", name, truth

    found: dict[tuple[str, str, str], list[dict[str, float]]] = {}
    for kind, setup, truth in pictures():
        session = PhotoRelighter(truth.photo, truth.landmarks, relighter)
        for row, scores in measure_decomposition(session, session.decompose(), truth).items():
            for light in ("all", setup):
                found.setdefault((kind, light, row), []).append(scores)
        print(kind, setup, flush=True, file=sys.stderr)
    rows = []
    for (kind, light, row), scores in sorted(found.items(), key=lambda item: (item[0][0], item[0][1] != "all")):
        means = {name: round(sum(one[name] for one in scores) / len(scores), 2) for name in scores[0]}
        rows.append({"heads": kind, "setup": light, "row": row, "pictures": len(scores), **means})
    print(markdown(rows))
    parser.save_rows(args.csv, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
