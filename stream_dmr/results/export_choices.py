"""The formats of exports: for the command, which offers them before it imports anything else."""

from typing import Literal

MeshFormat = Literal["ply", "glb"]
TableFormat = Literal["csv", "parquet"]
Agency = Literal["wcpfc", "rdbes"]
