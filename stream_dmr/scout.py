"""The first way through a long raw video: where its fish are, for the pieces that measure them."""

from contextlib import closing
from pathlib import Path

from nodes.crop_fish import CropFish
from nodes.read_frames import ReadFrames
from stream_dmr.calibration import load_calibration, require_size
from stream_dmr.config import load_config
from stream_dmr.run import RunRequest
from stream_dmr.segmentation.fish_finder import open_finder
from stream_dmr.segmentation.followed import FollowedFish
from stream_dmr.segmentation.sightings import Scout, write_sightings
from stream_dmr.tally import Observer

SIGHTINGS = "sightings.csv"


def scout(request: RunRequest, target: Path, *, observer: Observer) -> int:
    """Write the sightings of all fish of a source; returns its number of frames.

    They are what a run of it finds, frame by frame. Raises a UserError where an input is wrong.
    """
    config = load_config(request.config)
    calibration = None if request.calibration is None else load_calibration(request.calibration)
    finder = open_finder(
        boxes=request.boxes,
        masks=request.masks,
        detect=config.detect_fish,
        track=config.track_fish,
    )
    assert isinstance(finder, FollowedFish)  # other videos are cut by what their files say
    fish, num_frames = Scout(finder), 0
    with closing(ReadFrames(request.source, config.read_frames)) as reader:
        if calibration is not None:
            require_size(calibration, width=reader.source.width, height=reader.source.height)
        camera = None if calibration is None else calibration.camera
        crop_fish = CropFish(config.crop_fish, camera=camera, detections=fish)
        observer.begin(reader.source.num_frames)
        for frame in reader:
            crop_fish.step(frame)
            observer.frame_done()
            num_frames += 1
    write_sightings(target, fish.sightings)
    return num_frames
