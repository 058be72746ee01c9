"""The deformable mesh: its parameters, its solvers and its fit to a mask."""
