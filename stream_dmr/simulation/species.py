"""Mean bodies of species that scenes can be drawn with.

Drawn by formulas of their own, not from the tables of the bundled templates, so that measuring them
with those is no test against itself. Proportions as anglers' and FAO's guides draw these fish; good
to some 10 %.
"""

from stream_dmr.errors import UserError
from stream_dmr.simulation.simulated_body import HALIBUT, SimulatedBody

SPECIES: dict[str, SimulatedBody] = {
    "halibut": HALIBUT,
    "haddock": SimulatedBody(
        half_width=0.108,
        widest_at=0.33,
        half_thickness=0.068,
        thickest_at=0.28,
        peduncle_half_width=0.024,
        tail_half_width=0.085,
        fork_depth=0.018,
    ),
    "trout": SimulatedBody(
        half_width=0.118,
        widest_at=0.43,
        half_thickness=0.058,
        thickest_at=0.38,
        peduncle_half_width=0.045,
        tail_half_width=0.098,
        fork_depth=0.012,
    ),
    "perch": SimulatedBody(
        half_width=0.155,
        widest_at=0.37,
        half_thickness=0.075,
        thickest_at=0.32,
        peduncle_half_width=0.042,
        tail_half_width=0.11,
        fork_depth=0.028,
    ),
    "gar": SimulatedBody(
        half_width=0.056,
        widest_at=0.55,
        half_thickness=0.046,
        thickest_at=0.5,
        peduncle_half_width=0.027,
        tail_half_width=0.062,
        fork_depth=0.005,
    ),
    "skipjack": SimulatedBody(
        half_width=0.13,
        widest_at=0.4,
        half_thickness=0.1,
        thickest_at=0.38,
        peduncle_half_width=0.012,
        tail_from=0.9,
        tail_half_width=0.14,
        fork_depth=0.09,
    ),
    "conger": SimulatedBody(
        half_width=0.046,
        widest_at=0.34,
        half_thickness=0.037,
        thickest_at=0.3,
        peduncle_half_width=0.02,
        tail_half_width=0.017,
        fork_depth=0.0,
    ),
}


def find_species(names: str) -> list[SimulatedBody]:
    """The mean bodies of these names, joined by commas. Raises UserError for an unknown one."""
    for name in names.split(","):
        if name not in SPECIES:
            raise UserError(f"--species: expected any of {', '.join(SPECIES)}, got {name!r}")
    return [SPECIES[name] for name in names.split(",")]
