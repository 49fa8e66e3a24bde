"""Converts coloured points to and from ``sensor_msgs/PointCloud2``.

The fields are ``x y z rgb``, all FLOAT32; rgb holds the bits 0x00RRGGBB, as RViz expects.
More FLOAT32 fields may follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory

_FLOAT32 = 7
_UINT32 = 6
_FIELDS = ('x', 'y', 'z', 'rgb')


def cloud_message(
    factory: MessageFactory, points: NDArray[np.float32], rgb: NDArray[np.uint8], stamp_ns: int, frame_id: str,
    extra: Mapping[str, NDArray[np.float32]] | None = None,
) -> Any:  # fmt: skip
    """Make an unorganised ``sensor_msgs/PointCloud2``.

    Args:
        factory: makes the message.
        points: [N, 3] float32 metres.
        rgb: [N, 3] uint8.
        stamp_ns: stamp of the header.
        frame_id: frame the points are in.
        extra: further fields by name, [N] float32 each.

    Raises:
        MessageError: the arrays have other shapes or types.
    """
    extra = extra or {}
    if points.shape != (len(points), 3) or rgb.shape != points.shape or rgb.dtype != np.uint8:
        raise MessageError(
            f'points have shape {points.shape}, rgb has shape {rgb.shape} and type {rgb.dtype}; '
            'expected [N, 3] metres and [N, 3] uint8'
        )
    wrong = [f'{name} has shape {values.shape}' for name, values in extra.items() if values.shape != points.shape[:1]]
    if wrong:
        raise MessageError(f'{", ".join(wrong)}; expected one value for each of the {len(points)} points')
    data = _packed(points, rgb, list(extra.values()))
    return factory.make(
        'sensor_msgs/msg/PointCloud2',
        header=stamps.header(factory, stamp_ns, frame_id),
        height=1,
        width=len(points),
        fields=[
            factory.make('sensor_msgs/msg/PointField', name=name, offset=4 * i, datatype=_FLOAT32, count=1)
            for i, name in enumerate((*_FIELDS, *extra))
        ],
        is_bigendian=False,
        point_step=data.shape[1],
        row_step=data.size,
        data=data.reshape(-1),
        is_dense=bool(np.isfinite(points).all()),
    )


def _packed(points: NDArray[np.float32], rgb: NDArray[np.uint8], extra: Sequence[NDArray[np.float32]]) -> NDArray[np.uint8]:
    data = np.zeros((len(points), 4 * (len(_FIELDS) + len(extra))), np.uint8)
    data[:, :12].view('<f4')[:] = points
    data[:, 12:15] = rgb[:, ::-1]
    for i, values in enumerate(extra):
        data[:, 16 + 4 * i : 20 + 4 * i].view('<f4')[:, 0] = values
    return data


def read_cloud(message: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Returns points [N, 3] float32 and colours [N, 3] uint8 of a ``sensor_msgs/PointCloud2``, organised or not.

    Raises:
        MessageError: a field is missing or has another type, or the data are truncated.
    """
    offsets = _checked_fields(message)
    height, width, row_step = int(message.height), int(message.width), int(message.row_step)
    point_step = int(message.point_step)
    row_bytes = width * point_step
    data = np.frombuffer(message.data, np.uint8)
    if row_step < row_bytes or data.size != height * row_step:
        raise MessageError(
            f'point cloud of {height} rows of {width} points, {point_step} bytes each, has row_step {row_step} '
            f'and {data.size} bytes; it is truncated or states a wrong size'
        )
    if not width * height:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    dtype = _point_type(message, offsets)
    rows = np.ascontiguousarray(data.reshape(height, row_step)[:, :row_bytes])
    records = rows.reshape(-1).view(dtype)
    points = np.stack([records[axis] for axis in 'xyz'], axis=-1).astype(np.float32)
    bits = records['rgb'].astype(np.uint32)
    return points, np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(np.uint8)


def _checked_fields(message: Any) -> list[int]:
    """Returns the offsets of x, y, z and rgb within a point."""
    fields = {field.name: field for field in message.fields}
    offsets = []
    for name in _FIELDS:
        allowed = (_FLOAT32, _UINT32) if name == 'rgb' else (_FLOAT32,)
        field = fields.get(name)
        if field is None or field.datatype not in allowed or field.offset + 4 > message.point_step:
            raise MessageError(
                f'point cloud has fields {list(fields)}; expected {", ".join(_FIELDS)} as FLOAT32 '
                f'(rgb also as UINT32) within the {message.point_step} bytes of a point'
            )
        offsets.append(int(field.offset))
    return offsets


def _point_type(message: Any, offsets: list[int]) -> np.dtype[Any]:
    """Returns the structured dtype of a point, with rgb as an integer of the same bits."""
    order = '>' if message.is_bigendian else '<'
    formats = [f'{order}f4'] * 3 + [f'{order}u4']
    return np.dtype({'names': _FIELDS, 'formats': formats, 'offsets': offsets, 'itemsize': message.point_step})
