"""The table [read_frames] of config.toml."""

from typing import Literal

from pydantic import Field

from stream_dmr.settings import Settings


class ReadFramesSettings(Settings):
    """`[read_frames]`: how a source is read."""

    images_fps: float = Field(
        default=30.0,
        gt=0,
        allow_inf_nan=False,
        description="frames/s of folders of pictures and of videos without timestamps",
    )
    other_sizes: Literal["refuse", "leave_out", "take"] = Field(
        default="refuse",
        description="pictures of a folder whose size is not the first one's; --stills takes them "
        "without a calibration, and with one leaves out those whose size is not that of most",
    )
    orientation: Literal["auto", "upright", "sensor"] = Field(
        default="auto",
        description="pictures of a folder that by their EXIF are to be turned: upright as it says, "
        "or as the sensor saw them; auto: the sensor with a calibration, which is the sensor's",
    )
    silence_s: float = Field(
        default=20.0,
        ge=0.1,
        le=3600,
        description="a camera or decoder that gives no frame for this long is restarted, s",
    )
    connect_s: float = Field(
        default=6.0,
        ge=0.1,
        le=3600,
        description="longest wait for a first frame; more than the time between key frames, s",
    )
    retry_s: float = Field(
        default=3.0,
        ge=0.1,
        le=3600,
        description="longest pause between two attempts to reconnect to a camera, s",
    )
    live_queue: int = Field(
        default=15,
        ge=1,
        le=1000,
        description="frames of a live source that may wait, about one second; when full, the "
        "oldest is dropped",
    )
    clips_wait_s: float = Field(
        default=30.0,
        ge=0,
        description="a folder of clips ends when no new clip came for this long, s; at sea 1e9",
    )
