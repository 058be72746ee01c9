"""Recomputes recordings from any stage, and compares the results with the recorded ones."""
