"""Two stocks of one small mesh, slim and broad, and crops of their fish in known poses."""

from dataclasses import replace

import numpy as np

from stream_dmr.fitting.paper.torch_body import Rig
from stream_dmr.fitting.shape.candidates import CandidateShape, CandidateShapes
from stream_dmr.fitting.shape.space import (
    BREADTH,
    BREADTH_KNOTS,
    NUM_COEFFICIENTS,
    form_precision,
    reshaped,
)
from stream_dmr.fitting.shape.stocks import FishSamples, Sample
from stream_dmr.messages import FishEnds
from stream_dmr.template.template import simplified
from stream_dmr.template.template_file import load_template
from tests.support.shapes import anchor, crop_of, picture, pose

TEMPLATE = simplified(load_template("salmon"), max_faces=600)
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])
SLIM, BROAD = range(2)
NUM_KNOTS = len(BREADTH_KNOTS)


def broader(log_factor):
    """Coefficients of a fish that is broader everywhere."""
    coefficients = np.zeros(NUM_COEFFICIENTS)
    coefficients[BREADTH] = log_factor
    return coefficients


def tapered(log_factor):
    """Coefficients of a fish that is broader behind and slimmer before."""
    coefficients = np.zeros(NUM_COEFFICIENTS)
    coefficients[BREADTH] = np.tile(np.linspace(-log_factor, log_factor, NUM_KNOTS), 2)
    return coefficients


def candidates(shares=(0.5, 0.5), **shapes):
    covariance = np.linalg.inv(form_precision())
    return CandidateShapes.of(
        [
            CandidateShape(name, shape, covariance, share)
            for (name, shape), share in zip(shapes.items(), shares, strict=True)
        ],
        are_learnt=False,
    )


def forms():
    return candidates(slim=broader(0.0), broad=broader(0.5))


def fish_of(shape, *, track_id, candidate=SLIM, num_frames=2, against=(0.0, 0.0)):
    """Frames of one fish of these coefficients, with the poses that they were drawn in."""
    rng, rig = np.random.default_rng(track_id), Rig.from_template(reshaped(TEMPLATE, shape))
    samples = []
    for frame_index in range(1, num_frames + 1):
        flat = pose(rng, in_plane_rad=rng.uniform(-np.pi, np.pi))
        crop = crop_of(flat, rig, frame_index=frame_index, track_id=track_id)
        _, deformed = picture(flat, rig, crop.crop_camera)
        points = (deformed.keypoints[0] + anchor(crop.crop_camera)).numpy()
        head_px, _, tail_px = crop.crop_camera.project(points)
        crop = replace(crop, ends=FishEnds(head_px=head_px, tail_px=tail_px, confidence=0.99))
        samples.append(Sample(crop, flat[0].numpy()))
    return FishSamples(track_id, candidate, samples, np.array(against))
