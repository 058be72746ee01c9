"""Recordings in MCAP and Rerun files: written, read, converted, repaired."""
