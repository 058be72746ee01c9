"""The record of truth (.mcap) and the view (.rrd)."""
