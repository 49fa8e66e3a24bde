"""Coordinate frames: REP-105 arithmetic, TF and odometry."""
