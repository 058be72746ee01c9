"""The first way through a long raw video: where its fish are, for the pieces that measure them."""

from contextlib import closing
from pathlib import Path

from stream_dmr.nodes.crop_fish import CropFish
from stream_dmr.running.inputs import RunRequest, checked_inputs
from stream_dmr.running.observer import Observer
from stream_dmr.running.sightings import Scout, write_sightings
from stream_dmr.segmentation.tracking.tracked_fish import FollowedFish

SIGHTINGS = "sightings.csv"


def scout(request: RunRequest, target: Path, *, observer: Observer) -> int:
    """Write the sightings of all fish of a source; returns its number of frames.

    They are what a run of it finds, frame by frame. Raises a UserError where an input is wrong.
    """
    inputs, num_frames = checked_inputs(request), 0
    with closing(inputs.reader) as reader:
        finder = inputs.detections
        assert isinstance(finder, FollowedFish)  # other videos are cut by what their files say
        fish, calibration = Scout(finder), inputs.calibration
        camera = None if calibration is None else calibration.camera
        crop_fish = CropFish(inputs.config.crop_fish, camera=camera, detections=fish)
        observer.begin(inputs.source.num_frames)
        for frame in reader:
            crop_fish.step(frame)
            observer.frame_done()
            num_frames += 1
    write_sightings(target, fish.sightings)
    return num_frames
