"""Run folders: written during a run, read by the commands, and resumed from checkpoints."""
