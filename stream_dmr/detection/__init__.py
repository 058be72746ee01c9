"""Candidates for fish by motion and networks, and fish of given boxes and masks."""
