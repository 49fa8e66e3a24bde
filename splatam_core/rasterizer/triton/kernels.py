"""The kernels of the ``triton`` rasterizer: project, list, blend, and their backward passes.

One program blends one tile, a chunk of Gaussians at a time. Within a chunk the transmittance in front of each Gaussian is a
running product. Gradients of entries are stored where the entries were before they were sorted by tile: there the entries of
one Gaussian are adjacent, and are summed without atomics.

An isotropic footprint is separable, but that does not help here: with two pixels of an 8x8 tile per thread, which share a column,
it would take three exponentials instead of two.

The code runs in Triton's compiler and in its interpreter: blocks are powers of two, every load and store is masked or known to be
inside, loops are ``while`` over scalars.
"""

from __future__ import annotations

from typing import Any

import triton
import triton.language as tl

from splatam_core.rasterizer import base

NEAR_M = tl.constexpr(base.NEAR_M)
FAR_M = tl.constexpr(base.HUGE)  # not drawn beyond, nor where not finite
MAX_GRADIENT = tl.constexpr(1e15)
BLUR_PX2 = tl.constexpr(base.BLUR_PX2)
MAX_ALPHA = tl.constexpr(base.MAX_ALPHA)
MIN_ALPHA = tl.constexpr(base.MIN_ALPHA)
MIN_TRANSMITTANCE = tl.constexpr(base.MIN_TRANSMITTANCE)
COLOR_LIMIT, DEPTH_LIMIT_M = tl.constexpr(base.COLOR_LIMIT), tl.constexpr(base.DEPTH_LIMIT_M)
BETA_1, BETA_2, EPSILON = tl.constexpr(base.BETA_1), tl.constexpr(base.FIT_BETA_2), tl.constexpr(base.EPSILON)
FIELDS = tl.constexpr(8)  # of a splat (u, v, falloff, opacity, r, g, b, z) and of its gradient, as in csrc/kernels.hpp


def launch(kernel: Any, programs: int, *, warps: int, **arguments: object) -> None:
    """Starts a kernel, unless there are no programs. A program has ``warps`` of 32 threads (AMD: 64)."""
    if programs:
        # Fused multiply-adds are on by default up to Triton 3.9; this keeps them on.
        kernel[(programs,)](**arguments, num_warps=warps, enable_fp_fusion=True)


@triton.jit(do_not_specialize=['n'])
def project(
    means, log_scales, logit_opacities, rgb, pose, splats, depths, rects, counts,
    n, width, height, fx, fy, cx, cy, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Projects Gaussians: splats [N, 8], depths [N] (inf = not drawn), rects [N, 2] (see ``_touched_tiles``), tile counts [N]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = i < n
    cam_x, cam_y, cam_z = _into_camera(means, pose, i, real)
    near = real & (cam_z > NEAR_M) & (cam_z < FAR_M)
    z = tl.where(near, cam_z, 1.0)
    u = fx * cam_x / z + cx
    v = fy * cam_y / z + cy
    log_scale = tl.load(log_scales + i, mask=near, other=0.0)
    sigma = 0.5 * (fx + fy) * tl.exp(tl.minimum(log_scale, 40.0)) / z
    variance = sigma * sigma + BLUR_PX2
    logit = tl.load(logit_opacities + i, mask=near, other=0.0)
    opacity = 1.0 / (1.0 + tl.exp(tl.minimum(-logit, 80.0)))
    extent = tl.sqrt(2.0 * variance * (tl.log(tl.maximum(opacity / MIN_ALPHA, 1.0)) + 1e-5))
    drawn = near & (opacity >= MIN_ALPHA) & _is_usable(log_scale) & _is_usable(logit)
    for channel in tl.static_range(3):
        drawn = drawn & _is_usable(tl.load(rgb + 3 * i + channel, mask=near, other=0.0))
    drawn = drawn & (u + extent >= 0.0) & (u - extent <= width - 1.0) & (v + extent >= 0.0) & (v - extent <= height - 1.0)
    first, shape, count = _touched_tiles(
        tl.where(drawn, u, 0.0), tl.where(drawn, v, 0.0), tl.where(drawn, extent, 0.0), width, height, TILE
    )
    tl.store(rects + 2 * i, tl.where(drawn, first, 0), mask=real)
    tl.store(rects + 2 * i + 1, tl.where(drawn, shape, 0), mask=real)
    tl.store(counts + i, tl.where(drawn, count, 0), mask=real)
    tl.store(depths + i, tl.where(drawn, z, float('inf')), mask=real)
    _store_splat(splats + FIELDS * i, u, v, -0.5 / variance, opacity, z, rgb + 3 * i, real, drawn)


@triton.jit
def _is_usable(values):
    """Returns False for what is not finite, too."""
    return tl.abs(values) < FAR_M


@triton.jit
def _into_camera(means, pose, i, real):
    """Returns the camera coordinates of the centres."""
    x = tl.load(means + 3 * i, mask=real, other=0.0)
    y = tl.load(means + 3 * i + 1, mask=real, other=0.0)
    z = tl.load(means + 3 * i + 2, mask=real, other=0.0)
    cam_x = tl.load(pose) * x + tl.load(pose + 1) * y + tl.load(pose + 2) * z + tl.load(pose + 3)
    cam_y = tl.load(pose + 4) * x + tl.load(pose + 5) * y + tl.load(pose + 6) * z + tl.load(pose + 7)
    cam_z = tl.load(pose + 8) * x + tl.load(pose + 9) * y + tl.load(pose + 10) * z + tl.load(pose + 11)
    return cam_x, cam_y, cam_z


@triton.jit
def _store_splat(record, u, v, falloff, opacity, z, rgb, real, drawn):
    """Stores a splat's eight numbers. One that is not drawn is invisible and finite, so that blending it changes nothing."""
    tl.store(record, tl.where(drawn, u, 0.0), mask=real)
    tl.store(record + 1, tl.where(drawn, v, 0.0), mask=real)
    tl.store(record + 2, tl.where(drawn, falloff, -1.0), mask=real)
    tl.store(record + 3, tl.where(drawn, opacity, 0.0), mask=real)
    tl.store(record + 4, tl.load(rgb, mask=drawn, other=0.0), mask=real)
    tl.store(record + 5, tl.load(rgb + 1, mask=drawn, other=0.0), mask=real)
    tl.store(record + 6, tl.load(rgb + 2, mask=drawn, other=0.0), mask=real)
    tl.store(record + 7, tl.where(drawn, z, 1.0), mask=real)


@triton.jit
def _touched_tiles(u, v, extent, width, height, TILE: tl.constexpr):
    """Returns the tiles a disc touches, packed, and their number: a rectangle without the corners that the disc misses."""
    x0 = tl.minimum(tl.maximum(u - extent, 0.0), width - 1.0).to(tl.int32) // TILE
    x1 = tl.minimum(tl.maximum(u + extent, 0.0), width - 1.0).to(tl.int32) // TILE
    y0 = tl.minimum(tl.maximum(v - extent, 0.0), height - 1.0).to(tl.int32) // TILE
    y1 = tl.minimum(tl.maximum(v + extent, 0.0), height - 1.0).to(tl.int32) // TILE
    # From the centre to the nearest pixel of the outer columns and rows.
    left = tl.maximum(u - (x0 * TILE + TILE - 1), 0.0)
    right = tl.maximum(x1 * TILE - u, 0.0)
    above = tl.maximum(v - (y0 * TILE + TILE - 1), 0.0)
    below = tl.maximum(y1 * TILE - v, 0.0)
    limit = extent * extent
    cornered = (x1 > x0) & (y1 > y0)
    top_left = (cornered & (left * left + above * above > limit)).to(tl.int32)
    top_right = (cornered & (right * right + above * above > limit)).to(tl.int32)
    bottom_left = (cornered & (left * left + below * below > limit)).to(tl.int32)
    bottom_right = (cornered & (right * right + below * below > limit)).to(tl.int32)
    missed = top_left + 2 * top_right + 4 * bottom_left + 8 * bottom_right
    columns, rows = x1 - x0 + 1, y1 - y0 + 1
    count = columns * rows - top_left - top_right - bottom_left - bottom_right
    return x0 + (y0 << 12) + (missed << 24), columns + (rows << 12), count


@triton.jit(do_not_specialize=['n', 'capacity'])
def list_tiles(order, ends, counts, rects, starts, tiles, ids, n, capacity, tiles_x, BLOCK: tl.constexpr):
    """Writes the entries of each Gaussian, nearest first: tiles and ids [capacity]. Entries beyond the capacity are dropped.

    ``ends`` [N] is the index behind a Gaussian's last entry, by depth; ``starts`` [N] gets that of its first one, by id.
    """
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = place < n
    i = tl.load(order + place, mask=real, other=0)
    slot = tl.load(ends + place, mask=real, other=0) - tl.load(counts + i, mask=real, other=0)
    tl.store(starts + i, slot, mask=real)
    first = tl.load(rects + 2 * i, mask=real, other=0)
    shape = tl.load(rects + 2 * i + 1, mask=real, other=0)
    x0, y0, missed = first & 4095, (first >> 12) & 4095, first >> 24
    columns, rows = shape & 4095, shape >> 12
    cells = columns * rows
    most = tl.max(cells, axis=0)
    cell = 0
    while cell < most:
        y = cell // tl.maximum(columns, 1)
        x = cell - y * columns
        corner = tl.where(x == 0, 1, 0) + tl.where(x == columns - 1, 2, 0)
        corners = tl.where(y == 0, corner, 0) + tl.where(y == rows - 1, 4 * corner, 0)
        touched = (cell < cells) & ((corners & missed) == 0)
        kept = touched & (slot < capacity)
        tl.store(tiles + slot, ((y0 + y) * tiles_x + x0 + x).to(tiles.dtype.element_ty), mask=kept)
        tl.store(ids + slot, i.to(tl.int32), mask=kept)
        slot += touched.to(tl.int64)
        cell += 1


@triton.jit
def _span(begins, total, tile, n, capacity):
    """Returns begin and end of a tile's list, and whether the lists fit; if not, the list is the whole depth order."""
    fits = tl.load(total) <= capacity
    begin, end = tl.load(begins + tile), tl.load(begins + tile + 1)
    return tl.where(fits, begin, 0), tl.where(fits, end, n), fits


@triton.jit
def _listed_ids(order, entries, at, end, fits, CHUNK: tl.constexpr):
    """Returns [CHUNK] ids of a list from a position on, and a mask of those within the list."""
    place = at + tl.arange(0, CHUNK)
    listed = place < end
    from_lists = tl.load(entries + place, mask=place < tl.where(fits, end, 0), other=0)
    from_order = tl.load(order + place, mask=place < tl.where(fits, 0, end), other=0).to(tl.int32)
    return from_lists + from_order, listed


@triton.jit
def _offsets(splat, listed, x, y):
    """Returns [CHUNK, P] offsets from the centres to the pixels, and the alphas before they are clamped."""
    dx = x[None, :] - tl.load(splat, mask=listed, other=0.0)[:, None]
    dy = y[None, :] - tl.load(splat + 1, mask=listed, other=0.0)[:, None]
    falloff = tl.load(splat + 2, mask=listed, other=0.0)[:, None]
    raw = tl.load(splat + 3, mask=listed, other=0.0)[:, None] * tl.exp((dx * dx + dy * dy) * falloff)
    return dx, dy, raw


@triton.jit
def _weights(raw, T):
    """Returns [CHUNK, P] alphas, 1 - alphas, transmittance in front of each, weights; [P] transmittance behind all."""
    alpha = tl.where(raw < MIN_ALPHA, 0.0, tl.minimum(raw, MAX_ALPHA))
    left = 1.0 - alpha
    passed = tl.cumprod(left, axis=0)
    before = T[None, :] * passed / left
    weight = tl.where(before >= MIN_TRANSMITTANCE, alpha * before, 0.0)
    return alpha, left, before, weight, T * tl.min(passed, axis=0)


@triton.jit
def _pixels(tiles_x, width, height, TILE: tl.constexpr):
    """Returns [P] columns and rows of this program's pixels, and a mask of those inside the image."""
    tile = tl.program_id(0)
    pixel = tl.arange(0, TILE * TILE)
    x = tile % tiles_x * TILE + pixel % TILE
    y = tile // tiles_x * TILE + pixel // TILE
    return x, y, (x < width) & (y < height)


@triton.jit
def _blend(splats, order, entries, begin, end, n, fits, x, y, on_image, CHUNK: tl.constexpr):
    """Returns [P] colour, depth and silhouette."""
    T = tl.where(on_image, 1.0, 0.0)
    r, g, b = tl.zeros_like(T), tl.zeros_like(T), tl.zeros_like(T)
    depth, silhouette = tl.zeros_like(T), tl.zeros_like(T)
    at, live = begin, tl.max(T, axis=0)
    while (at < end) & (live >= MIN_TRANSMITTANCE):
        ids, listed = _listed_ids(order, entries, at, end, fits, CHUNK)
        splat = splats + FIELDS * ids
        dx, dy, raw = _offsets(splat, listed, x, y)
        alpha, left, before, weight, T = _weights(raw, T)
        r += tl.sum(weight * tl.load(splat + 4, mask=listed, other=0.0)[:, None], axis=0)
        g += tl.sum(weight * tl.load(splat + 5, mask=listed, other=0.0)[:, None], axis=0)
        b += tl.sum(weight * tl.load(splat + 6, mask=listed, other=0.0)[:, None], axis=0)
        depth += tl.sum(weight * tl.load(splat + 7, mask=listed, other=0.0)[:, None], axis=0)
        silhouette += tl.sum(weight, axis=0)
        live = tl.max(T, axis=0)
        at += CHUNK
    return r, g, b, depth, silhouette


@triton.jit(do_not_specialize=['n', 'capacity'])
def blend(
    splats, order, entries, begins, total, rgb, depth_acc, silhouette,
    n, capacity, width, height, tiles_x, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Draws a tile of the images: rgb [3, H, W], depth_acc and silhouette [H, W]."""
    column, row, on_image = _pixels(tiles_x, width, height, TILE)
    x, y = column.to(tl.float32), row.to(tl.float32)
    begin, end, fits = _span(begins, total, tl.program_id(0), n, capacity)
    r, g, b, d, s = _blend(splats, order, entries, begin, end, n, fits, x, y, on_image, CHUNK)
    at, plane = row * width + column, width * height
    tl.store(rgb + at, r, mask=on_image)
    tl.store(rgb + plane + at, g, mask=on_image)
    tl.store(rgb + 2 * plane + at, b, mask=on_image)
    tl.store(depth_acc + at, d, mask=on_image)
    tl.store(silhouette + at, s, mask=on_image)


@triton.jit
def _chunk_gradients(splat, listed, x, y, T, Q, gr, gg, gb, gd, gs):
    """Computes the gradients by a chunk's splats, summed over the pixels.

    With q_k = sum over channels of (gradient of the channel times value of splat k), and Q the part of sum_k w_k q_k that is still
    to come, dL/dalpha_k = T_k q_k - Q / (1 - alpha_k).

    Returns:
        [CHUNK] sums of the gradient by log alpha times 1, dx, dy, d^2, and of the gradient by z; [CHUNK, P] weights; [P] T and Q
        behind the chunk.
    """
    dx, dy, raw = _offsets(splat, listed, x, y)
    alpha, left, before, weight, T = _weights(raw, T)
    q = gr[None, :] * tl.load(splat + 4, mask=listed, other=0.0)[:, None]
    q += gg[None, :] * tl.load(splat + 5, mask=listed, other=0.0)[:, None]
    q += gb[None, :] * tl.load(splat + 6, mask=listed, other=0.0)[:, None]
    q += gd[None, :] * tl.load(splat + 7, mask=listed, other=0.0)[:, None] + gs[None, :]
    added = tl.cumsum(weight * q, axis=0)
    behind = Q[None, :] - added
    by_log_alpha = tl.where((weight > 0.0) & (raw <= MAX_ALPHA), alpha * (before * q - behind / left), 0.0)
    by_x, by_y = by_log_alpha * dx, by_log_alpha * dy
    return (
        tl.sum(by_log_alpha, axis=1), tl.sum(by_x, axis=1), tl.sum(by_y, axis=1), tl.sum(by_x * dx + by_y * dy, axis=1),
        tl.sum(weight * gd[None, :], axis=1), weight, T, Q - tl.sum(weight * q, axis=0),
    )  # fmt: skip


@triton.jit
def _to_entries(
    splats, order, entries, slots, gradients, begin, end, fits, x, y, on_image, Q, gr, gg, gb, gd, gs, CHUNK: tl.constexpr
):  # fmt: skip
    """Visits a list front to back and writes gradients [rows, 8]: by entry, or by Gaussian with atomics if the lists do not fit."""
    T = tl.where(on_image, 1.0, 0.0)
    at, live = begin, tl.max(T, axis=0)
    while (at < end) & (live >= MIN_TRANSMITTANCE):
        ids, listed = _listed_ids(order, entries, at, end, fits, CHUNK)
        s0, sx, sy, s2, sz, weight, T, Q = _chunk_gradients(splats + FIELDS * ids, listed, x, y, T, Q, gr, gg, gb, gd, gs)
        sr, sg, sb = (
            tl.sum(weight * gr[None, :], axis=1), tl.sum(weight * gg[None, :], axis=1), tl.sum(weight * gb[None, :], axis=1),
        )  # fmt: skip
        if fits:
            into = gradients + FIELDS * tl.load(slots + at + tl.arange(0, CHUNK), mask=listed, other=0)
            _store_entry(into, listed, s0, sx, sy, s2, sr, sg, sb, sz)
        else:
            _add_entry(gradients + FIELDS * ids.to(tl.int64), listed, s0, sx, sy, s2, sr, sg, sb, sz)
        live = tl.max(T, axis=0)
        at += CHUNK
    if fits:
        nothing = tl.zeros([CHUNK], tl.float32)
        while at < end:  # entries behind an opaque one
            place = at + tl.arange(0, CHUNK)
            into = gradients + FIELDS * tl.load(slots + place, mask=place < end, other=0)
            _store_entry(into, place < end, nothing, nothing, nothing, nothing, nothing, nothing, nothing, nothing)
            at += CHUNK


@triton.jit
def _store_entry(into, real, s0, sx, sy, s2, sr, sg, sb, sz):
    tl.store(into, s0, mask=real)
    tl.store(into + 1, sx, mask=real)
    tl.store(into + 2, sy, mask=real)
    tl.store(into + 3, s2, mask=real)
    tl.store(into + 4, sr, mask=real)
    tl.store(into + 5, sg, mask=real)
    tl.store(into + 6, sb, mask=real)
    tl.store(into + 7, sz, mask=real)


@triton.jit
def _add_entry(into, real, s0, sx, sy, s2, sr, sg, sb, sz):
    tl.atomic_add(into, s0, mask=real)
    tl.atomic_add(into + 1, sx, mask=real)
    tl.atomic_add(into + 2, sy, mask=real)
    tl.atomic_add(into + 3, s2, mask=real)
    tl.atomic_add(into + 4, sr, mask=real)
    tl.atomic_add(into + 5, sg, mask=real)
    tl.atomic_add(into + 6, sb, mask=real)
    tl.atomic_add(into + 7, sz, mask=real)


@triton.jit
def _through_projection(u, v, falloff, z, sx, sy, s2, sz, fx, fy, cx, cy):
    """Returns the gradients by the centre in camera coordinates and by the log scale, from sums over pixels."""
    inverse_variance = -2.0 * falloff
    spread = 2.0 * (1.0 / inverse_variance - BLUR_PX2)  # d variance / d log scale
    by_scale = 0.5 * s2 * inverse_variance * inverse_variance * spread
    by_x = sx * inverse_variance * fx / z  # dx is pixel minus centre
    by_y = sy * inverse_variance * fy / z
    by_z = sz - by_x * (u - cx) / fx - by_y * (v - cy) / fy - by_scale / z
    return by_x, by_y, by_z, by_scale


@triton.jit
def _load_images(rgb, depth_acc, silhouette, at, plane, on_image):
    """Returns [P] values of the five planes of the images, or of the gradients by them."""
    return (
        tl.load(rgb + at, mask=on_image, other=0.0), tl.load(rgb + plane + at, mask=on_image, other=0.0),
        tl.load(rgb + 2 * plane + at, mask=on_image, other=0.0), tl.load(depth_acc + at, mask=on_image, other=0.0),
        tl.load(silhouette + at, mask=on_image, other=0.0),
    )  # fmt: skip


@triton.jit(do_not_specialize=['n', 'capacity'])
def blend_backward(
    splats, order, entries, slots, begins, total, rgb, depth_acc, silhouette, by_rgb, by_depth_acc, by_silhouette, gradients,
    n, capacity, width, height, tiles_x, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Turns gradients by a tile's pixels into gradients of the entries of its list."""
    column, row, on_image = _pixels(tiles_x, width, height, TILE)
    at, plane = row * width + column, width * height
    r, g, b, d, s = _load_images(rgb, depth_acc, silhouette, at, plane, on_image)
    gr, gg, gb, gd, gs = _load_images(by_rgb, by_depth_acc, by_silhouette, at, plane, on_image)
    begin, end, fits = _span(begins, total, tl.program_id(0), n, capacity)
    _to_entries(
        splats, order, entries, slots, gradients, begin, end, fits, column.to(tl.float32), row.to(tl.float32), on_image,
        gr * r + gg * g + gb * b + gd * d + gs * s, gr, gg, gb, gd, gs, CHUNK,
    )  # fmt: skip


@triton.jit(do_not_specialize=['n', 'capacity'])
def blend_backward_to_pose(
    splats, order, entries, begins, total, rgb, depth_acc, silhouette, by_rgb, by_depth_acc, by_silhouette, pose_sums,
    n, capacity, width, height, tiles_x, fx, fy, cx, cy, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Turns gradients by a tile's pixels into pose_sums [tiles, 12] (see ``_store_pose_sums``), without gradients of Gaussians."""
    column, row, on_image = _pixels(tiles_x, width, height, TILE)
    at_pixel, plane = row * width + column, width * height
    r, g, b, d, s = _load_images(rgb, depth_acc, silhouette, at_pixel, plane, on_image)
    gr, gg, gb, gd, gs = _load_images(by_rgb, by_depth_acc, by_silhouette, at_pixel, plane, on_image)
    x, y = column.to(tl.float32), row.to(tl.float32)
    T, Q = tl.where(on_image, 1.0, 0.0), gr * r + gg * g + gb * b + gd * d + gs * s
    tile = tl.program_id(0)
    at, end, fits = _span(begins, total, tile, n, capacity)
    live = tl.max(T, axis=0)
    xx, xy, xz, x1 = 0.0, 0.0, 0.0, 0.0
    yx, yy, yz, y1 = 0.0, 0.0, 0.0, 0.0
    zx, zy, zz, z1 = 0.0, 0.0, 0.0, 0.0
    while (at < end) & (live >= MIN_TRANSMITTANCE):
        ids, listed = _listed_ids(order, entries, at, end, fits, CHUNK)
        splat = splats + FIELDS * ids
        s0, sx, sy, s2, sz, weight, T, Q = _chunk_gradients(splat, listed, x, y, T, Q, gr, gg, gb, gd, gs)
        u, v = tl.load(splat, mask=listed, other=0.0), tl.load(splat + 1, mask=listed, other=0.0)
        falloff, z = tl.load(splat + 2, mask=listed, other=-1.0), tl.load(splat + 7, mask=listed, other=1.0)
        dx, dy, dz, by_scale = _through_projection(u, v, falloff, z, sx, sy, s2, sz, fx, fy, cx, cy)
        cam_x, cam_y = (u - cx) / fx * z, (v - cy) / fy * z
        xx += tl.sum(dx * cam_x, axis=0)
        xy += tl.sum(dx * cam_y, axis=0)
        xz += tl.sum(dx * z, axis=0)
        x1 += tl.sum(dx, axis=0)
        yx += tl.sum(dy * cam_x, axis=0)
        yy += tl.sum(dy * cam_y, axis=0)
        yz += tl.sum(dy * z, axis=0)
        y1 += tl.sum(dy, axis=0)
        zx += tl.sum(dz * cam_x, axis=0)
        zy += tl.sum(dz * cam_y, axis=0)
        zz += tl.sum(dz * z, axis=0)
        z1 += tl.sum(dz, axis=0)
        live = tl.max(T, axis=0)
        at += CHUNK
    _store_pose_sums(pose_sums + 12 * tile, xx, xy, xz, x1, yx, yy, yz, y1, zx, zy, zz, z1)


@triton.jit
def _store_pose_sums(into, xx, xy, xz, x1, yx, yy, yz, y1, zx, zy, zz, z1):
    """Stores [3, 4]: sums of the gradient by a centre's camera coordinates (rows) times these coordinates and one (columns)."""
    tl.store(into, xx)
    tl.store(into + 1, xy)
    tl.store(into + 2, xz)
    tl.store(into + 3, x1)
    tl.store(into + 4, yx)
    tl.store(into + 5, yy)
    tl.store(into + 6, yz)
    tl.store(into + 7, y1)
    tl.store(into + 8, zx)
    tl.store(into + 9, zy)
    tl.store(into + 10, zz)
    tl.store(into + 11, z1)


@triton.jit(do_not_specialize=['rows', 'capacity'])
def clear_if_overflowed(gradients, total, rows, capacity, BLOCK: tl.constexpr):
    """Sets gradients [rows, 8] to zero, for atomics, if the lists do not fit."""
    if tl.load(total) > capacity:
        i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        tl.store(gradients + i, tl.zeros([BLOCK], tl.float32), mask=i < FIELDS * rows)


@triton.jit
def _collected(gradients, starts, counts, total, i, real, capacity, BLOCK: tl.constexpr):
    """Returns [BLOCK] eight sums over the entries of each Gaussian, as in csrc's SplatGradient."""
    fits = tl.load(total) <= capacity
    count = tl.load(counts + i, mask=real, other=0)
    start = tl.where(fits, tl.load(starts + i, mask=real, other=0), i.to(tl.int64))
    count = tl.where(fits, count, tl.minimum(count, 1))
    nothing = tl.zeros([BLOCK], tl.float32)
    s0, sx, sy, s2 = nothing, nothing, nothing, nothing
    sr, sg, sb, sz = nothing, nothing, nothing, nothing
    most = tl.max(count, axis=0)
    j = 0
    while j < most:
        record = gradients + FIELDS * (start + j)
        mask = j < count
        s0 += tl.load(record, mask=mask, other=0.0)
        sx += tl.load(record + 1, mask=mask, other=0.0)
        sy += tl.load(record + 2, mask=mask, other=0.0)
        s2 += tl.load(record + 3, mask=mask, other=0.0)
        sr += tl.load(record + 4, mask=mask, other=0.0)
        sg += tl.load(record + 5, mask=mask, other=0.0)
        sb += tl.load(record + 6, mask=mask, other=0.0)
        sz += tl.load(record + 7, mask=mask, other=0.0)
        j += 1
    return s0, sx, sy, s2, sr, sg, sb, sz


@triton.jit
def _to_world(pose, dx, dy, dz):
    """Converts a gradient by camera coordinates to one by world coordinates."""
    x = tl.load(pose) * dx + tl.load(pose + 4) * dy + tl.load(pose + 8) * dz
    y = tl.load(pose + 1) * dx + tl.load(pose + 5) * dy + tl.load(pose + 9) * dz
    z = tl.load(pose + 2) * dx + tl.load(pose + 6) * dy + tl.load(pose + 10) * dz
    return x, y, z


@triton.jit(do_not_specialize=['n', 'capacity'])
def project_backward(
    splats, starts, counts, total, gradients, pose, by_means, by_log_scales, by_logit_opacities, by_rgb, pose_sums,
    n, capacity, fx, fy, cx, cy, BLOCK: tl.constexpr,
):  # fmt: skip
    """Turns gradients of entries into those of all Gaussians, zero where not drawn, and into pose_sums [programs, 12]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    real = i < n
    s0, sx, sy, s2, sr, sg, sb, sz = _collected(gradients, starts, counts, total, i, real, capacity, BLOCK)
    splat = splats + FIELDS * i
    u, v = tl.load(splat, mask=real, other=0.0), tl.load(splat + 1, mask=real, other=0.0)
    falloff, z = tl.load(splat + 2, mask=real, other=-1.0), tl.load(splat + 7, mask=real, other=1.0)
    dx, dy, dz, by_scale = _through_projection(u, v, falloff, z, sx, sy, s2, sz, fx, fy, cx, cy)
    world_x, world_y, world_z = _to_world(pose, dx, dy, dz)
    tl.store(by_means + 3 * i, world_x, mask=real)
    tl.store(by_means + 3 * i + 1, world_y, mask=real)
    tl.store(by_means + 3 * i + 2, world_z, mask=real)
    tl.store(by_log_scales + i, by_scale, mask=real)
    tl.store(by_logit_opacities + i, s0 * (1.0 - tl.load(splat + 3, mask=real, other=0.0)), mask=real)
    tl.store(by_rgb + 3 * i, sr, mask=real)
    tl.store(by_rgb + 3 * i + 1, sg, mask=real)
    tl.store(by_rgb + 3 * i + 2, sb, mask=real)
    x, y = (u - cx) / fx * z, (v - cy) / fy * z
    _store_pose_sums(
        pose_sums + 12 * tl.program_id(0),
        tl.sum(dx * x, axis=0), tl.sum(dx * y, axis=0), tl.sum(dx * z, axis=0), tl.sum(dx, axis=0),
        tl.sum(dy * x, axis=0), tl.sum(dy * y, axis=0), tl.sum(dy * z, axis=0), tl.sum(dy, axis=0),
        tl.sum(dz * x, axis=0), tl.sum(dz * y, axis=0), tl.sum(dz * z, axis=0), tl.sum(dz, axis=0),
    )  # fmt: skip


@triton.jit
def _difference(drawn, wanted, weight, limit, counted):
    """Returns [P] Huber's loss, quadratic up to the limit and linear beyond, and its gradient."""
    difference = tl.where(counted, drawn - wanted, 0.0)
    size = tl.abs(difference)
    loss = tl.where(size <= limit, difference * difference / (2.0 * limit), size - 0.5 * limit)
    return weight * loss, weight * tl.minimum(tl.maximum(difference / limit, -1.0), 1.0)


@triton.jit(do_not_specialize=['n', 'capacity'])
def fit_tile(
    splats, order, entries, slots, begins, total, rgb8, depth, readings, gradients, losses,
    n, capacity, width, height, tiles_x, color_weight, depth_weight, enough, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Blends a tile, compares it with rgb8 [H, W, 3] and depth [H, W], and writes gradients of the entries and losses [tiles].

    The gradients are zero where the loss per pixel is less than ``enough``.
    """
    column, row, on_image = _pixels(tiles_x, width, height, TILE)
    x, y, at = column.to(tl.float32), row.to(tl.float32), row * width + column
    begin, end, fits = _span(begins, total, tl.program_id(0), n, capacity)
    r, g, b, d, s = _blend(splats, order, entries, begin, end, n, fits, x, y, on_image, CHUNK)
    red = tl.load(rgb8 + 3 * at, mask=on_image, other=0).to(tl.float32) / 255.0
    green = tl.load(rgb8 + 3 * at + 1, mask=on_image, other=0).to(tl.float32) / 255.0
    blue = tl.load(rgb8 + 3 * at + 2, mask=on_image, other=0).to(tl.float32) / 255.0
    range_m = tl.load(depth + at, mask=on_image, other=0.0)
    compared = on_image & (range_m >= 0.0)
    weight = depth_weight / tl.maximum(tl.load(readings), 1).to(tl.float32)
    loss_r, gr = _difference(r, red, color_weight, COLOR_LIMIT, compared)
    loss_g, gg = _difference(g, green, color_weight, COLOR_LIMIT, compared)
    loss_b, gb = _difference(b, blue, color_weight, COLOR_LIMIT, compared)
    loss_d, gd = _difference(d, range_m, weight, DEPTH_LIMIT_M, compared & (range_m > 0.0))
    loss = tl.sum(loss_r + loss_g + loss_b + loss_d, axis=0)
    tl.store(losses + tl.program_id(0), loss)
    is_fitted = tl.where(loss < enough * tl.sum(on_image.to(tl.float32), axis=0), 0.0, 1.0)
    gr, gg, gb, gd = gr * is_fitted, gg * is_fitted, gb * is_fitted, gd * is_fitted
    _to_entries(
        splats, order, entries, slots, gradients, begin, end, fits, x, y, on_image,
        gr * r + gg * g + gb * b + gd * d, gr, gg, gb, gd, tl.zeros_like(gd), CHUNK,
    )  # fmt: skip


@triton.jit
def _adam(value, moment, gradient, rate, left_1, left_2, seen):
    """Takes one step of one parameter (Adam with Nesterov's momentum, Dozat 2016). Returns its new value."""
    first = BETA_1 * tl.load(moment, mask=seen, other=0.0) + (1.0 - BETA_1) * gradient
    second = BETA_2 * tl.load(moment + 8, mask=seen, other=0.0) + (1.0 - BETA_2) * gradient * gradient
    tl.store(moment, first, mask=seen)
    tl.store(moment + 8, second, mask=seen)
    ahead = (BETA_1 * first + (1.0 - BETA_1) * gradient) / left_1
    moved = tl.load(value, mask=seen, other=0.0) - rate * ahead / (tl.sqrt(second / left_2) + EPSILON)
    tl.store(value, moved, mask=seen)
    return moved


@triton.jit(do_not_specialize=['n', 'capacity'])
def update(
    splats, starts, counts, total, gradients, pose, means, log_scales, logit_opacities, rgb, first_second, steps, corrections,
    bounds, n, capacity, fx, fy, cx, cy, means_rate, log_scales_rate, logit_opacities_rate, rgb_rate,
    HAS_BOUNDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Takes Adam steps of the Gaussians with a gradient, and extends ``bounds`` [blocks, 7]. One program per block."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    s0, sx, sy, s2, sr, sg, sb, sz = _collected(gradients, starts, counts, total, i, i < n, capacity, BLOCK)
    seen = (i < n) & ((s0 != 0.0) | (sr != 0.0) | (sg != 0.0) | (sb != 0.0) | (sz != 0.0))
    splat = splats + FIELDS * i
    u, v = tl.load(splat, mask=seen, other=0.0), tl.load(splat + 1, mask=seen, other=0.0)
    falloff, z = tl.load(splat + 2, mask=seen, other=-1.0), tl.load(splat + 7, mask=seen, other=1.0)
    dx, dy, dz, by_scale = _through_projection(u, v, falloff, z, sx, sy, s2, sz, fx, fy, cx, cy)
    world_x, world_y, world_z = _to_world(pose, dx, dy, dz)
    by_logit = s0 * (1.0 - tl.load(splat + 3, mask=seen, other=0.0))
    # A gradient whose square overflows would stay in the moments for ever.
    seen = seen & (tl.abs(world_x) < MAX_GRADIENT) & (tl.abs(world_y) < MAX_GRADIENT) & (tl.abs(world_z) < MAX_GRADIENT)
    seen = seen & (tl.abs(by_scale) < MAX_GRADIENT) & (tl.abs(by_logit) < MAX_GRADIENT) & (tl.abs(sr) < MAX_GRADIENT)
    seen = seen & (tl.abs(sg) < MAX_GRADIENT) & (tl.abs(sb) < MAX_GRADIENT)
    step = tl.minimum(tl.load(steps + i, mask=seen, other=0).to(tl.int32) + 1, 255)
    tl.store(steps + i, step.to(tl.uint8), mask=seen)
    left_1 = tl.load(corrections + 2 * step, mask=seen, other=1.0)
    left_2 = tl.load(corrections + 2 * step + 1, mask=seen, other=1.0)
    moment = first_second + 16 * i
    x = _adam(means + 3 * i, moment, world_x, means_rate, left_1, left_2, seen)
    y = _adam(means + 3 * i + 1, moment + 1, world_y, means_rate, left_1, left_2, seen)
    z = _adam(means + 3 * i + 2, moment + 2, world_z, means_rate, left_1, left_2, seen)
    log_scale = _adam(log_scales + i, moment + 3, by_scale, log_scales_rate, left_1, left_2, seen)
    _adam(logit_opacities + i, moment + 4, by_logit, logit_opacities_rate, left_1, left_2, seen)
    _adam(rgb + 3 * i, moment + 5, sr, rgb_rate, left_1, left_2, seen)
    _adam(rgb + 3 * i + 1, moment + 6, sg, rgb_rate, left_1, left_2, seen)
    _adam(rgb + 3 * i + 2, moment + 7, sb, rgb_rate, left_1, left_2, seen)
    if HAS_BOUNDS:
        own = bounds + 7 * tl.program_id(0)
        _lower(own, x, seen)
        _lower(own + 1, y, seen)
        _lower(own + 2, z, seen)
        _raise(own + 3, x, seen)
        _raise(own + 4, y, seen)
        _raise(own + 5, z, seen)
        _raise(own + 6, log_scale, seen)


@triton.jit
def _lower(bound, value, seen):
    tl.store(bound, tl.minimum(tl.load(bound), tl.min(tl.where(seen, value, float('inf')), axis=0)))


@triton.jit
def _raise(bound, value, seen):
    tl.store(bound, tl.maximum(tl.load(bound), tl.max(tl.where(seen, value, float('-inf')), axis=0)))


INTERPRETED = not isinstance(project, triton.JITFunction)
