"""`[species]`: which species a fish is of."""

from pydantic import Field, field_validator

from stream_dmr.settings import Settings


class SpeciesSettings(Settings):
    """`[species]`: which species a fish is of."""

    model: str = Field(
        default="", description='classifier of crops (.onnx), see docs/species.md; "": none'
    )
    min_share: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description='least probability of the likeliest species; a fish below it is "unsure"',
    )
    frame_correlation: float = Field(
        default=0.25,
        ge=0,
        le=1,
        description="how alike a classifier's mistakes in a fish's frames are: all frames together "
        "count as 1 / this independent ones at most; 0: each counts",
    )
    own_list: str = Field(
        default="",
        description="CSV with the columns code,scientific_name,english_name,form whose species are "
        'added to the bundled ones, for reviewers and for body forms; "": none',
    )
    forms: list[str] = Field(
        default=[],
        description='body forms of species by code, such as ["HAP=halibut"], beside those of the '
        "list; a sure species gives its fish the form",
    )

    @field_validator("forms")
    @classmethod
    def _is_pair(cls, pairs: list[str]) -> list[str]:
        if any(len([part for part in pair.split("=") if part.strip()]) != 2 for pair in pairs):
            raise ValueError('pairs such as "HAP=halibut"')
        return pairs
