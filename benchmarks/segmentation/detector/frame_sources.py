"""The frames with boxes that `real_sources.toml` lists: to learn from, and to score."""

import tomllib
from pathlib import Path
from typing import Any

from benchmarks.segmentation.detector.training_frames import AnnotatedFrame, read_frames

_MANIFEST = Path(__file__).parents[1] / "real_sources.toml"
# Every so many frames of a source: those of one clip are alike.
_EVERY = {
    "aquarium": 1,
    "fish4knowledge": 4,
    "milkfish": 3,
    "deepfish-clips": 3,
    "patin-tub": 2,
    "patin-flow": 2,
    "tank-from-above": 6,
    "murky-pond": 4,
    "reef-web": 4,
}
_HELD_BACK = 8  # one in so many frames

Sources = dict[str, list[AnnotatedFrame]]


def read_sources(repositories: Path) -> tuple[Sources, Sources]:
    """By source: the frames to learn from, none of some sources; and those that are held back."""
    listed = tomllib.loads(_MANIFEST.read_text(encoding="utf-8"))
    manifest = listed["sources"] | listed["frames"]
    learnt, held_back = {}, {}
    for name, every in _EVERY.items():
        source = manifest[name]
        read = read_frames(repositories, source, every=every)
        is_back = [is_held_back(frame, index, source) for index, frame in enumerate(read)]
        learnt[name] = [frame for frame, back in zip(read, is_back, strict=True) if not back]
        held_back[name] = [frame for frame, back in zip(read, is_back, strict=True) if back]
    return learnt, held_back


def is_held_back(frame: AnnotatedFrame, index: int, source: dict[str, Any]) -> bool:
    """True for a frame that is scored, not trained on: of a source, of a clip, or one in eight."""
    if "held_back_clips" in source:
        return frame.name.startswith(tuple(source["held_back_clips"]))
    return source["role"] == "held out" or index % _HELD_BACK == 0
