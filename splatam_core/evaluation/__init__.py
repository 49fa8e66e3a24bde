"""Scores of a run: trajectory against truth, renders against images, and the report that shows both."""
