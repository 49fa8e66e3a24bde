"""The commands of ``splatam``, one file each. Slow imports (torch, OpenCV, matplotlib) happen when a command runs."""
