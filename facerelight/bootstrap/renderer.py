"""Geometry buffers and light-side depth maps, rendered headless by pyrender in linear float32.

pyrender's own output is 8 bits, gamma coded and clamped (fit for viewing, not for statistics), so this module keeps
pyrender's scene, camera, mesh and EGL machinery and replaces the shader and the framebuffer: every pass writes plain
float32 values and reads them back. Nothing else in the package touches OpenGL.
"""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
if not hasattr(np, "infty"):  # pyrender 0.1.45 predates NumPy 2
    vars(np)["infty"] = np.inf

try:
    import pyrender
    from OpenGL import GL
    from OpenGL.EGL import eglDestroyContext
    from pyrender.platforms import egl
    from pyrender.renderer import Renderer
    from pyrender.shader_program import ShaderProgramCache
except ModuleNotFoundError as error:
    raise RuntimeError(
        f'rendering needs {error.name}, which is not installed; pip install "facerelight[train]"'
    ) from error
except (ImportError, AttributeError, OSError) as error:  # PyOpenGL raises any of these where libEGL is absent
    raise RuntimeError(
        f"rendering needs EGL, which could not be loaded ({error});"
        " on Debian: apt-get install -y libegl1 libgl1 libxrender1"
    ) from error

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
    world = p.xyz; world_normal = mat3(M * instance) * normal; feature = vec4(color.rgb, texcoord.x);
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
void main() {}
"""


class Geometry(NamedTuple):
    """What the camera sees: ``position``, ``normal`` ``(H, W, 3)``, ``attribute`` ``(H, W, 4)`` and ``inside``
    ``(H, W)`` bool."""

    position: np.ndarray
    normal: np.ndarray
    attribute: np.ndarray
    inside: np.ndarray


class _OneProgram(ShaderProgramCache):
    """Serves this module's shader for every mesh, whatever pyrender asks for."""

    def __init__(self, fragment: str) -> None:
        super().__init__()
        with tempfile.TemporaryDirectory() as folder:
            vertex_path, fragment_path = Path(folder, "pass.vert"), Path(folder, "pass.frag")
            vertex_path.write_text(VERTEX_SHADER)
            fragment_path.write_text(fragment)
            self.program = super().get_program(str(vertex_path), str(fragment_path))
            self.program._load = {str(vertex_path): VERTEX_SHADER, str(fragment_path): fragment}.__getitem__

    def get_program(self, *_: Any, **__: Any) -> Any:
        return self.program


class _FloatRenderer(Renderer):
    """pyrender's renderer into ``targets`` float32 RGBA buffers, or into a depth buffer alone."""

    def __init__(self, width: int, height: int, fragment: str, targets: int) -> None:
        super().__init__(width, height)
        self._program_cache = _OneProgram(fragment)
        self.targets = targets
        self._main_fb: int | None = None
        # left, top, width, height of the part that is drawn and read; None: all of it
        self.window: tuple[int, int, int, int] | None = None

    def _configure_main_framebuffer(self) -> None:
        size = self.viewport_width, self.viewport_height
        if self._main_fb is not None:
            return
        self._buffers = [int(GL.glGenRenderbuffers(1)) for _ in range(self.targets + 1)]
        self._main_fb = self._main_fb_ms = GL.glGenFramebuffers(1)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        attachments = [GL.GL_COLOR_ATTACHMENT0 + k for k in range(self.targets)]
        formats = [GL.GL_RGBA32F] * self.targets + [GL.GL_DEPTH_COMPONENT32F]
        for buffer, attachment, kind in zip(
            self._buffers, [*attachments, GL.GL_DEPTH_ATTACHMENT], formats, strict=True
        ):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, *size)
            GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        GL.glDrawBuffers(max(self.targets, 1), attachments or [GL.GL_NONE])
        if GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER) != GL.GL_FRAMEBUFFER_COMPLETE:
            raise RuntimeError("rendering: this OpenGL has no float32 framebuffers; update Mesa (llvmpipe has them)")

    def _configure_forward_pass_viewport(self, flags: int) -> None:
        super()._configure_forward_pass_viewport(flags)
        left, top, width, height = self._drawn()
        GL.glEnable(GL.GL_SCISSOR_TEST)
        GL.glScissor(left, self.viewport_height - top - height, width, height)

    def _drawn(self) -> tuple[int, int, int, int]:
        return self.window or (0, 0, self.viewport_width, self.viewport_height)

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb])
            GL.glDeleteRenderbuffers(len(self._buffers), self._buffers)
        self._main_fb = self._main_fb_ms = None

    def _read_main_framebuffer(self, scene, flags):  # type: ignore[no-untyped-def]
        left, top, width, height = self._drawn()
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        images = []
        for k in range(max(self.targets, 1)):
            if self.targets:
                GL.glReadBuffer(GL.GL_COLOR_ATTACHMENT0 + k)
            kind = GL.GL_RGBA if self.targets else GL.GL_DEPTH_COMPONENT
            data = GL.glReadPixels(left, self.viewport_height - top - height, width, height, kind, GL.GL_FLOAT)
            images.append(np.frombuffer(data, np.float32).reshape(height, width, -1)[::-1])
        return tuple(images)


class MeshRenderer:
    """Renders one mesh at a time: its geometry from the camera, and heights along a light for cast shadows.

    The camera is orthographic, on the +z axis; one mesh unit is one pixel of the crop and the origin its centre.

    Args:
        height, width: of the geometry images, in pixels.
        shadow_size: side of the square map seen from the light, in texels.
        extent: half the side of what that map covers, in mesh units.
        supersample: geometry samples a pixel along each side.
    """

    def __init__(
        self, height: int, width: int, shadow_size: int = 1024, extent: float = 1.0, supersample: int = 1
    ) -> None:
        self.extent, self.shadow_size, self.supersample = extent, shadow_size, supersample
        device = egl.get_device_by_index(int(os.environ.get("EGL_DEVICE_ID", "0")))
        self._context = egl.EGLPlatform(width, height, device=device)
        self._context.init_context()
        self._camera = _FloatRenderer(width * supersample, height * supersample, SURFACE_SHADER, 3)
        self._light = _FloatRenderer(shadow_size, shadow_size, DEPTH_SHADER, 0)
        self._view = pyrender.OrthographicCamera(width / 2, height / 2, znear=0.01, zfar=20 * extent)
        self._light_view = pyrender.OrthographicCamera(extent, extent, znear=0.01, zfar=20 * extent)

    def load(self, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, feature: np.ndarray) -> None:
        """Take a mesh: ``feature (V, 4)`` is interpolated along with positions and normals."""
        self._camera_scene = _scene(vertices, normals, triangles, feature)
        self._camera_scene.add(self._view, pose=_look_along(np.array([0.0, 0.0, 1.0]), 10 * self.extent))
        self._light_scene = _scene(vertices, normals, triangles, feature)
        self._light_node = self._light_scene.add(self._light_view)

    def geometry(self) -> Geometry:
        """One pass from the camera."""
        position, normal, feature = self._render(self._camera, self._camera_scene)
        return Geometry(position[..., :3], normal[..., :3], feature, position[..., 3] > 0.5)

    @staticmethod
    def light_frame(light: np.ndarray) -> np.ndarray:
        """The rotation ``(3, 3)`` into the frame of a light: its map's x and y, and the height along it."""
        return _look_along(light, 1.0)[:3, :3].T.astype(np.float32)

    def heights(self, light: np.ndarray, window: tuple[int, int, int, int] | None = None) -> np.ndarray:
        """The nearest surface seen from a light: heights along it; where nothing is, ten extents below the origin.

        Row i, column j of the map is the ray at ``x = ((j + 0.5) / S * 2 - 1) * extent``,
        ``y = (1 - (i + 0.5) / S * 2) * extent`` of :meth:`light_frame`.

        Args:
            light: unit vector ``(3,)``.
            window: left, top, width and height of the part of the map that is wanted; None: all of it, ``(S, S)``.
        """
        self._light_scene.set_pose(self._light_node, _look_along(light, 10 * self.extent))
        self._light.window = window
        (image,) = self._render(self._light, self._light_scene)
        near, far = self._light_view.znear, self._light_view.zfar
        return np.float32(10 * self.extent - near) - np.float32(far - near) * image[..., 0]

    def _render(self, renderer: _FloatRenderer, scene: pyrender.Scene) -> tuple[np.ndarray, ...]:
        self._context.make_current()
        flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.OFFSCREEN
        return renderer.render(scene, flags if renderer.targets else flags | pyrender.RenderFlags.DEPTH_ONLY)

    def close(self) -> None:
        """Release the OpenGL context; other renderers of the process keep theirs (pyrender's own clean-up would end
        them all)."""
        self._context.make_current()
        self._camera.delete()
        self._light.delete()
        eglDestroyContext(self._context._egl_display, self._context._egl_context)

    def __enter__(self) -> MeshRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _scene(vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, feature: np.ndarray) -> pyrender.Scene:
    """A pyrender scene of one mesh with exactly the vertex attributes that the shaders expect."""
    feature = feature.astype(np.float32)
    primitive = pyrender.Primitive(
        positions=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        texcoord_0=feature[:, 3:].repeat(2, axis=1),
        # Alpha below 1 would switch blending on.
        color_0=np.concatenate((feature[:, :3], np.ones((len(vertices), 1), np.float32)), 1),
        indices=triangles.astype(np.uint32),
    )
    scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
    scene.add(pyrender.Mesh([primitive]))
    return scene


def _look_along(direction: np.ndarray, distance: float) -> np.ndarray:
    """Pose of a camera at ``distance`` along the unit vector ``direction``, looking back at the origin."""
    x, y, z = direction.tolist()
    right = (z, 0.0, -x) if abs(y) < 0.99 else (-y, x, 0.0)  # up x direction, with y or else z as up
    a, b, c = (component / math.hypot(*right) for component in right)
    up = (y * c - z * b, z * a - x * c, x * b - y * a)
    columns = np.array(((a, b, c), up, (x, y, z), (distance * x, distance * y, distance * z)))
    return np.concatenate((columns.T, ((0.0, 0.0, 0.0, 1.0),)))
