"""Readers of recordings: one file each, its docstring draws the folder it reads."""

from splatam_core.datasets.base import BagTopics, Sequence
from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.registry import open_sequence

__all__ = ['BagTopics', 'Sequence', 'open_sequence', 'write_bag']
