"""The live viewer: a process of its own, to which the node hands what it asks for."""
