"""Facts of one caught fish beside its length, as `fish` of lengths.db holds them."""

from dataclasses import dataclass, fields

from stream_dmr.messages import LengthEstimate


@dataclass(frozen=True, kw_only=True)
class CatchFacts:
    """What a run found out about a fish; None where it did not.

    Each field is a column of `fish`, which older databases get when they are next written to. A
    value of None stands in no checksum, so that these stay as they were sealed.
    """

    species_code: str | None = None  # FAO 3-alpha, or "unsure"
    species_share: float | None = None  # posterior probability of the likeliest species
    fate: str | None = None  # what became of it: "landed", ...
    fate_share: float | None = None  # of its body in that zone when it was last seen

    @classmethod
    def of(cls, estimate: LengthEstimate) -> "CatchFacts":
        """Those that a final estimate has."""
        return cls(**{field.name: getattr(estimate, field.name) for field in fields(cls)})


UNKNOWN_CATCH = CatchFacts()
