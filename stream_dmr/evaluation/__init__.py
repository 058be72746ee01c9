"""Measured lengths compared with known ones: metrics, tables, plots."""
