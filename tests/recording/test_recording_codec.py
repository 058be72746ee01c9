from contextlib import suppress
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from jaxtyping import TypeCheckError

from stream_dmr.camera import Calibration, Camera
from stream_dmr.errors import RecordingError
from stream_dmr.messages import (
    CropQuality,
    FishCrop,
    FishEnds,
    FittedMesh,
    FittedShape,
    Frame,
    LengthEstimate,
    LocalizedFish,
    LossTerms,
    SolverReport,
)
from stream_dmr.recording.codec import (
    CODEC_VERSION,
    DATACLASSES,
    check_version,
    compress,
    decode,
    encode,
    parse_proto,
    proto_class,
)
from stream_dmr.template.template import Template
from tests.support.recorded_run import assert_same, calibration, template

integers = st.integers(-(2**63), 2**63 - 1)
sizes = st.integers(1, 9)
floats = st.floats()  # NaN, infinities, -0.0 and subnormals must come back as well


def numbers(*shape: int, dtype: type = np.float64) -> st.SearchStrategy:
    return arrays(dtype, shape)


def optional(strategy: st.SearchStrategy) -> st.SearchStrategy:
    return st.none() | strategy


cameras = st.builds(
    Camera,
    width=st.integers(1, 9000),
    height=st.integers(1, 9000),
    K=numbers(3, 3),
    distortion=numbers(5) | numbers(8),
)
qualities = st.builds(
    CropQuality,
    visible_fraction=floats,
    sharpness=floats,
    mask_area_px=floats,
    mask_confidence=optional(floats),
    glare=optional(floats),
)
ends = st.builds(FishEnds, head_px=numbers(2), tail_px=numbers(2), confidence=floats)
keys = {"frame_index": integers, "timestamp_ns": integers, "track_id": integers}
frames = st.builds(
    Frame,
    frame_index=integers,
    timestamp_ns=integers,
    image=st.tuples(sizes, sizes).flatmap(lambda s: arrays(np.uint8, (*s, 3))),
)
crops = sizes.flatmap(
    lambda size: st.builds(
        FishCrop,
        **keys,
        bbox_xyxy_px=numbers(4),
        image=optional(arrays(np.uint8, (size, size, 3))),
        mask=arrays(np.bool_, (size, size)),
        crop_camera=cameras,
        frame_camera=cameras,
        quality=qualities,
        ends=optional(ends),
        unknown=optional(arrays(np.bool_, (size, size))),
    )
)
shapes = st.tuples(sizes, sizes, sizes).flatmap(
    lambda s: st.builds(
        FittedShape,
        parameters=numbers(s[0]),
        vertices=optional(numbers(s[1], 3) | numbers(s[1], 3, dtype=np.float32)),
        keypoints=numbers(3, 3),
        keypoints_px=numbers(3, 2),
        midline=numbers(s[2], 3),
        losses=st.builds(LossTerms, **{field.name: floats for field in fields(LossTerms)}),
        covariance=optional(numbers(s[0], s[0])),
        iou=floats,
        length_std_ratio=floats,
    )
)
reports = st.builds(SolverReport, iterations=integers, elapsed_ns=integers)
fits = st.builds(
    FittedMesh, **keys, shape=optional(shapes), report=optional(reports), quality=qualities
)
localized = st.builds(
    LocalizedFish,
    **keys,
    keypoints_px=optional(numbers(3, 2)),
    keypoints_mm=optional(numbers(3, 3)),
    midline_mm=optional(numbers(4, 3)),
    bending_ratio=optional(floats),
    length_mm=optional(floats),
    length_std_mm=optional(floats),
    iou=optional(floats),
)
estimates = st.integers(0, 5).flatmap(
    lambda count: st.builds(
        LengthEstimate,
        **keys,
        length_mm=optional(floats),
        length_std_mm=optional(floats),
        ci95_mm=optional(numbers(2)),
        frames_seen=integers,
        frames_used=integers,
        refused=st.dictionaries(st.text(), integers),
        first_frame=integers,
        last_frame=integers,
        first_timestamp_ns=integers,
        last_timestamp_ns=integers,
        smoothed_frames=numbers(count, dtype=np.int64),
        smoothed_mm=numbers(count),
        smoothed_std_mm=numbers(count),
    )
)


@given(st.one_of(frames, crops, fits, localized, estimates))
def test_every_message_comes_back_to_the_last_bit(message: object):
    again = decode(type(message), encode(message))
    assert_same(message, again)
    assert encode(again) == encode(message)


def test_the_header_parts_come_back_to_the_last_bit():
    assert_same(calibration(), decode(Calibration, encode(calibration())))
    assert_same(template(), decode(Template, encode(template())))


@pytest.mark.parametrize("kind", [*DATACLASSES.values(), Template], ids=lambda kind: kind.__name__)
def test_schema_and_dataclass_have_the_same_fields(kind: type):
    schema = proto_class(kind.__name__).DESCRIPTOR
    assert [field.name for field in schema.fields] == [field.name for field in fields(kind)]


# Written by codec version 1: never change it.
VERSION_1 = (
    "080710cee6c3b1bae9a6db011803223b0a033c6638120203021a30000000000000f83f00000000000000c0"
    "9a9999999999b93f00000000000008400000000000001040000000000000144039000000000000f13f519a"
    "9999999999b93f620f7468652066697420697320706f6f72"
)


def test_what_version_1_wrote_stays_readable():
    expected = LocalizedFish(
        frame_index=7,
        timestamp_ns=123456789012345678,
        track_id=3,
        keypoints_px=np.array([[1.5, -2.0], [0.1, 3.0], [4.0, 5.0]]),
        keypoints_mm=None,
        midline_mm=None,
        bending_ratio=1.0625,
        length_mm=None,
        length_std_mm=None,
        iou=0.1,
        accepted=False,
        reason="the fit is poor",
    )
    assert_same(expected, decode(LocalizedFish, bytes.fromhex(VERSION_1)))


def test_a_newer_version_is_refused_by_its_number():
    check_version(CODEC_VERSION)
    with pytest.raises(RecordingError, match=f"codec version {CODEC_VERSION + 1}.*upgrade"):
        check_version(CODEC_VERSION + 1)


def test_a_frame_by_reference_has_no_pixels():
    frame = Frame(
        frame_index=1, timestamp_ns=0, image=np.ones((4, 5, 3), np.uint8), source="clip.mp4"
    )
    data = encode(frame, picture=compress(frame.image, format="reference"))
    assert decode(Frame, data).image.shape == (0, 0, 3)


def test_a_jpeg_decodes_to_the_same_pixels_each_time():
    rng = np.random.default_rng(0)
    frame = Frame(
        frame_index=1,
        timestamp_ns=0,
        image=rng.integers(0, 255, (40, 50, 3), np.uint8),
        source="\udcff undecodable file name",
    )
    data = encode(frame, picture=compress(frame.image, format="jpeg", jpeg_quality=85))
    once, twice = decode(Frame, data), decode(Frame, data)
    assert_same(once, twice)
    assert np.abs(once.image.astype(int) - frame.image).mean() < 60


@given(localized, st.integers(0, 10**6), st.integers(1, 255))
def test_damaged_bytes_are_refused_or_decoded_but_never_crash(
    fish: LocalizedFish, position: int, flip: int
):
    data = bytearray(encode(fish))
    if data:
        data[position % len(data)] ^= flip
    # A wrong shape is caught by the annotations here, by the file's CRC in the field.
    with suppress(RecordingError, TypeCheckError):
        assert isinstance(decode(LocalizedFish, bytes(data)), LocalizedFish)


@pytest.mark.parametrize(
    "line", ["map<string, int64> a = 1;", "int32 a = 1", "message Inner {", "oneof a {"]
)
def test_a_schema_that_is_not_understood_is_refused_by_its_line(line: str):
    with pytest.raises(ValueError, match="line 2"):
        parse_proto("message A {\n" + line + "\n}")
