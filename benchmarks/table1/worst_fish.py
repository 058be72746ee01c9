"""The fish of Table 1 that ours measured worst, to look at: docs/images/table1_worst.jpg.

    python -m benchmarks.table1.worst_fish

One row a fish, six frames of its passage: the crop with the mask (yellow), the fitted mesh (green),
head (red), center (white) and tail (blue), and the length of the frame.
"""

from pathlib import Path

import cv2
import numpy as np

from benchmarks.fit_speed.targets import species_template
from benchmarks.table1 import cached_results
from benchmarks.table1.filmed_scene import chain_crops, table_scene
from benchmarks.table1.tables import worst_fish
from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.simulation.film import film
from stream_dmr.web.views import crop_outlines, draw_outlines

_NUM_FISH, _NUM_FRAMES, _TILE_PX = 5, 6, 170
OUT = Path(__file__).parents[2] / "docs" / "images" / "table1_worst.jpg"


def row(fish: cached_results.Fish) -> np.ndarray:
    """Frames spread over the passage of one fish."""
    scene, template = table_scene(fish.scene), species_template()
    fit, localize, _ = Session(
        Setup(config=Config(), template=template, calibration=scene.calibration)
    ).nodes
    seen: list[tuple[FishCrop, FittedMesh, LocalizedFish]] = []
    for shot in film(scene):
        for track_id, crop in chain_crops(shot, scene.calibration):
            if track_id == fish.track_id:
                mesh = fit.step(crop)[0]
                assert isinstance(mesh, FittedMesh)
                place = localize.step(mesh)[0]
                assert isinstance(place, LocalizedFish)
                seen.append((crop, mesh, place))
    chosen = np.linspace(0, len(seen) - 1, _NUM_FRAMES).round().astype(int)
    tiles = [_tile(*seen[n], faces=template.faces) for n in chosen]
    length_mm = fish.measured.length_mm
    text = f"scene {fish.scene}, fish {fish.track_id}: {fish.truth_mm:.0f} mm, got {length_mm:.0f}"
    tiles[0] = _written(tiles[0], text, y=_TILE_PX - 6)
    return np.hstack(tiles)


def _tile(
    crop: FishCrop, mesh: FittedMesh, place: LocalizedFish, *, faces: np.ndarray
) -> np.ndarray:
    assert crop.image is not None
    picture = cv2.resize(crop.image, (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_CUBIC)
    if mesh.shape is not None:
        picture = draw_outlines(
            picture, crop_outlines(crop, mesh.shape, faces), crop_size=len(crop.mask)
        )
    length = "" if place.length_mm is None else f"{place.length_mm:.0f} mm "
    return _written(picture.copy(), f"{length}{place.reason}", y=12)


def _written(picture: np.ndarray, text: str, *, y: int) -> np.ndarray:
    font, white = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
    return cv2.putText(picture, text, (3, y), font, 0.33, white, 1, cv2.LINE_AA)


def main() -> None:
    """Draw the five worst of those that were measured."""
    scenes = range(1000)
    rows = cached_results.load("dmr", scenes, cache=cached_results.CACHE)["dmr"]
    picture = np.vstack([row(fish) for fish in worst_fish(rows, _NUM_FISH)])
    cv2.imwrite(str(OUT), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(OUT)


if __name__ == "__main__":
    main()
