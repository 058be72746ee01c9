"""The formats of exports: for the command, which offers them before it imports anything else."""

from enum import StrEnum
from typing import Literal

MeshFormat = Literal["ply", "glb"]
TableFormat = Literal["csv", "parquet"]


class Agency(StrEnum):
    """Tables for an agency or a data portal; an enumeration, since the option may be repeated."""

    WCPFC = "wcpfc"
    RDBES = "rdbes"
    OBIS = "obis"
    CAMTRAP_DP = "camtrap-dp"
