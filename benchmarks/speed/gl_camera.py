"""A depth camera that renders with OpenGL on the CPU, for the comparison with our rasterizer.

It needs moderngl, and EGL and llvmpipe of Mesa: Debian's packages libegl1 and libgl1-mesa-dri.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcaprl.sims import DepthCamera

NEAR_M = 0.1
# A depth buffer contains 1 - NEAR_M / z.
_VERTEX = """
#version 330
uniform mat3 axes; uniform vec3 eye; uniform vec2 focal; uniform float near;
in vec3 corner;
void main() {
    vec3 at = axes * (corner - eye);
    gl_Position = vec4(focal * at.xy, at.z - 2.0 * near, at.z);
}
"""
_FRAGMENT = "#version 330\nvoid main() {}"


class GlCamera(DepthCamera):
    """Depth camera whose images are rendered with moderngl and downsampled by our code."""

    def __init__(self, mesh: NDArray[np.float64], view: Any, small: tuple[int, int]) -> None:
        """Create the GL context.

        Raises:
            ImportError: moderngl, EGL or a driver is missing.
        """
        super().__init__(mesh, view, small)
        # One thread renders, as in our camera.
        os.environ |= {"LIBGL_ALWAYS_SOFTWARE": "1", "LP_NUM_THREADS": "1"}
        import moderngl

        try:
            context: Any = moderngl.create_context(standalone=True, backend="egl")
        # moderngl raises no subclass of Exception.
        except Exception as error:
            raise ImportError(f"no OpenGL: {error}") from error
        size = (view.width_px, view.height_px)
        self._frame = context.framebuffer(depth_attachment=context.depth_texture(size))
        program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        program["near"].value = NEAR_M
        program["focal"].value = (2 * view.focal_px / size[0], 2 * view.focal_px / size[1])
        corners = context.buffer(mesh.reshape(-1, 3).astype("f4").tobytes())
        self._triangles = context.vertex_array(program, [(corners, "3f", "corner")])
        context.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        # The rows of our images run downward, so triangles have the opposite orientation in GL.
        context.front_face = "cw"
        self._program = program
        self._depth = np.empty((view.height_px, view.width_px), np.float32)

    def inverse_depth(
        self, position_m: tuple[float, float, float], axes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Render the image at full size, like the method of our camera."""
        self._program["eye"].value = position_m
        # GL stores matrices by columns.
        self._program["axes"].value = tuple(axes.T.ravel())
        self._frame.use()
        self._frame.clear(depth=1.0)
        self._triangles.render()
        self._frame.read_into(self._depth, attachment=-1, dtype="f4")
        return np.divide(1.0 - self._depth, NEAR_M, dtype=np.float64)
