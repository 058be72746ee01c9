"""Measures a fish in boxes that a reviewer has drawn, by the nodes of a run."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from stream_dmr.errors import UserError
from stream_dmr.messages import FishCrop, FittedMesh, LocalizedFish
from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.recording.messages.codec import encode
from stream_dmr.recording.messages.record import as_recorded
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.reading.frame_lookup import FoundFrame
from stream_dmr.results.verdicts_table import AddedFrame
from stream_dmr.running.chain_nodes import later_nodes
from stream_dmr.running.config import Config
from stream_dmr.segmentation.annotations.annotated_box import AnnotatedBox
from stream_dmr.segmentation.annotations.annotated_fish import AnnotatedFish

Boxes = Mapping[int, Float[np.ndarray, "4"]]  # by frame index: x0, y0, x1, y1 in frame pixels


def boxes_between(drawn: Boxes, frame_indices: Sequence[int]) -> Boxes:
    """The boxes of all `frame_indices` from the first drawn one to the last.

    Corners move evenly from one drawn box to the next.
    """
    known = sorted(drawn)
    corners = np.array([drawn[frame_index] for frame_index in known], float)
    between = [index for index in frame_indices if known[0] <= index <= known[-1]]
    columns = [np.interp(between, known, corners[:, k]) for k in range(4)]
    return dict(zip(between, np.stack(columns, axis=1), strict=True))


@dataclass(frozen=True, kw_only=True)
class MeasuredBoxes:
    """The frames of a fish that was measured in boxes."""

    frames: Sequence[AddedFrame]
    fish: Sequence[LocalizedFish]  # the last message of each
    is_original: bool  # measured on the very pixels of the run


def measure_boxes(
    found: Sequence[FoundFrame],
    drawn: Boxes,
    *,
    track_id: int,
    header: RunHeader,
    config: Config,
) -> MeasuredBoxes:
    """Cut out, segment, fit and localize the fish of the boxes, as `run --boxes` does.

    `found` are the frames from the first box to the last. Shapes are those that the run knew or
    has learnt. Raises UserError where there are no pictures.
    """
    pictures = [one for one in found if one.frame.image.size]
    boxes = boxes_between(drawn, [one.frame.frame_index for one in pictures])
    pictures = [one for one in pictures if one.frame.frame_index in boxes]
    if not pictures:
        raise UserError(
            "verdict: expected pictures to measure the fish in, but neither the recording nor its "
            "source has them; give --source"
        )
    chain = list(_chain(pictures, boxes, track_id=track_id, header=header, config=config))
    return MeasuredBoxes(
        frames=[
            AddedFrame(
                track_id=track_id,
                frame_index=fish.frame_index,
                crop=encode(crop),
                fit=encode(fit),
                fish=encode(fish),
            )
            for crop, fit, fish in chain
        ],
        fish=[fish for _, _, fish in chain],
        is_original=all(one.is_original for one in pictures),
    )


def _chain(
    pictures: Sequence[FoundFrame],
    boxes: Boxes,
    *,
    track_id: int,
    header: RunHeader,
    config: Config,
) -> Iterator[tuple[FishCrop, FittedMesh, LocalizedFish]]:
    """The messages of the nodes, each as the recording would give it to the next node."""
    annotated = {
        index: [AnnotatedBox(track_id=track_id, bbox_xyxy_px=box, visibility=1.0)]
        for index, box in boxes.items()
    }
    crop_fish = CropFish(
        config.crop_fish,
        camera=None if header.calibration is None else header.calibration.camera,
        finder=AnnotatedFish(boxes=annotated, masks=None),
    )
    fit_mesh, localize, _ = later_nodes(
        config,
        template=header.template,
        candidates=header.candidates,
        calibration=header.calibration,
    )
    settings = config.recording
    for one in pictures:
        for cut in crop_fish.step(one.frame):
            crop = as_recorded(cut, settings)
            fit = as_recorded(fit_mesh.step(crop)[0], settings)
            fish = as_recorded(localize.step(fit)[0], settings)
            assert isinstance(crop, FishCrop)
            assert isinstance(fit, FittedMesh)
            assert isinstance(fish, LocalizedFish)
            yield crop, fit, fish
