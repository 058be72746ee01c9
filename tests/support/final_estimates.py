"""Finished fish as a store and its tables take them."""

from dataclasses import replace

import numpy as np

from stream_dmr.messages import LengthEstimate
from stream_dmr.store.run_facts import RunFacts

FACTS = RunFacts(
    source="clip.mp4",
    command="stream-dmr run",
    software_version="1",
    config_sha256="a",
    calibration_sha256="b",
    template_sha256="c",
)


def fish(track_id: int, *, length_mm: float | None = 800.0, **other: object) -> LengthEstimate:
    is_measured = length_mm is not None
    estimate = LengthEstimate(
        frame_index=9,
        timestamp_ns=300,
        track_id=track_id,
        is_frame_used=True,
        frame_reason="",
        length_mm=length_mm,
        length_std_mm=4.0 if is_measured else None,
        ci95_mm=length_mm + np.array([-8.0, 8.0]) if is_measured else None,
        frames_seen=9,
        frames_used=7,
        refused={"outlier": 2},
        first_frame=1,
        last_frame=9,
        first_timestamp_ns=100,
        last_timestamp_ns=300,
        status="measured" if is_measured else "too few good frames",
        is_final=True,
        smoothed_frames=np.arange(7),
        smoothed_mm=np.full(7, 800.0),
        smoothed_std_mm=np.full(7, 4.0),
    )
    return replace(estimate, **other)
