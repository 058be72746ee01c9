"""Frames with capture times from files, folders, cameras and streams."""
