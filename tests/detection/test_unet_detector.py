"""The network finds fish in the whole frame, in the frame's pixels."""

import numpy as np

from stream_dmr.detection.network_detectors import UNetDetector
from stream_dmr.messages import Frame
from stream_dmr.networks.unet_interface import IMAGES_INPUT
from stream_dmr.segmentation.unet_segmenter import UNetSegmenter


class BrightSession:
    """A network that takes what is bright for fish."""

    def run(self, outputs, feed):
        images = feed[IMAGES_INPUT]
        assert len(outputs) == 2
        maps = np.zeros((len(images), 2, images.shape[1] // 4, images.shape[2] // 4), np.float32)
        return (images[..., 0] > 128).astype(np.float32), maps


def test_boxes_are_found_in_the_whole_frame_and_in_its_pixels():
    image = np.full((480, 640, 3), 40, np.uint8)
    image[100:180, 200:400] = 220
    image[300:360, 50:110] = 220
    image[400:404, 500:504] = 220  # a speck
    detector = UNetDetector(UNetSegmenter(BrightSession()), longer_px=320)
    found = detector.find(Frame(frame_index=1, timestamp_ns=0, image=image, source=""))
    boxes = sorted(candidate.bbox_xyxy_px.tolist() for candidate in found)
    np.testing.assert_allclose(boxes, [[50, 300, 110, 360], [200, 100, 400, 180]], atol=3)
    for candidate in found:
        assert candidate.score > 0.9
        x0, y0, x1, y1 = candidate.bbox_xyxy_px.astype(int)
        assert candidate.foreground.shape == (y1 - y0, x1 - x0)
