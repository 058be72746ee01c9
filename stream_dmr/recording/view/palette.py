"""The colours of tracks, the same in every view."""

# RGB after Okabe and Ito, "Color Universal Design" (2008): distinct also for the colour-blind.
# Black is left out and blue is brighter than theirs, since the views are dark.
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
    """The RGB colour of a track; it repeats after seven."""
    return PALETTE[track_id % len(PALETTE)]
