"""Shows a map in a browser: Gaussians, camera, trajectories, and controls."""
