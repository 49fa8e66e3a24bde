"""Maps for other programs: a coloured point cloud, a mesh of the fused renders, the original's ``params.npz``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.device import pose_tensor
from splatam_core.errors import ExportError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Rasterizer

TRUNCATION_VOXELS = 4.0
MIN_VIEWS = 3
"""So many renders must show a voxel before it is surface; fewer where there are fewer."""

BLOCK_SIDE, BLOCKS = 16, 10_000
"""Voxels along a block, and blocks to begin with; the grid grows."""


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
    """The centres of the Gaussians that are at least so opaque.

    Raises:
        ExportError: none is.
    """
    g = gaussians.detached()
    chosen = torch.sigmoid(g.logit_opacities) >= min_opacity
    if not chosen.any():
        raise ExportError(f'none of the {len(g)} Gaussians is at least {min_opacity:g} opaque')
    return Surface(g.means[chosen].numpy(force=True), g.rgb[chosen].numpy(force=True))


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
        gaussians: the map, on the rasterizer's device.
        rasterizer: draws it.
        camera: what it is seen through.
        poses: [N, 4, 4] T_world_cam.
        voxel_m: side of a voxel.
        max_depth_m: farther renders are left out.
        progress: wraps the loop over the poses.

    Raises:
        ExportError: Open3D is not installed, or there is no surface.
    """
    core = (open3d := _open3d()).core
    names, channels = ('tsdf', 'weight', 'color'), (1, 1, 3)
    volume = open3d.t.geometry.VoxelBlockGrid(
        names, [core.float32] * 3, channels, voxel_m, BLOCK_SIDE, BLOCKS, core.Device('CPU:0')
    )
    intrinsic, map_only = core.Tensor(camera.matrix), gaussians.detached()
    for index in progress(range(len(poses))):
        T_cam_world = se3.inverse(poses[index])
        with torch.no_grad():
            pose = pose_tensor(T_cam_world, map_only.means.device)
            view = rasterizer.render(map_only, camera, pose).images()
        depth, color = (
            open3d.t.geometry.Image(core.Tensor(image)) for image in (view.depth_m[..., None], view.rgb / np.float32(255))
        )
        place = intrinsic, core.Tensor(T_cam_world), 1.0, max_depth_m, TRUNCATION_VOXELS
        blocks = volume.compute_unique_block_coordinates(depth, *place)
        volume.integrate(blocks, depth, color, intrinsic, *place)
    mesh = volume.extract_triangle_mesh(weight_threshold=min(MIN_VIEWS, len(poses)) - 0.5)
    if mesh.is_empty() or len(mesh.triangle.indices) == 0:
        raise ExportError(f'no surface within {max_depth_m:g} m of the {len(poses)} poses: is the map empty?')
    return Surface(mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy(), mesh.triangle.indices.numpy())


def _open3d() -> Any:
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise ExportError(f"a mesh needs Open3D ({error}): pip install 'splatam_ros[mesh]'") from None
    except (ImportError, OSError) as error:  # its wheel expects some of the system's libraries
        raise ExportError(
            f'a mesh needs Open3D, which is installed but does not load: {error}; on Debian and Ubuntu: apt install '
            'libusb-1.0-0 libgl1 libgomp1'
        ) from None
    return open3d


def splatam_params(
    gaussians: Gaussians, camera: PinholeCamera, poses: NDArray[np.float64], keyframes: Sequence[int],
    true_poses: NDArray[np.float64],
) -> dict[str, NDArray[np.generic]]:  # fmt: skip
    """What the original's ``params.npz`` holds, for its viewers and scripts.

    Not known to a finished map is when each Gaussian was added: ``timestep`` is 0 throughout, as after the original
    resumes, so that its replay shows all of the map from the start. K counts from the pixels' centres, as here.

    Args:
        gaussians: the map.
        camera: of the frames.
        poses: [T, 4, 4] T_world_cam of the tracked frames.
        keyframes: indices among them.
        true_poses: [T, 4, 4] T_world_cam in any world; NaN where not known.

    Returns:
        float32 arrays by the original's names; poses are world to camera, T in the last axis.
    """
    g = gaussians.detached()
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(g), 1)) if g.rotations is None else g.rotations.numpy()
    T_cam_world = se3.inverse(poses)
    quaternions = np.array([se3.quaternion_from_rotation(T[:3, :3]) for T in T_cam_world]).reshape(-1, 4)
    arrays = {
        'means3D': g.means.numpy(), 'rgb_colors': g.rgb.numpy(), 'unnorm_rotations': rotations,
        'logit_opacities': g.logit_opacities.numpy()[:, None], 'log_scales': g.log_scales.numpy(),
        'cam_unnorm_rots': quaternions.T[None], 'cam_trans': T_cam_world[:, :3, 3].T[None], 'timestep': np.zeros(len(g)),
        'intrinsics': camera.matrix, 'w2c': np.eye(4), 'gt_w2c_all_frames': _relative_to_first(true_poses),
    }  # fmt: skip
    size = {'org_width': np.array(camera.width), 'org_height': np.array(camera.height)}
    indices = {'keyframe_time_indices': np.array(keyframes, np.int64)}
    return {name: np.asarray(values, np.float32) for name, values in arrays.items()} | size | indices


def _relative_to_first(true_poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """[T, 4, 4] world to camera, the world being the first camera; all NaN where the first is not known."""
    if len(true_poses) == 0:
        return true_poses
    return se3.inverse(true_poses) @ true_poses[0]
