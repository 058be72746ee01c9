"""Facts of one caught fish beside its length, as `fish` of lengths.db holds them."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CatchFacts:
    """What a run found out about a fish; None where it did not.

    The fields are columns of `fish` that the first databases lack. A value of None stands in no
    checksum, so that a database that got the columns later stays as it was sealed.
    """

    species_code: str | None = None  # FAO 3-alpha
    fate: str | None = None  # what became of it: "landed", ...


UNKNOWN_CATCH = CatchFacts()
