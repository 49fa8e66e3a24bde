"""Scores of a run: its trajectory against the ground truth, and renders of its map against the frames."""
