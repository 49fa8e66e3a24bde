"""Image filters on any device: OpenCV's on the CPU, where they are fastest, and the same in torch elsewhere."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_SSIM_WINDOW = cv2.getGaussianKernel(11, 1.5)  # [11, 1]


def is_on_host(tensor: Tensor) -> bool:
    """Returns whether numpy and OpenCV can read the tensor."""
    return tensor.is_cpu


def blurred(images: Tensor) -> Tensor:
    """Convolves images [N, H, W] with SSIM's 11x11 Gaussian window; zeros outside.

    OpenCV's separable filter takes a hundredth of the time of torch's convolution on a CPU.
    """
    return _blurred_on_host(images) if is_on_host(images) else blurred_by_torch(images)


def box_sums(image: Tensor, side: int) -> Tensor:
    """Returns [H, W] sums over a square with an odd side around each pixel; zeros outside."""
    if not is_on_host(image):
        return box_sums_by_torch(image, side)
    sums = cv2.boxFilter(image.numpy(), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(sums)


def closed(mask: Tensor, reach: int, margin: int) -> Tensor:
    """Returns [H, W] bool: a mask [H, W] whose holes of at most ``2 * reach`` pixels are closed, grown by a margin.

    Args:
        mask: [H, W] bool.
        reach: pixels along rows and columns.
        margin: pixels along rows and columns.
    """
    if not is_on_host(mask):
        return closed_by_torch(mask, reach, margin)
    if bool(mask.all()):
        return mask
    grown, shrunk_by = (np.ones((2 * size + 1,) * 2, np.uint8) for size in (reach + margin, reach))
    return torch.from_numpy(cv2.erode(cv2.dilate(mask.numpy().view(np.uint8), grown), shrunk_by).view(np.bool_))


def shrunk(rgb8: Tensor, width: int, height: int) -> Tensor:
    """Shrinks [H, W, 3] uint8 to [height, width, 3]: each pixel is the mean of the area it covers."""
    if not is_on_host(rgb8):
        return shrunk_by_torch(rgb8, width, height)
    return torch.from_numpy(cv2.resize(rgb8.numpy(), (width, height), interpolation=cv2.INTER_AREA))


def nearest(image: Tensor, width: int, height: int) -> Tensor:
    """Resizes [H, W] to [height, width] by the nearest pixel centre."""
    if not is_on_host(image):
        return nearest_by_torch(image, width, height)
    return torch.from_numpy(cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_NEAREST_EXACT))


def median(values: Tensor, mask: Tensor) -> Tensor:
    """Returns [] the median of the values [H, W] under a mask, the lower one of two; NaN if the mask is empty."""
    if not is_on_host(values):
        return median_by_torch(values, mask)
    return torch.where(mask, values, torch.nan).nanmedian()


def brightness(rgb8: Tensor) -> Tensor:
    """Returns [H, W] luminance in [0, 1] of 8-bit colours [H, W, 3], in torch."""
    return luminance(rgb8.float()) / 255


def luminance(rgb: Tensor) -> Tensor:
    """Returns [...] luminance of colours [..., 3], in torch."""
    return 0.299 * rgb[..., 0] + 0.587 * rgb[..., 1] + 0.114 * rgb[..., 2]


def _blurred_on_host(images: Tensor) -> Tensor:
    result = torch.empty_like(images, memory_format=torch.contiguous_format)
    for source, target in zip(images.contiguous().numpy(), result.numpy()):
        cv2.sepFilter2D(source, -1, _SSIM_WINDOW, _SSIM_WINDOW, dst=target, borderType=cv2.BORDER_CONSTANT)
    return result


def blurred_by_torch(images: Tensor) -> Tensor:
    """See ``blurred``."""
    window = _ssim_window(images.device).to(images.dtype)
    along_rows = functional.conv2d(images[:, None], window[:, :, None, :], padding=(0, 5))
    return functional.conv2d(along_rows, window[:, :, :, None], padding=(5, 0))[:, 0]


@lru_cache(maxsize=8)
def _ssim_window(device: torch.device) -> Tensor:
    """Returns [1, 1, 11]. Cached, because the host waits for the transfer to the device."""
    return torch.from_numpy(_SSIM_WINDOW[:, 0]).float().view(1, 1, -1).to(device)


def box_sums_by_torch(image: Tensor, side: int) -> Tensor:
    """See ``box_sums``."""
    return functional.avg_pool2d(image[None, None], side, stride=1, padding=side // 2, divisor_override=1)[0, 0]


def closed_by_torch(mask: Tensor, reach: int, margin: int) -> Tensor:
    """See ``closed``."""
    grown = functional.max_pool2d(mask[None, None].float(), 2 * (reach + margin) + 1, 1, reach + margin)
    return functional.max_pool2d(-grown, 2 * reach + 1, 1, reach)[0, 0] < 0


def shrunk_by_torch(rgb8: Tensor, width: int, height: int) -> Tensor:
    """See ``shrunk``. OpenCV rounds ties differently, so a colour may differ by 1 of 255."""
    rows, columns = (_overlaps(*sizes, rgb8.device) for sizes in ((rgb8.shape[0], height), (rgb8.shape[1], width)))
    image = rgb8.permute(2, 0, 1).float()  # [3, H, W]
    return (rows @ image @ columns.T).round_().clamp_(0, 255).byte().permute(1, 2, 0).contiguous()


def _overlaps(size: int, new_size: int, device: torch.device) -> Tensor:
    """Returns [new_size, size] fractions of each new pixel that lie on each old one; rows sum to one."""
    step = size / new_size
    begins = torch.arange(new_size, device=device, dtype=torch.float64)[:, None] * step
    pixels = torch.arange(size, device=device, dtype=torch.float64)
    overlap = torch.minimum(begins + step, pixels + 1) - torch.maximum(begins, pixels)
    return (overlap.clamp_(min=0) / step).float()


def median_by_torch(values: Tensor, mask: Tensor) -> Tensor:
    """See ``median``. It sorts, because torch's own median makes the host wait for the device."""
    ordered = torch.where(mask, values, torch.inf).flatten().sort().values
    middle = (mask.sum() - 1).clamp_(min=0) // 2
    value = ordered.gather(0, middle[None])[0]
    return torch.where(torch.isinf(value), torch.nan, value)


def nearest_by_torch(image: Tensor, width: int, height: int) -> Tensor:
    """See ``nearest``."""
    rows, columns = (_nearest(*sizes, image.device) for sizes in ((image.shape[0], height), (image.shape[1], width)))
    return image[rows][:, columns]


def _nearest(size: int, new_size: int, device: torch.device) -> Tensor:
    """Returns [new_size] the old pixel nearest to each new one; the later one of two equally near."""
    positions = np.floor((np.arange(new_size) + 0.5) * (size / new_size)).astype(np.int64)
    return torch.from_numpy(np.minimum(positions, size - 1)).to(device)


def inliers(error: Tensor, mask: Tensor, ratio: float) -> Tensor:
    """Returns [H, W] the part of a mask where the error is at most ``ratio`` times its median under the mask."""
    return mask & (error <= ratio * median(error, mask))
