import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stream_dmr.errors import ModelError
from stream_dmr.messages import Frame
from stream_dmr.segmentation.detection.unet_detector import UNetDetector
from stream_dmr.segmentation.network.fish_ends import find_ends
from stream_dmr.segmentation.network.unet import UNet, normalise
from stream_dmr.segmentation.network.unet_interface import ENDS_STRIDE, box_coverage
from stream_dmr.segmentation.network.unet_segmenter import UNetSegmenter
from stream_dmr.segmentation.network.unet_weights import SHIPPED, load_weights, save_weights
from stream_dmr.segmentation.training.box_crops import crop_affine, jitter_box
from stream_dmr.segmentation.training.unet_losses import (
    ends_are_right,
    ends_loss,
    mask_iou,
    mask_loss,
)
from stream_dmr.simulation.film import film
from stream_dmr.simulation.rail_scene import make_scene

numbers = st.floats(-50, 200)
sides = st.floats(1, 150)


@given(numbers, numbers, sides, sides)
def test_a_box_picture_covers_the_area_of_the_box(x, y, w, h):
    picture = box_coverage(np.array([x, y, x + w, y + h]), size=128)
    seen = max(0.0, min(x + w, 128) - max(x, 0)) * max(0.0, min(y + h, 128) - max(y, 0))
    assert picture.sum() == pytest.approx(seen, abs=0.05)
    assert picture.min() >= 0
    assert picture.max() <= 1


@given(numbers, numbers, sides, sides, st.floats(0, 0.5))
def test_a_crop_leaves_its_margin_around_the_longer_side(x, y, w, h, margin):
    crop = crop_affine(np.array([x, y, x + w, y + h]), margin=margin, size=64)
    low, high = (crop[:, :2] @ np.array([[x, x + w], [y, y + h]]) + crop[:, 2:]).T
    edges = np.concatenate([low, 63 - high])  # to the first and last pixel centres
    assert edges.min() == pytest.approx(64 * margin / (1 + 2 * margin) - 0.5, abs=1e-6)
    np.testing.assert_allclose(low + high, 63, atol=1e-6)


@given(st.integers(0, 10**6), numbers, numbers, sides, sides)
def test_a_jittered_box_stays_in_its_limits_and_is_a_box(seed, x, y, w, h):
    limits = np.array([x - 1, y - 1, x + w + 1, y + h + 1])
    moved = jitter_box(np.random.default_rng(seed), np.array([x, y, x + w, y + h]), limits=limits)
    assert (moved[:2] >= limits[:2]).all()
    assert (moved[2:] <= limits[2:]).all()
    assert (moved[2:] > moved[:2]).all()


def random_network(seed=0):
    torch.manual_seed(seed)
    network = UNet()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    return network.eval()


def inputs(seed=0, batch=2, size=64):
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (batch, size, size, 3), np.uint8)
    return images, rng.random((batch, size, size), np.float32)


@torch.no_grad()
def test_masks_have_the_size_of_the_input_and_ends_a_quarter_of_it():
    images, boxes = inputs(size=96)
    mask, ends = UNet().eval()(normalise(torch.from_numpy(images).float(), torch.from_numpy(boxes)))
    assert mask.shape == (2, 96, 96)
    assert ends.shape == (2, 2, 96 // ENDS_STRIDE, 96 // ENDS_STRIDE)


@torch.no_grad()
def test_inference_gives_what_the_trained_network_gives():
    network = random_network()
    images, boxes = inputs()
    x = normalise(torch.from_numpy(images).float(), torch.from_numpy(boxes))
    mask_logits, ends_logits = network(x)
    probability, log_ends = UNetSegmenter(network).segment_batch(images, boxes)
    np.testing.assert_allclose(probability, torch.sigmoid(mask_logits), atol=1e-3)
    expected = torch.log_softmax(ends_logits.flatten(2), dim=2).numpy()
    np.testing.assert_allclose(log_ends.reshape(expected.shape), expected, rtol=1e-3, atol=1e-3)
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules())  # still trainable


@given(st.floats(-80, 80), st.floats(-80, 80), st.floats(-80, 80))
@settings(max_examples=10, deadline=None)
def test_a_colour_cast_is_not_seen(blue, green, red):
    images, boxes = inputs()
    pictures = torch.from_numpy(images).float()
    cast = torch.tensor([blue, green, red])
    one, other = (normalise(p, torch.from_numpy(boxes)) for p in (pictures, pictures + cast))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-3)


def blob(size, x, y, *, spread=1.0):
    rows, columns = np.mgrid[:size, :size]
    weights = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * spread**2)) + 1e-9
    return np.log(weights / weights.sum()).astype(np.float32)


places = st.tuples(st.floats(3, 28), st.floats(3, 28))


@given(places, places, st.sampled_from([0.5, 1.0, 2.0]))
def test_ends_are_found_between_the_cells(head, tail, scale):
    maps = np.stack([blob(32, *head), blob(32, *tail)])
    ends = find_ends(maps, scale=scale)
    expected = ((np.array([head, tail]) + 0.5) * ENDS_STRIDE) / scale - 0.5
    apart = np.linalg.norm(np.subtract(head, tail))
    if apart > 5:
        assert ends.confidence > 0.9
        np.testing.assert_allclose([ends.head_px, ends.tail_px], expected, atol=1.6 / scale)
    assert 0.5 <= ends.confidence <= 1


@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98))
def test_the_likelier_way_round_is_chosen_by_its_odds(head_here, tail_here):
    here, there = blob(32, 5, 16), blob(32, 26, 16)
    maps = [np.logaddexp(here + np.log(p), there + np.log(1 - p)) for p in (head_here, tail_here)]
    ends = find_ends(np.stack(maps).astype(np.float32), scale=1.0)
    odds = head_here * (1 - tail_here) / (tail_here * (1 - head_here))
    assert ends.confidence == pytest.approx(
        max(odds, 1 / odds) / (1 + max(odds, 1 / odds)), abs=0.01
    )
    if ends.confidence > 0.51:
        assert (ends.head_px[0] < ends.tail_px[0]) == (odds > 1)
    assert abs(ends.head_px[0] - ends.tail_px[0]) == pytest.approx(21 * ENDS_STRIDE, abs=3)


def test_losses_are_least_at_the_truth():
    masks = torch.zeros(2, 64, 64)
    masks[:, 20:40, 10:50] = 1
    right, wrong = 20 * masks - 10, 20 * masks.roll(5, dims=1) - 10
    assert mask_loss(right, masks) < 0.01 < mask_loss(wrong, masks)
    torch.testing.assert_close(mask_iou(right, masks), torch.ones(2))
    assert mask_iou(wrong, masks)[0] == pytest.approx(15 / 25)
    ends = torch.tensor([[[10.0, 20.0], [50.0, 40.0]]])
    logits = torch.from_numpy(
        np.stack([blob(16, *((end.numpy() + 0.5) / ENDS_STRIDE - 0.5)) for end in ends[0]])
    )[None]
    best = float(ends_loss(logits, ends))
    assert best < float(ends_loss(logits.flip(1), ends))
    assert best < float(ends_loss(torch.zeros_like(logits), ends))
    assert ends_are_right(logits, ends)[0].all()
    assert not ends_are_right(logits.flip(1), ends)[0].any()


def test_a_thin_tail_is_missed_more_than_as_much_of_the_body():
    masks = torch.zeros(1, 32, 32)
    masks[:, 10:22, 4:20] = 1.0
    masks[:, 15:17, 20:28] = 1.0  # 16 pixels
    logits = 20 * masks - 10
    no_tail, no_flank = logits.clone(), logits.clone()
    no_tail[:, 15:17, 20:28] = -10
    no_flank[:, 10, 4:20] = -10
    assert mask_loss(no_tail, masks) > 2 * mask_loss(no_flank, masks)


def test_unknown_ends_teach_nothing():
    logits = torch.randn(3, 2, 16, 16, requires_grad=True)
    ends_px = torch.full((3, 2, 2), float("nan"))
    ends_px[2] = 1000.0  # outside
    loss = ends_loss(logits, ends_px)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert not logits.grad.any()
    assert not ends_are_right(logits, ends_px)[1][:2].any()


def test_weights_come_back_but_for_rounding(tmp_path):
    network = random_network(3)
    save_weights(network, tmp_path / "unet.pt")
    again = load_weights(tmp_path / "unet.pt")
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-3, atol=1e-3)


def test_files_that_are_no_weights_are_refused(tmp_path):
    (tmp_path / "text.pt").write_text("no weights")
    (tmp_path / "empty.pt").write_bytes(b"")
    torch.save({"format": "of another project"}, tmp_path / "other.pt")
    torch.save([1, 2, 3], tmp_path / "list.pt")
    save_weights(random_network(), tmp_path / "sound.pt")
    sound = torch.load(tmp_path / "sound.pt")
    spoilt = {name: value * float("nan") for name, value in sound["state"].items()}
    wider = {name: torch.zeros(9, *value.shape) for name, value in sound["state"].items()}
    fewer = dict(list(sound["state"].items())[1:])
    for name, state in (("nan", spoilt), ("wide", wider), ("few", fewer), ("number", 7)):
        torch.save({**sound, "state": state}, tmp_path / f"{name}.pt")
    torch.save({"format": sound["format"]}, tmp_path / "stateless.pt")
    for path in (*sorted(tmp_path.glob("[!s]*.pt")), tmp_path / "stateless.pt", tmp_path / "no.pt"):
        with pytest.raises(ModelError, match=path.name) as caught:
            load_weights(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [32, 64, 128, 200])
def test_crops_of_any_size_are_segmented_at_their_own(size):
    segmenter = UNetSegmenter(random_network())
    image = np.random.default_rng(0).integers(0, 256, (size, size, 3), np.uint8)
    threads = torch.get_num_threads()
    found = segmenter.segment(image, np.array([0.2, 0.3, 0.8, 0.7]) * size)
    assert found.probability.shape == (size, size)
    assert np.isfinite(found.probability).all()
    assert torch.get_num_threads() == threads


class Bright(UNet):
    """A network that takes what is brighter than the mean for fish, at the input's size."""

    def forward(self, inputs):
        maps = inputs.new_zeros(len(inputs), 2, inputs.shape[2] // 4, inputs.shape[3] // 4)
        return 20 * inputs[:, 0] - 10, maps


def test_the_whole_frame_is_searched_and_boxes_are_the_frames():
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


def test_the_shipped_weights_find_a_fish_and_its_head():
    scene = make_scene(num_fish=1, num_frames=15, preset="clean", seed=3)
    segmenter = UNetSegmenter.load(SHIPPED)
    shots = [shot for shot in film(scene) if any(b.visible_fraction == 1 for b in shot.boxes)]
    shot = shots[len(shots) // 2]
    x, y, w, h = shot.boxes[0].xywh_px
    side = round(1.3 * max(w, h))
    left, top = x + (w - side) // 2, y + (h - side) // 2
    found = segmenter.segment(
        shot.image[top : top + side, left : left + side],
        np.array([x - left, y - top, x - left + w, y - top + h], np.float64),
    )
    mask, truth = found.probability > 0.5, shot.labels[top : top + side, left : left + side] > 0
    assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    assert found.ends.head_px[1] < found.ends.tail_px[1]  # it hangs by its mouth
    assert found.ends.confidence > 0.9
