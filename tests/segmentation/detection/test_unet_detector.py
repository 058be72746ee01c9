"""The network finds fish in the whole frame, in the frame's pixels."""

import numpy as np

from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.unet_detector import UNetDetector
from stream_dmr.segmentation.network.unet import UNet
from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter


class Bright(UNet):
    """A network that takes what is brighter than the mean for fish, at the input's size."""

    def forward(self, inputs):
        maps = inputs.new_zeros(len(inputs), 2, inputs.shape[2] // 4, inputs.shape[3] // 4)
        return 20 * inputs[:, 0] - 10, maps


def test_boxes_are_found_in_the_whole_frame_and_in_its_pixels():
    image = np.full((480, 640, 3), 40, np.uint8)
    image[100:180, 200:400] = 220
    image[300:360, 50:110] = 220
    image[400:404, 500:504] = 220  # a speck
    detector = UNetDetector(UNetSegmenter(Bright()), longer_px=320)
    found = detector.find(Frame(frame_index=1, timestamp_ns=0, image=image, source=""))
    boxes = sorted(candidate.bbox_xyxy_px.tolist() for candidate in found)
    np.testing.assert_allclose(boxes, [[50, 300, 110, 360], [200, 100, 400, 180]], atol=3)
    for candidate in found:
        assert candidate.score > 0.9
        x0, y0, x1, y1 = candidate.bbox_xyxy_px.astype(int)
        assert candidate.foreground.shape == (y1 - y0, x1 - x0)
