"""Keyframes as places: they are recognised, joined by a graph, and moved together with what they have mapped."""
