"""Trackers: (frame, map, first guess of the pose) in, pose and how far to trust it out."""

from splatam_core.tracking.base import Tracker, TrackingResult
from splatam_core.tracking.render_and_compare import RenderAndCompareTracker

__all__ = ['RenderAndCompareTracker', 'Tracker', 'TrackingResult']
