"""Geometry buffers and light-side depth maps, rendered headless by pyrender in linear float32.

pyrender's own output is 8 bits, gamma coded and clamped (fit for viewing, not for statistics), so this module keeps pyrender's scene,
camera, mesh and EGL machinery and replaces the shader and the framebuffer: every pass writes plain float32 values and reads them back.
Nothing else in the package touches OpenGL.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
if not hasattr(np, "infty"):  # pyrender 0.1.45 predates NumPy 2
    np.infty = np.inf  # type: ignore[attr-defined]

import pyrender  # noqa: E402
from OpenGL import GL  # noqa: E402
from pyrender.renderer import Renderer  # noqa: E402
from pyrender.shader_program import ShaderProgramCache  # noqa: E402

VERTEX_SHADER = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 texcoord;
layout(location = 3) in vec4 color;
layout(location = 4) in mat4 instance;
uniform mat4 M; uniform mat4 V; uniform mat4 P;
out vec3 world; out vec3 world_normal; out vec4 feature;
void main() {
    vec4 p = M * instance * vec4(position, 1.0);
    world = p.xyz; world_normal = mat3(M * instance) * normal; feature = color;
    gl_Position = P * V * p;
}
"""
SURFACE_SHADER = """#version 330 core
in vec3 world; in vec3 world_normal; in vec4 feature;
layout(location = 0) out vec4 out_position;
layout(location = 1) out vec4 out_normal;
layout(location = 2) out vec4 out_attribute;
void main() {
    out_position = vec4(world, 1.0); out_normal = vec4(normalize(world_normal), 1.0); out_attribute = feature;
}
"""
DEPTH_SHADER = """#version 330 core
in vec3 world; in vec3 world_normal; in vec4 feature;
uniform mat4 V;
layout(location = 0) out float height;
void main() { height = (V * vec4(world, 1.0)).z; }
"""
