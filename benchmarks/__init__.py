"""Measurements by hand, each with the tables of a page in docs/research.

They run from the root of the project as `python -m benchmarks.NAME`; each docstring says how.
"""
