"""Bags: opening the files, topics and messages, reading a bag as a sequence, writing one. Only this package uses rosbags."""
