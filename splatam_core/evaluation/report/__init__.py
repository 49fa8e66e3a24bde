"""Shows the scores of a run: a page, a picture, tables, and the comparison of several runs."""
