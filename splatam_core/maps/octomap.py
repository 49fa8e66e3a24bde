"""Occupancy in three dimensions as a file of OctoMap, ``.bt``: an octree of occupied, free and unknown voxels.

The format is that of OctoMap's binary files (Hornung et al., "OctoMap", Autonomous Robots, 2013): a header, then two bytes for each
inner node, depth first, with two bits for each child.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.atomic_io import replaced
from splatam_core.errors import ExportError
from splatam_core.maps.grid import FREE, OCCUPIED, UNKNOWN, Volume

DEPTH = 16
"""Levels below the root."""

FREE_LEAF, OCCUPIED_LEAF, INNER = 1, 2, 3
"""Two bits of a child; 0 = unknown."""

Codes = NDArray[np.uint64]


def write_octomap(path: Path, volume: Volume) -> None:
    """Write voxels as an octree. An existing file is replaced only when the new one is complete.

    Args:
        path: the ``.bt`` file.
        volume: the voxels.

    Raises:
        ExportError: they reach farther than an octree does.
    """
    index = np.argwhere(volume.voxels != UNKNOWN)
    keys = index[:, [1, 0, 2]] + np.array(volume.low) + (1 << (DEPTH - 1))
    if keys.min() < 0 or keys.max() >= 1 << DEPTH:
        raise ExportError('the map is too large for an octree of OctoMap: choose a larger resolution')
    states = volume.voxels[tuple(index.T)]
    size, nodes = _nodes(_interleaved(keys.astype(np.uint64)), np.where(states == OCCUPIED, OCCUPIED_LEAF, FREE_LEAF))
    assert set(np.unique(states)) <= {OCCUPIED, FREE}
    matrix = '\n'.join('#   ' + ' '.join(f'{value:9.6f}' for value in row) for row in volume.T_grid_world)
    header = (
        '# Octomap OcTree binary file\n'
        '# Axes: x forward at the first view, z up, z = 0 on the floor.\n'
        f'# The world of map.ply in these axes, T_grid_world:\n{matrix}\n'
        f'id OcTree\nsize {size}\nres {volume.resolution_m}\ndata\n'
    )
    with replaced(path) as temporary, temporary.open('wb') as file:
        file.write(header.encode('ascii'))
        file.write(nodes.astype('<u2').tobytes())


def _interleaved(keys: Codes) -> Codes:
    """Return the path from the root to each voxel [N]: three bits a level, z y x, the root's children first."""
    codes = np.zeros(len(keys), np.uint64)
    for level in range(DEPTH):
        for axis in range(3):
            bit = (keys[:, axis] >> np.uint64(level)) & np.uint64(1)
            codes |= bit << np.uint64(3 * level + axis)
    return codes


def _nodes(codes: Codes, leaves: NDArray[np.int64]) -> tuple[int, NDArray[np.uint16]]:
    """Return the number of nodes of a tree, and the children of its inner nodes, depth first.

    Args:
        codes: [N] path to each leaf.
        leaves: [N] FREE_LEAF or OCCUPIED_LEAF.
    """
    order = np.argsort(codes)
    codes, kinds = codes[order], leaves[order].astype(np.uint16)
    size, paths, children = 1, [], []
    for level in reversed(range(DEPTH)):  # of the parents
        size += len(codes)
        parents, first = np.unique(codes >> np.uint64(3), return_index=True)
        children.append(np.bitwise_or.reduceat(kinds << (2 * (codes & np.uint64(7))).astype(np.uint16), first))
        paths.append(((parents << np.uint64(3 * (DEPTH - level))) << np.uint64(5)) | np.uint64(level))
        codes, kinds = parents, np.full(len(parents), INNER, np.uint16)
    return size, np.concatenate(children)[np.argsort(np.concatenate(paths))]
