"""Seal and verify the folder of a run."""
