"""Images of a mirror camera, ray-traced by POV-Ray 3.7: a mirror under an ordinary camera.

A parabolic mirror under an orthographic camera (unified model, xi = 1), or a hyperbolic one under a perspective camera
(0 < xi < 1). Camera and mirror stay on the axes and the world is moved by the inverse pose: POV-Ray does not find
a paraboloid whose axis is not exactly an axis of its world. All light is ambient: no light sources, no shadows, linear
grey.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import NamedTemporaryFile

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, OmniCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import Rectangle, Scene

MIRROR_M = 0.01  # the conic's semi-latus rectum: radius of the mirror at the height of the viewpoint
INSTALL = "apt-get install povray"
OPTIONS = ("-D", "+FN8", "-A", "-GA", "File_Gamma=1.0", "+O-")  # no window, PNG on stdout
TIMEOUT_S = 300


class PovrayError(Exception):
    """POV-Ray is not installed or refused the scene."""


def available() -> bool:
    """True if POV-Ray is installed."""
    return shutil.which("povray") is not None


def write_world(folder: Path, scene: Scene, gloss: float = 0.0) -> None:
    """Write world.inc and its textures: every rectangle in world coordinates, then moved by the transform `View`.

    gloss: share of the light that rectangles of the name "floor" mirror.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, rectangle in enumerate(scene.rectangles):
        cv2.imwrite(str(folder / f"{number}.png"), rectangle.texture)
    parts = [_rectangle(n, r, gloss if r.name == "floor" else 0.0) for n, r in enumerate(scene.rectangles)]
    (folder / "world.inc").write_text("\n".join(parts) + "\n")


def _rectangle(number: int, r: Rectangle, gloss: float) -> str:
    """Return a unit square with its texture; POV-Ray counts the rows of an image from below."""
    axes = (r.edge_u, -r.edge_v, r.normal, r.origin + r.edge_v)
    matrix = ", ".join(f"{x:.12g}" for axis in axes for x in axis)
    return (
        f'polygon {{ 5, <0,0>, <1,0>, <1,1>, <0,1>, <0,0> pigment {{ image_map {{ png "{number}.png" gamma 1.0 '
        f"interpolate 2 }} }} finish {{ ambient {r.brightness * (1 - gloss):.6f} diffuse 0 reflection {gloss:.6f} }} "
        f"matrix <{matrix}> transform {{ View }} }}"
    )


def shoot(world: Path, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2) -> Floats:
    """Return the image (H, W) float32, 0 to 255, of a camera on a rig at T_world_rig in a written world.

    It is rendered supersample times larger and shrunk, which is faster than POV-Ray's own anti-aliasing; 0 beyond the
    mirror's rim.
    """
    width, height = mounted.camera.size
    size = (f"+W{width * supersample}", f"+H{height * supersample}")
    data = _run(view_text(mounted, T_world_rig), world, [*OPTIONS, *size])
    large = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if large is None:
        raise PovrayError(f"{world}: POV-Ray gave {len(data)} bytes that are not an image")
    seen = np.where(_inside_rim(mounted, supersample), large, 0).astype(np.float32)
    return np.asarray(cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _run(text: str, world: Path, options: list[str]) -> bytes:
    with NamedTemporaryFile("w", suffix=".pov") as file:  # POV-Ray cannot parse a pipe
        file.write(text)
        file.flush()
        try:
            done = subprocess.run(
                ["povray", *options, f"+I{file.name}"], cwd=world, capture_output=True, timeout=TIMEOUT_S
            )
        except FileNotFoundError:
            raise PovrayError(f"povray is not installed: {INSTALL}") from None
    if done.returncode:
        errors = done.stderr.decode(errors="replace").strip().splitlines()
        raise PovrayError(f"{world}: POV-Ray ended with {done.returncode}: {' '.join(errors[-3:])}")
    return done.stdout


def view_text(mounted: MountedCamera, T_world_rig: Array) -> str:
    """Return the scene description of one image: camera and mirror on the axes, the world around them."""
    camera = traceable(mounted.camera)
    T_cam_world = mounted.T_cam_rig @ se3.inverse(T_world_rig)
    columns = ", ".join(f"{x:.15g}" for x in np.concatenate([T_cam_world[:3, :3].T.ravel(), T_cam_world[:3, 3]]))
    return "\n".join(
        [
            "#version 3.7;",
            "global_settings { assumed_gamma 1.0 max_trace_level 3 }",
            _camera(camera),
            _mirror(camera, mounted.visible.outer_px),
            f"#declare View = transform {{ matrix <{columns}> }}",
            '#include "world.inc"',
            "",
        ]
    )


def traceable(camera: OmniCamera) -> UnifiedCamera:
    """Return the camera if a mirror realises its model; raise PovrayError otherwise."""
    if not isinstance(camera, UnifiedCamera) or any(camera.distortion) or not 0 < camera.xi <= 1:
        raise PovrayError(f"expected a unified camera with 0 < xi <= 1 and no distortion, found {camera}")
    return camera


def _eccentricity(xi: float) -> float:
    """Return the eccentricity of the mirror's conic from xi = 2 e / (1 + e^2): a parabola for 1, a hyperbola below."""
    return float((1 + np.sqrt(1 - xi**2)) / xi)


def _camera(camera: UnifiedCamera) -> str:
    """Return the camera, directed along -z; its axes u and v are x and y by the signs of the focal lengths."""
    width, height = camera.size
    scale = 1.0 if camera.xi == 1 else float(np.sqrt(1 - camera.xi**2))  # focal length behind the mirror, of fu and fv
    right, down = width * scale / camera.focal[0], height * scale / camera.focal[1]
    # Direction of the middle of the image in the same units: the optical centre may lie beside it.
    aside = scale * ((width - 1) / 2 - camera.center[0]) / camera.focal[0]
    below = scale * ((height - 1) / 2 - camera.center[1]) / camera.focal[1]
    if camera.xi == 1:
        right, down, aside, below = (MIRROR_M * x for x in (right, down, aside, below))
        return (
            f"camera {{ orthographic location <{aside:.15g}, {below:.15g}, {2 * MIRROR_M}> direction <0, 0, -1> "
            f"right <{right:.15g}, 0, 0> up <0, {-down:.15g}, 0> }}"
        )
    e = _eccentricity(camera.xi)
    focus = 2 * e * MIRROR_M / (e**2 - 1)  # the hyperbola's other focus
    return (
        f"camera {{ perspective location <0, 0, {focus:.15g}> direction <{aside:.15g}, "
        f"{below:.15g}, -1> right <{right:.15g}, 0, 0> up <0, {-down:.15g}, 0> }}"
    )


def _mirror(camera: UnifiedCamera, rim_px: float) -> str:
    """Return the conic with a focus in the origin, |p| = l - e z, to a little beyond its rim (that part is masked)."""
    e = _eccentricity(camera.xi)
    m = 1.05 * rim_px / min(abs(f) for f in camera.focal)
    z = _elevation(m, camera.xi)  # of the ray reflected at the rim
    rim = MIRROR_M / (1 + e * z) * float(np.sqrt(1 - z**2))
    top = MIRROR_M / (1 + e) * 1.01  # just beyond the vertex, before the second sheet of a hyperbola
    return (
        f"quadric {{ <1, 1, {1 - e**2:.15g}>, <0, 0, 0>, <0, 0, {2 * MIRROR_M * e:.15g}>, {-(MIRROR_M**2):.15g} "
        f"clipped_by {{ cylinder {{ <0, 0, {-100 * MIRROR_M}>, <0, 0, {top:.15g}>, {rim:.15g} }} }} "
        "pigment { rgb 0 } finish { ambient 0 diffuse 0 reflection { 1 } } }"
    )


def _elevation(m: float, xi: float) -> float:
    """Return z of the unit ray that the unified model projects to radius m."""
    gamma = (xi + np.sqrt(1 + (1 - xi**2) * m**2)) / (m**2 + 1)
    return float(gamma - xi)


def _inside_rim(mounted: MountedCamera, supersample: int) -> NDArray[np.bool_]:
    """Return which samples (H, W) of the enlarged image lie on the mirror."""
    width, height = mounted.camera.size
    u = (np.arange(width * supersample) + 0.5) / supersample - 0.5
    v = (np.arange(height * supersample) + 0.5) / supersample - 0.5
    pixels = np.column_stack([np.tile(u, len(v)), np.repeat(v, len(u))])
    return mounted.visible.contains(pixels).reshape(len(v), len(u))
