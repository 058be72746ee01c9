"""The shapes that the fish of a recording may have: its header's, and what its camera learnt."""

from stream_dmr.fitting.shape.candidates import CandidateShapes
from stream_dmr.messages import LearntShapes
from stream_dmr.recording.reading.open_recording import Recording, messages_of


def learnt_shapes(recording: Recording) -> list[LearntShapes]:
    """What the camera of a recording learnt, in its order; each segment holds all before it."""
    found = {learnt.timestamp_ns: learnt for learnt in messages_of(recording, LearntShapes)}
    return [found[timestamp_ns] for timestamp_ns in sorted(found)]


def known_shapes(recording: Recording) -> CandidateShapes | None:
    """All candidates to which `FittedShape.candidate` is an index; None: the template's own shape.

    Raises RecordingError where the recording is damaged.
    """
    candidates = recording.header.candidates
    if candidates is not None:
        for learnt in learnt_shapes(recording):
            candidates = candidates.extended(learnt)
    return candidates
