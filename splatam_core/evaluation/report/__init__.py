"""Shows scores: pages, plots and tables."""
