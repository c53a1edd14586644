"""Readers of MakeHuman's files."""

import gzip
from pathlib import Path

import numpy as np

from facerelight.bootstrap.heads.makehuman_files import read_obj, read_target

OBJ = """# a square and a triangle
v 0 0 0
v 1 0 0
v 1 1 0.5
v 0 1 0

vt 0 0
vt 1 1
g body
f 1/1 2/2 3/2 4/1
g eye
f 1/1/1 2/2/1 3/2/1
"""


def test_a_mesh_with_groups(tmp_path: Path) -> None:
    (tmp_path / "base.obj").write_text(OBJ)
    vertices, uv, groups = read_obj(tmp_path / "base.obj")
    assert vertices.tolist()[2] == [1, 1, 0.5]
    assert uv.tolist() == [[0, 0], [1, 1]]
    assert groups == {"body": [[(0, 0), (1, 1), (2, 1), (3, 0)]], "eye": [[(0, 0), (1, 1), (2, 1)]]}


def test_a_target_packed_or_not(tmp_path: Path) -> None:
    text = "# moved\n2 0.5 0 -1\n"
    (tmp_path / "nose.target").write_text(text)
    with gzip.open(tmp_path / "nose.target.gz", "wt") as file:
        file.write(text)
    wanted = np.zeros((4, 3))
    wanted[2] = 0.5, 0, -1
    for name in ("nose.target", "nose.target.gz"):
        assert (read_target(tmp_path / name, 4) == wanted).all()
