"""Sensors beside the camera: the receiver of positions, from files and while it sends."""
