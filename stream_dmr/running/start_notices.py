"""What a user should know of a run's inputs before the first frame."""

from collections.abc import Iterator

from stream_dmr.running.inputs import Inputs
from stream_dmr.running.species_checks import species_notes

_USUAL_M = (0.5, 20.0)  # chosen: from cameras to the plane of hanging fish


def start_notices(inputs: Inputs) -> Iterator[str]:
    """A line each: of the template, the species, the calibration, and what is not recorded."""
    yield from inputs.notices
    yield from species_notes(inputs.config, inputs.template)
    if inputs.calibration is None:
        yield "without --calibration there are relative shapes, no millimetres"
    elif inputs.request.pose == "hanging":
        distance_m = inputs.calibration.plane.distance_mm / 1000
        if not _USUAL_M[0] <= distance_m <= _USUAL_M[1]:
            yield (
                f"the calibration's reference plane is {distance_m:.2f} m from the camera; if it "
                "is not, every length is wrong: tvec must be in mm"
            )
    if inputs.source.is_live and inputs.config.recording.frames == "reference":
        yield (
            "a live source can't be read again, so its pictures are not kept but for the view and "
            'a few of each fish; record them with [recording] frames = "jpeg" or "h264"'
        )
