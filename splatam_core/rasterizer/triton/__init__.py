"""The rasterizer of GPUs, written in Triton."""
