"""Rigid motions, pinhole cameras and trajectories."""
