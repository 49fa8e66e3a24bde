"""Maps for other programs: a coloured point cloud, and a mesh of the fused renders."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.camera import PinholeCamera
from splatam_core.errors import ExportError
from splatam_core.rasterizer import Gaussians, Rasterizer

TRUNCATION_VOXELS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points, or a mesh.

    Attributes:
        points_m: [N, 3].
        rgb: [N, 3] nominally in [0, 1].
        triangles: [M, 3] indices of points; None = points only.
    """

    points_m: NDArray[np.floating]
    rgb: NDArray[np.floating]
    triangles: NDArray[np.integer] | None = None


def centres(gaussians: Gaussians, min_opacity: float) -> Surface:
    """The centres of the Gaussians that are at least so opaque."""
    g = gaussians.detached()
    chosen = torch.sigmoid(g.logit_opacities) >= min_opacity
    return Surface(g.means[chosen].numpy(), g.rgb[chosen].numpy())


def fused_mesh(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    camera: PinholeCamera,
    poses: NDArray[np.float64],
    voxel_m: float,
    max_depth_m: float,
    progress: Callable[[range], Iterable[int]],
) -> Surface:
    """The surface that the map shows from a path.

    Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996, by Open3D: expected
    depth where the silhouette is at least one half, truncated at four voxels.

    Args:
        gaussians: the map.
        rasterizer: draws it.
        camera: what it is seen through.
        poses: [N, 4, 4] T_world_cam.
        voxel_m: side of a voxel.
        max_depth_m: farther renders are left out.
        progress: wraps the loop over the poses.

    Raises:
        ExportError: Open3D is not installed, or there is no surface.
    """
    open3d = _open3d()
    integration = open3d.pipelines.integration
    volume = integration.ScalableTSDFVolume(
        voxel_m, TRUNCATION_VOXELS * voxel_m, integration.TSDFVolumeColorType.RGB8
    )
    intrinsic = open3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    map_only = gaussians.detached()
    for index in progress(range(len(poses))):
        T_cam_world = se3.inverse(poses[index])
        with torch.no_grad():
            view = rasterizer.render(map_only, camera, torch.from_numpy(T_cam_world).float()).images()
        image = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(view.rgb), open3d.geometry.Image(view.depth_m), depth_scale=1.0,
            depth_trunc=max_depth_m, convert_rgb_to_intensity=False,
        )  # fmt: skip
        volume.integrate(image, intrinsic, T_cam_world)
    mesh = volume.extract_triangle_mesh()
    if len(mesh.triangles) == 0:
        raise ExportError(f'no surface within {max_depth_m:g} m of the {len(poses)} poses: is the map empty?')
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.vertex_colors), np.asarray(mesh.triangles))


def _open3d() -> Any:
    try:
        import open3d
    except ImportError as error:
        raise ExportError(f"a mesh needs Open3D ({error}): pip install 'splatam_ros[mesh]'") from None
    return open3d
