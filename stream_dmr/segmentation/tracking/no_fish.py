"""What a run without fish says: what was seen instead, and what to change."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(kw_only=True)
class Sightings:
    """What was seen in the frames so far."""

    frames: int = 0
    candidates: int = 0  # shapes that a detector took for possible fish, over all frames
    tracks: int = 0  # followed ones
    any_moved: bool = False  # one of them moved from its place
    any_fish_like: bool = False  # one of those looked like a fish
    best_confidence: float = 0.0  # highest `mask_confidence` of any crop


def explain_no_fish(
    seen: Sightings,
    refused: Mapping[str, int],
    *,
    min_frames: int,
    min_confidence: float,
) -> str:
    """One line: why no fish was found in these frames, and what to do.

    `refused` are the detector's shapes that were no candidates, by reason; `min_frames` and
    `min_confidence` are `[track_fish] min_track_frames` and `min_mask_confidence`.
    """
    begin = f"no fish in {seen.frames} frames: "
    if seen.candidates == 0 and not refused:
        return begin + (
            "nothing moved or looked like a fish; fish that hardly move and look unlike others "
            "need a detector of your own (.onnx), or --boxes"
        )
    if seen.candidates == 0:
        shapes = ", ".join(f"{count} {reason}" for reason, count in _commonest(refused))
        return begin + (
            f"all {sum(refused.values())} moving shapes were refused ({shapes}); change that "
            "setting where these were fish"
        )
    if seen.tracks > 0 and not seen.any_moved:
        return begin + (
            f"{seen.tracks} shapes were followed, none left its place by a quarter of its size, "
            "as plants and glitter don't; fish that stay need a detector of your own (.onnx) or "
            "--boxes; --stills for single pictures"
        )
    if seen.tracks > 0 and not seen.any_fish_like:
        return begin + (
            f"{seen.tracks} shapes were followed, none looked like a fish to the network; set "
            "[track_fish] min_fish_like_frames = 0 where they are fish"
        )
    if seen.best_confidence < min_confidence:
        return begin + (
            f"{seen.candidates} shapes were looked at, and no mask was as sure as [track_fish] "
            f"min_mask_confidence = {min_confidence:g} (the surest {seen.best_confidence:.2f}); "
            "lower it, or train the network on these pictures"
        )
    return begin + (
        f"{seen.tracks} shapes were followed, none with a sure mask in {min_frames} frames within "
        "the zone; lower [track_fish] min_track_frames, or widen zone; --stills for single pictures"
    )


def _commonest(refused: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(refused.items(), key=lambda item: -item[1])
