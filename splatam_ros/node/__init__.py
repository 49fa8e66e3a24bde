"""The SLAM node."""
