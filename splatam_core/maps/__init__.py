"""Maps as files: PLY, exports, videos."""
