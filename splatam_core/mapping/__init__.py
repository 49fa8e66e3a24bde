"""The map and everything that changes it."""
