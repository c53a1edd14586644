"""Pack the first identity modes of ICT-FaceKit (MIT) into ``facerelight/bootstrap/data/identities.npz``.

Only needed to rebuild the packed file that the package already carries. ``ict_heads.npz`` holds ICT-FaceKit's
``generic_neutral_mesh.obj`` and ``identity000.obj`` to ``identity099.obj`` as arrays: ``vertices (V, 3)``,
``identity_basis (100, V, 3)``, ``triangles``, ``triangle_part``, ``part_names`` and ``landmarks68``.

    python scripts/data/pack_identities.py ict_heads.npz facerelight/bootstrap/data/identities.npz
"""

from pathlib import Path

import numpy as np

from facerelight.bootstrap.heads.identities import read_identities
from facerelight.evaluation.results import ScriptParser

MODES = 60
STEPS = 1000  # of the distance between the eyes: how finely modes are kept


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("source", type=Path, help="ict_heads.npz")
    parser.add_argument("output", type=Path, help="identities.npz to write")
    args = parser.parse_args()
    found = read_identities(args.source)
    used, flat = np.unique(found.triangles, return_inverse=True)
    place = np.full(len(found.vertices), -1)
    place[used] = np.arange(len(used))
    marks = place[found.marks]
    if (marks < 0).any():
        raise ValueError(f"{args.source}: expected landmarks on the parts that are kept, got others")
    eyes = found.vertices[found.marks]
    step = float(np.linalg.norm(eyes[36:42].mean(0) - eyes[42:48].mean(0))) / STEPS
    steps = np.round(found.modes[:MODES, used].astype(np.float64) / step).astype(np.int16).transpose(0, 2, 1)
    first = np.zeros((*steps.shape[:2], 1), np.int16)
    np.savez_compressed(
        args.output,
        vertices=found.vertices[used].astype(np.float32),
        triangles=flat.reshape(-1, 3).astype(np.uint16),
        eye=np.flatnonzero(found.is_eye[used]).astype(np.uint16),
        marks=marks.astype(np.uint16),
        modes=np.diff(steps, axis=-1, prepend=first),  # vertices that follow each other are neighbours
        step=np.float64(step),
    )
    print(f"{args.output}: {len(used)} vertices, {MODES} modes, {args.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
