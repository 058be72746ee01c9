"""Masks and fits of a video, found from its pixels alone, as one picture to look at.

    python -m benchmarks.segmentation.contact_sheet fish.mp4 --template cod --out sheet.jpg

Thirty fish and frames, spread over the video: the crop, and the crop with the mask (yellow), the
fitted mesh (green), head (red), center (white), tail (blue), id and confidence of the mask. No
calibration: shapes are relative. Printed: which fish were followed for how long, and how often the
head of a fish changed ends from one frame to the next, by the network's cue and by the fit.
"""

import argparse
import threading
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from stream_dmr.messages import FishCrop, FittedMesh, Message
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.nodes.read_frames import ReadFrames
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.config import load_config
from stream_dmr.pipeline.session import Session, Setup
from stream_dmr.template.template_file import load_template
from stream_dmr.tracking.finder import open_finder
from stream_dmr.web.views import crop_outlines, draw_outlines

_SHOWN, _PER_ROW = 30, 10
_TILE_PX = 160

Pair = tuple[FishCrop, FittedMesh]


def fit_video(video: str, *, template: str, path: Path | None) -> list[Pair]:
    """Every crop with its fit, in the order of the frames."""
    config = load_config(path)
    finder = open_finder(boxes=None, masks=None, detect=config.detect_fish, track=config.track_fish)
    node = CropFish(config.crop_fish, camera=None, finder=finder)
    later = Session(Setup(config=config, template=load_template(template), calibration=None)).nodes
    crops: dict[tuple[int, int], FishCrop] = {}
    pairs: list[Pair] = []

    def note(message: Message) -> Message:
        if isinstance(message, FishCrop):
            crops[message.frame_index, message.track_id] = message
        elif isinstance(message, FittedMesh):
            pairs.append((crops.pop((message.frame_index, message.track_id)), message))
        return message

    reader = ReadFrames(video, config.read_frames)
    Chain(reader, [node, *later], on_message=note, stop=threading.Event()).run()
    reader.close()
    return pairs


def tile(pair: Pair, faces: np.ndarray) -> np.ndarray:
    """The crop above the crop with what was found."""
    crop, mesh = pair
    assert crop.image is not None
    picture = cv2.resize(crop.image, (_TILE_PX, _TILE_PX), interpolation=cv2.INTER_CUBIC)
    found = picture
    if mesh.shape is not None:
        found = draw_outlines(
            picture, crop_outlines(crop, mesh.shape, faces), crop_size=len(crop.mask)
        )
    text = f"{crop.track_id}: {crop.quality.mask_confidence:.2f} {mesh.refusal}"
    found = cv2.putText(
        found.copy(), text, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1
    )
    return np.vstack([picture, found])


def turns(pairs: list[Pair]) -> str:
    """How often head and tail changed places between consecutive frames of a fish."""
    last: dict[tuple[str, int], tuple[int, np.ndarray]] = {}
    turned, seen = Counter(), Counter()
    for crop, mesh in pairs:
        forward = {}
        if crop.ends is not None:
            forward["cue"] = crop.ends.head_px - crop.ends.tail_px
        if mesh.shape is not None:
            forward["fit"] = mesh.shape.keypoints_px[0] - mesh.shape.keypoints_px[2]
        for who, now in forward.items():
            frame, before = last.get((who, crop.track_id), (-1, now))
            if frame == crop.frame_index - 1:
                seen[who] += 1
                turned[who] += bool(now @ before < 0)
            last[who, crop.track_id] = crop.frame_index, now
    return ", ".join(f"{who} {turned[who]} of {seen[who]}" for who in seen)


def main() -> None:
    """Write the picture, and print what can be counted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video")
    parser.add_argument("--template", default="halibut")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--out", type=Path, default=Path("sheet.jpg"))
    arguments = parser.parse_args()
    pairs = fit_video(arguments.video, template=arguments.template, path=arguments.config)
    frames = Counter(crop.track_id for crop, _ in pairs)
    print(f"{len(pairs)} crops of {len(frames)} fish; frames of each: {dict(frames)}")
    print(f"head and tail changed places: {turns(pairs)}")
    faces = load_template(arguments.template).faces
    chosen = np.linspace(0, len(pairs) - 1, min(_SHOWN, len(pairs))).round().astype(int)
    tiles = [tile(pairs[i], faces) for i in chosen]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _PER_ROW)
    rows = [np.hstack(tiles[k : k + _PER_ROW]) for k in range(0, len(tiles), _PER_ROW)]
    cv2.imwrite(str(arguments.out), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
