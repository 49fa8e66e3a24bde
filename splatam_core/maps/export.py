"""Maps for other programs: a coloured point cloud, a mesh fused from rendered depth, the original's ``params.npz``."""

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
DEPTH_SCALE = 1.0
"""Depth units per metre."""

MIN_VIEWS = 3
"""Number of renders that must see a voxel before it counts as surface; all of them if there are fewer."""

BLOCK_SIDE, BLOCKS = 16, 10_000
"""Voxels along the side of a block, and the initial number of blocks; the grid grows as needed."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Coloured points or a mesh.

    Attributes:
        points_m: [N, 3].
        rgb: [N, 3] nominally in [0, 1], not clamped.
        triangles: [M, 3] indices of points; None for points only.
    """

    points_m: NDArray[np.floating]
    rgb: NDArray[np.floating]
    triangles: NDArray[np.integer] | None = None


def centres(gaussians: Gaussians, min_opacity: float) -> Surface:
    """Return the centres of the Gaussians with at least this opacity.

    Raises:
        ExportError: no Gaussian is opaque enough.
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
    *,
    voxel_m: float,
    max_depth_m: float,
    progress: Callable[[range], Iterable[int]],
) -> Surface:
    """Render the map along a path and fuse the depth images into a mesh.

    Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", 1996, as implemented by
    Open3D. The input is the expected depth where the silhouette is at least 0.5; the signed distance is truncated at
    four voxels.

    Args:
        gaussians: the map, on the rasterizer's device.
        rasterizer: renders the map.
        camera: the camera to render with.
        poses: [N, 4, 4] T_world_cam to render from.
        voxel_m: side length of a voxel.
        max_depth_m: rendered depth beyond this is ignored.
        progress: wraps the loop over the poses, to display progress.

    Raises:
        ExportError: Open3D is not installed, or no surface was found.
    """
    core = (open3d := _open3d()).core
    volume = open3d.t.geometry.VoxelBlockGrid(
        attr_names=('tsdf', 'weight', 'color'),
        attr_dtypes=[core.float32] * 3,
        attr_channels=(1, 1, 3),
        voxel_size=voxel_m,
        block_resolution=BLOCK_SIDE,
        block_count=BLOCKS,
        device=core.Device('CPU:0'),
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
        camera_and_limits = intrinsic, core.Tensor(T_cam_world), DEPTH_SCALE, max_depth_m, TRUNCATION_VOXELS
        blocks = volume.compute_unique_block_coordinates(depth, *camera_and_limits)
        volume.integrate(blocks, depth, color, intrinsic, *camera_and_limits)  # depth and colour have the same camera
    mesh = volume.extract_triangle_mesh(weight_threshold=min(MIN_VIEWS, len(poses)) - 0.5)
    if mesh.is_empty() or len(mesh.triangle.indices) == 0:
        raise ExportError(f'no surface within {max_depth_m:g} m of the {len(poses)} poses: is the map empty?')
    return Surface(mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy(), mesh.triangle.indices.numpy())


def _open3d() -> Any:
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise ExportError(f"a mesh needs Open3D ({error}): pip install 'splatam_ros[mesh]'") from None
    except (ImportError, OSError) as error:  # the wheel needs some system libraries
        raise ExportError(
            f'a mesh needs Open3D, which is installed but cannot be loaded: {error}; on Debian and Ubuntu: apt install '
            'libusb-1.0-0 libgl1 libgomp1'
        ) from None
    return open3d


def splatam_params(
    gaussians: Gaussians, camera: PinholeCamera, poses: NDArray[np.float64], keyframes: Sequence[int],
    ground_truth: NDArray[np.float64],
) -> dict[str, NDArray[np.generic]]:  # fmt: skip
    """Convert a map to the content of the original's ``params.npz``, for its viewers and scripts.

    A finished map does not record when each Gaussian was added. ``timestep`` is therefore 0 everywhere, as after
    the original resumes a run: its replay shows the whole map from the start. In ``intrinsics``, a pixel's centre is
    its integer index.

    Args:
        gaussians: the map.
        camera: the camera of the frames.
        poses: [T, 4, 4] T_world_cam of the tracked frames.
        keyframes: indices of the keyframes among the tracked frames.
        ground_truth: [T, 4, 4] true T_world_cam of the same frames, in any world; NaN where unknown.

    Returns:
        Arrays by the original's names, float32 but for size and indices. Poses are world to camera, with T in the last
        axis.
    """
    g = gaussians.detached()
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(g), 1)) if g.rotations is None else g.rotations.numpy()
    T_cam_world = se3.inverse(poses)
    quaternions = np.array([se3.quaternion_from_rotation(T[:3, :3]) for T in T_cam_world]).reshape(-1, 4)
    arrays = {
        'means3D': g.means.numpy(), 'rgb_colors': g.rgb.numpy(), 'unnorm_rotations': rotations,
        'logit_opacities': g.logit_opacities.numpy()[:, None], 'log_scales': g.log_scales.numpy(),
        'cam_unnorm_rots': quaternions.T[None], 'cam_trans': T_cam_world[:, :3, 3].T[None], 'timestep': np.zeros(len(g)),
        'intrinsics': camera.matrix, 'w2c': np.eye(4), 'gt_w2c_all_frames': _relative_to_first(ground_truth),
    }  # fmt: skip
    size = {'org_width': np.array(camera.width), 'org_height': np.array(camera.height)}
    indices = {'keyframe_time_indices': np.array(keyframes, np.int64)}
    return {name: np.asarray(values, np.float32) for name, values in arrays.items()} | size | indices


def _relative_to_first(T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [T, 4, 4] world to camera, with the first camera as world. All are NaN if the first pose is unknown."""
    if len(T_world_cam) == 0:
        return T_world_cam
    return se3.inverse(T_world_cam) @ T_world_cam[0]
