"""What fish are measured by: shapes are learnt with all of it."""

import numpy as np

from stream_dmr.fitting.shape.stocks import learn_shapes
from stream_dmr.pipeline.config import Config
from stream_dmr.pipeline.session import MeasuringSetup
from tests.support.stocks import TEMPLATE, broader, fish_of, forms


def test_shapes_are_learnt_by_its_settings_and_template():
    config = Config.model_validate({"fit_mesh": {"max_faces": 600, "contour_iterations": 8}})
    setup = MeasuringSetup(config=config, template=TEMPLATE, candidates=None, calibration=None)
    crops = [s.crop for s in fish_of(broader(0.4), track_id=1, num_frames=1).samples]
    stocks = setup.learn(crops, forms())
    expected = learn_shapes(crops, TEMPLATE, forms(), config.fit_mesh, calibration=None)
    assert stocks is not None
    assert expected is not None
    np.testing.assert_array_equal(stocks.coefficients, expected.coefficients)
