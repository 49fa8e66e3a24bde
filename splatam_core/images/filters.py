"""Image filters on any device: OpenCV's on the processor, where they are the fastest, and the same in torch elsewhere."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_SSIM_WINDOW = cv2.getGaussianKernel(11, 1.5)  # [11, 1]


def is_on_host(tensor: Tensor) -> bool:
    """Whether numpy and OpenCV reach it."""
    return tensor.device.type == 'cpu'


def blurred(images: Tensor) -> Tensor:
    """Images [N, H, W] convolved with SSIM's 11x11 Gaussian window, zeros outside.

    OpenCV's separable filter takes a hundredth of the time of torch's convolution on a CPU.
    """
    return _blurred_on_host(images) if is_on_host(images) else blurred_by_torch(images)


def box_sums(image: Tensor, side: int) -> Tensor:
    """[H, W] sums over the square of an odd side around each pixel, zeros outside."""
    if not is_on_host(image):
        return box_sums_by_torch(image, side)
    sums = cv2.boxFilter(image.numpy(), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(sums)


def shrunk(rgb8: Tensor, width: int, height: int) -> Tensor:
    """[height, width, 3] uint8 of a larger image [H, W, 3] uint8: each pixel the mean of the area it covers."""
    if not is_on_host(rgb8):
        return shrunk_by_torch(rgb8, width, height)
    return torch.from_numpy(cv2.resize(rgb8.numpy(), (width, height), interpolation=cv2.INTER_AREA))


def nearest(image: Tensor, width: int, height: int) -> Tensor:
    """[height, width] of an image [H, W] of another size: the pixel nearest to each centre."""
    if not is_on_host(image):
        return nearest_by_torch(image, width, height)
    return torch.from_numpy(cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_NEAREST_EXACT))


def median(values: Tensor, counts: Tensor) -> Tensor:
    """[] of the values [H, W] that count, the lower one of two; NaN where none does."""
    if not is_on_host(values):
        return median_by_torch(values, counts)
    return torch.where(counts, values, torch.nan).nanmedian()


def brightness(rgb8: Tensor) -> Tensor:
    """[H, W] luminance in [0, 1] of 8-bit colours [H, W, 3], in torch."""
    return luminance(rgb8.float()) / 255


def luminance(rgb: Tensor) -> Tensor:
    """[...] luminance of colours [..., 3], in torch."""
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
    """[1, 1, 11]; brought over once, for the host would wait for it every time."""
    return torch.from_numpy(_SSIM_WINDOW[:, 0]).float().view(1, 1, -1).to(device)


def box_sums_by_torch(image: Tensor, side: int) -> Tensor:
    """See ``box_sums``."""
    return functional.avg_pool2d(image[None, None], side, stride=1, padding=side // 2, divisor_override=1)[0, 0]


def shrunk_by_torch(rgb8: Tensor, width: int, height: int) -> Tensor:
    """See ``shrunk``; OpenCV rounds ties otherwise, so a colour may differ by one of its 255 steps."""
    rows, columns = (_shares(*sizes, rgb8.device) for sizes in ((rgb8.shape[0], height), (rgb8.shape[1], width)))
    image = rgb8.permute(2, 0, 1).float()  # [3, H, W]
    return (rows @ image @ columns.T).round_().clamp_(0, 255).byte().permute(1, 2, 0).contiguous()


def _shares(size: int, new_size: int, device: torch.device) -> Tensor:
    """[new_size, size] how much of each new pixel lies on each old one; rows sum to one."""
    step = size / new_size
    begins = torch.arange(new_size, device=device, dtype=torch.float64)[:, None] * step
    pixels = torch.arange(size, device=device, dtype=torch.float64)
    overlap = torch.minimum(begins + step, pixels + 1) - torch.maximum(begins, pixels)
    return (overlap.clamp_(min=0) / step).float()


def median_by_torch(values: Tensor, counts: Tensor) -> Tensor:
    """See ``median``. A sort, because torch's own makes the host wait for the device."""
    ordered = torch.where(counts, values, torch.inf).flatten().sort().values
    middle = (counts.sum() - 1).clamp_(min=0) // 2
    value = ordered.gather(0, middle[None])[0]
    return torch.where(torch.isinf(value), torch.nan, value)


def nearest_by_torch(image: Tensor, width: int, height: int) -> Tensor:
    """See ``nearest``."""
    rows, columns = (_nearest(*sizes, image.device) for sizes in ((image.shape[0], height), (image.shape[1], width)))
    return image[rows][:, columns]


def _nearest(size: int, new_size: int, device: torch.device) -> Tensor:
    """[new_size] the old pixel nearest to each new one; of two equally near, the later."""
    positions = np.floor((np.arange(new_size) + 0.5) * (size / new_size)).astype(np.int64)
    return torch.from_numpy(np.minimum(positions, size - 1)).to(device)


def inliers(error: Tensor, counts: Tensor, ratio: float) -> Tensor:
    """[H, W] what counts and has an error of at most so many times the median of all that count."""
    return counts & (error <= ratio * median(error, counts))
