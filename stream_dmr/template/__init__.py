"""Meshes of species."""
