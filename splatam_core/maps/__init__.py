"""Maps as files: PLY files, exports for other programs, images and videos along a path."""
