"""Fit a mesh to a crop: solver/ is compiled, shape/ learns, paper/ is the reference in torch."""
