"""Readers of recordings: one file each, whose docstring draws the folder it reads."""
