"""The colours of fish, the same in every view."""

# After Okabe and Ito, told apart by the colour-blind too; bright enough for a dark ground.
PALETTE = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
    (122, 130, 255),
)


def color(track_id: int) -> tuple[int, int, int]:
    """The colour of a track, the same in every view."""
    return PALETTE[track_id % len(PALETTE)]
