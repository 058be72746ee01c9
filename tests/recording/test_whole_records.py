"""The second camera's messages are drawn with the first camera's frame that is nearest in time."""

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.recording.header import SecondCamera
from stream_dmr.recording.view_geometry import MeshRebuilder
from stream_dmr.recording.whole_records import WholeRecords
from tests.recording.test_recording import header, run

STEP_NS = 100


def frame(index, timestamp_ns):
    image = np.zeros((0, 0, 3), np.uint8)
    return Frame(frame_index=index, timestamp_ns=timestamp_ns, image=image, source="x"), b""


def test_the_second_camera_s_frames_go_to_the_nearest_of_the_first():
    """Its clock is 1000 ns ahead, it began two frames sooner, and is 30 ns late."""
    second = [frame(n, 1000 + 30 + STEP_NS * (n - 3)) for n in range(1, 9)]
    camera = SecondCamera(header=header(), offset_ns=1000, ids={})
    meshes = MeshRebuilder(header().template, None)
    records = WholeRecords(meshes, second=camera, of_second=second)
    made = [one for n in range(1, 6) for one in records.of(*frame(n, STEP_NS * (n - 1)))]
    made += records.rest()
    shown = {one.message.frame_index: one.whole.frame_index for one in made if one.is_second}
    assert shown == {1: 0, 2: 0, 3: 1, 4: 2, 5: 3, 6: 4, 7: 5, 8: 5}
    assert [one.message.frame_index for one in made if not one.is_second] == [1, 2, 3, 4, 5]


def test_without_a_second_camera_each_message_is_one_record():
    records = WholeRecords(None)
    made = [[*records.of(message, b"")] for message in run(3)]
    assert all(len(one) == 1 for one in made)
    assert [*records.rest()] == []
