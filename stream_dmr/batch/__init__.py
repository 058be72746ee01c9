"""Measure many videos, in local processes or on a Ray cluster."""
