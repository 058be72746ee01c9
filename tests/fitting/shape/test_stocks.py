"""Learning: the known shape of a stock, and which fish are of one stock."""

import numpy as np
import pytest

from stream_dmr.fitting.fit_settings import FitMeshSettings
from stream_dmr.fitting.shape.space import TRUNK
from stream_dmr.fitting.shape.stock import PosedTarget, StockFitter
from stream_dmr.fitting.shape.stocks import learn_stocks
from stream_dmr.fitting.target import Target
from tests.support.stocks import BROAD, SLIM, TEMPLATE, TOWARD_CAMERA, broader, fish_of, forms

SETTINGS = FitMeshSettings(max_faces=600)
NOTHING = broader(0.0)


def posed(fish):
    return [
        PosedTarget(
            one.track_id, Target.from_crop(sample.crop, plane_normal=TOWARD_CAMERA), sample.pose
        )
        for one in fish
        for sample in one.samples
    ]


def learn(fish):
    return learn_stocks(TEMPLATE, forms(), fish, SETTINGS, plane_normal=TOWARD_CAMERA)


class TestStockFitter:
    @pytest.mark.parametrize("log_factor", [0.18, -0.15])
    def test_finds_the_known_breadth_of_a_stock(self, log_factor):
        frames = posed(fish_of(broader(log_factor), track_id=n, num_frames=1) for n in range(6))
        stock = StockFitter(TEMPLATE, SETTINGS).fit(frames, NOTHING, NOTHING)
        std = float(np.sqrt(TRUNK @ stock.covariance @ TRUNK))
        error = float(TRUNK @ stock.coefficients) - log_factor
        assert abs(error) < 0.08
        assert abs(error) < 3 * std
        assert std < 0.1
        assert np.linalg.eigvalsh(stock.covariance).min() > 0
        assert sorted(stock.nats) == list(range(6))

    def test_masks_prefer_their_own_shape(self):
        fitter, frames = StockFitter(TEMPLATE, SETTINGS), posed([fish_of(broader(0.3), track_id=2)])
        poses = [frame.pose for frame in frames]
        own = fitter.nats(frames, broader(0.3))[2]
        for frame, pose in zip(frames, poses, strict=True):
            frame.pose = pose
        assert own < fitter.nats(frames, NOTHING)[2]

    def test_more_fish_are_better_known(self):
        fitter = StockFitter(TEMPLATE, SETTINGS)
        few, many = (
            fitter.fit(
                posed(fish_of(broader(0.0), track_id=n, num_frames=1) for n in range(count)),
                NOTHING,
                NOTHING,
            )
            for count in (1, 5)
        )
        assert TRUNK @ many.covariance @ TRUNK < TRUNK @ few.covariance @ TRUNK


class TestLearnStocks:
    def test_of_no_fish_nothing_is_learnt(self):
        assert learn([]) is None

    def test_two_forms_in_one_catch_are_two_stocks(self):
        fish = [fish_of(broader(0.0), track_id=n, candidate=SLIM) for n in range(3)]
        fish += [fish_of(broader(0.5), track_id=n, candidate=BROAD) for n in range(3, 5)]
        stocks = learn(fish)
        assert stocks.are_learnt
        assert stocks.names == "slim,broad"
        np.testing.assert_allclose(stocks.shares, [0.6, 0.4])
        breadths = stocks.coefficients @ TRUNK
        assert breadths[1] - breadths[0] == pytest.approx(0.5, abs=0.15)

    def test_fish_of_one_form_that_were_split_by_chance_are_one_stock(self):
        fish = [fish_of(broader(0.25), track_id=n, candidate=n % 2) for n in range(4)]
        stocks = learn(fish)
        assert stocks.shares.tolist() == [1.0]
        assert float(stocks.coefficients[0] @ TRUNK) == pytest.approx(0.25, abs=0.1)

    def test_where_masks_leave_the_form_open_the_breadth_is_known_less_well(self):
        """A fish of the slim form may be one of the broad form that is rolled."""
        decided, left_open = (
            learn([fish_of(broader(0.0), track_id=1, against=against)])
            for against in ((0.0, 60.0), (0.0, 0.0))
        )
        std = [float(np.sqrt(TRUNK @ one.covariances[0] @ TRUNK)) for one in (decided, left_open)]
        assert std[1] > 1.1 * std[0]

    def test_fish_of_one_stock_may_rule_out_each_others_forms(self):
        fish = [
            fish_of(broader(0.0), track_id=1, against=(0.0, np.inf)),
            fish_of(broader(0.0), track_id=2, against=(np.inf, 0.0)),
        ]
        assert np.isfinite(learn(fish).coefficients).all()

    def test_many_fish_decide_the_form_that_one_leaves_open(self):
        """Each mask says little against the broad form, all of them together enough."""
        fish = [
            fish_of(broader(0.0), track_id=n, num_frames=1, against=(0.0, 9.0)) for n in range(6)
        ]
        sure = [
            fish_of(broader(0.0), track_id=n, num_frames=1, against=(0.0, 99.0)) for n in range(6)
        ]
        stds = [float(np.sqrt(TRUNK @ learn(one).covariances[0] @ TRUNK)) for one in (fish, sure)]
        assert stds[0] == pytest.approx(stds[1], rel=0.01)
