from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from stream_dmr.lengths.kalman import (
    Measurement,
    SmoothLengthSettings,
    gate_threshold,
    robust_start,
    run_filter,
    weighted_median,
)
from stream_dmr.lengths.track_record import TrackLength, late_estimate, measurement_of
from stream_dmr.messages import LocalizedFish
from stream_dmr.reasons import Reason
from stream_dmr.store.schema import flags_of

seeds = st.integers(0, 2**32 - 1)
OPEN_GATE = 1 - 1e-15


FRAME_NS = 40_000_000
ALL_NEW = {"frame_correlation": 0.0, "correlation_time_s": 1e-9}  # no frame errs like another


def frame(index, length_mm, *, std_mm=10.0, reason="", track_id=1, timestamp_ns=None):
    return LocalizedFish(
        frame_index=index,
        timestamp_ns=index * FRAME_NS if timestamp_ns is None else timestamp_ns,
        track_id=track_id,
        keypoints_px=None,
        keypoints_mm=None,
        midline_mm=None,
        bending_ratio=None,
        length_mm=length_mm,
        length_std_mm=None if length_mm is None else std_mm,
        iou=None,
        accepted=reason == "",
        reason=reason,
    )


def run(frames, **changes):
    """All running estimates of one fish, and the final one last."""
    track = TrackLength(frames[0], SmoothLengthSettings(**changes))
    return [*(track.add(fish) for fish in frames), track.finish()]


def random_measurements(seed, *, count=12):
    rng = np.random.default_rng(seed)
    indices = np.cumsum(rng.integers(1, 4, count))
    ratios = rng.uniform(0.01, 0.1, count)
    return [
        Measurement(
            frame_index=int(i),
            timestamp_ns=int(i) * FRAME_NS,
            length_mm=float(z),
            std_ratio=float(ratio),
        )
        for i, ratio, z in zip(
            indices, ratios, 700 * (1 + ratios * rng.normal(size=count)), strict=True
        )
    ]


@given(seeds)
def test_weighted_median_minimises_the_weighted_distance(seed):
    rng = np.random.default_rng(seed)
    values, weights = rng.normal(size=9), rng.uniform(0.1, 3, 9)
    cost = [np.sum(weights * np.abs(values - m)) for m in values]
    assert weighted_median(values, weights) == values[np.argmin(cost)]


@given(st.floats(0.5, 0.9999))
def test_gate_is_the_chi_square_quantile(probability):
    assert gate_threshold(probability) == pytest.approx(chi2.ppf(probability, df=1), rel=1e-9)


@given(seeds)
def test_filter_without_drift_is_the_weighted_mean(seed):
    measurements = random_measurements(seed)
    start = robust_start(measurements)
    track = run_filter(
        measurements, SmoothLengthSettings(process_std_mm=0.0, gate_probability=OPEN_GATE)
    )
    weights = np.array([1 / start.measurement_variance(m) for m in measurements])
    lengths = np.array([m.length_mm for m in measurements])
    assert track.length_mm == pytest.approx(weights @ lengths / weights.sum(), rel=1e-12)
    assert track.variance == pytest.approx(1 / weights.sum(), rel=1e-12)


@given(seeds)
def test_smoother_is_the_batch_least_squares_solution(seed):
    """Slow twin: minimise sum (z_k - x_k)^2 / R_k + sum (x_k+1 - x_k)^2 / Q_k over all x."""
    measurements = random_measurements(seed)
    start = robust_start(measurements)
    track = run_filter(
        measurements, SmoothLengthSettings(process_std_mm=5.0, gate_probability=OPEN_GATE)
    )
    R = np.array([start.measurement_variance(m) for m in measurements])
    Q = 5.0**2 * np.diff([m.frame_index for m in measurements])
    steps = np.diff(np.eye(len(R)), axis=0)
    information = np.diag(1 / R) + steps.T @ np.diag(1 / Q) @ steps
    expected = np.linalg.solve(information, np.array([m.length_mm for m in measurements]) / R)
    length_mm, variance = track.smoothed()
    np.testing.assert_allclose(length_mm, expected, rtol=1e-9)
    np.testing.assert_allclose(variance, np.diag(np.linalg.inv(information)), rtol=1e-9)


@given(seeds)
def test_variance_falls_with_every_frame_when_nothing_drifts(seed):
    measurements = random_measurements(seed)
    track = run_filter(measurements[:1], SmoothLengthSettings(process_std_mm=0.0))
    variances = [track.variance]
    for measurement in measurements[1:]:
        if track.offer(measurement):
            variances.append(track.variance)
    assert (np.diff(variances) < 0).all()


def test_short_readings_weigh_no_more_than_long_ones():
    """The same relative error above and below: the mean stays in the middle."""
    measurements = [
        Measurement(frame_index=i, timestamp_ns=i * FRAME_NS, length_mm=length, std_ratio=0.1)
        for i, length in enumerate([700.0, 630.0, 770.0] * 5)
    ]
    track = run_filter(measurements, SmoothLengthSettings(process_std_mm=0.0))
    assert track.length_mm == pytest.approx(700.0)


@pytest.mark.parametrize("where", [0, 1, 5, 11])
@pytest.mark.parametrize("wrong_mm", [350.0, 1400.0])
def test_an_outlier_is_gated_wherever_it_stands(where, wrong_mm):
    rng = np.random.default_rng(where)
    frames = [frame(i, z) for i, z in enumerate(rng.normal(700, 10, 12), start=1)]
    frames[where] = frame(where + 1, wrong_mm, std_mm=wrong_mm / 70)
    final = run(frames)[-1]
    assert dict(final.refused) == {Reason.OUTLIER: 1}
    assert where + 1 not in final.smoothed_frames
    assert final.length_mm == pytest.approx(700, abs=10)


def test_a_bad_start_is_overruled_as_soon_as_the_good_frames_are_more():
    frames = [frame(i, 350.0) for i in (1, 2)] + [frame(i, 700.0 + i) for i in range(3, 9)]
    estimates = run(frames)
    assert [e.length_mm for e in estimates[:2]] == [None, None]
    assert estimates[-1].length_mm == pytest.approx(705, abs=5)
    assert dict(estimates[-1].refused) == {Reason.OUTLIER: 2}


@given(seeds)
def test_which_frames_are_outliers_does_not_depend_on_their_order(seed):
    """Most frames decide, so that a track that begins on another fish ends as its own."""
    rng = np.random.default_rng(seed)
    lengths_mm = np.concatenate([rng.normal(700, 60, 9), rng.uniform(200, 1500, 5)])
    order = rng.permutation(len(lengths_mm))

    def used(lengths_mm):
        frames = [frame(i, z, std_mm=0.03 * z) for i, z in enumerate(lengths_mm)]
        return set(lengths_mm[run(frames)[-1].smoothed_frames])

    assert used(lengths_mm) == used(lengths_mm[order])


def test_outlier_is_named_in_its_own_frame_and_the_next_one_is_used():
    frames = [frame(i, 700.0 + i % 3) for i in range(1, 9)]
    frames[6] = frame(7, 400.0)
    estimates = run(frames)
    assert (estimates[6].is_frame_used, estimates[6].frame_reason) == (False, Reason.OUTLIER)
    assert (estimates[7].is_frame_used, estimates[7].frame_reason) == (True, "")
    assert (estimates[7].frames_seen, estimates[7].frames_used) == (8, 7)


@pytest.mark.parametrize(
    ("common", "lasting", "tau_s"),
    [
        (0.01, 0.1, 0.1),
        pytest.param(0.0, 0.0, 1e-9, marks=pytest.mark.slow),
        pytest.param(0.02, 0.0, 1e-9, marks=pytest.mark.slow),
        pytest.param(0.01, 0.2, 1e-9, marks=pytest.mark.slow),
    ],
)
def test_interval_covers_the_truth_as_often_as_it_says(common, lasting, tau_s):
    """300 fish of 15 frames, with and without errors that frames share."""
    rng = np.random.default_rng(1)
    apart_s = np.abs(np.subtract.outer(np.arange(15), np.arange(15))) * FRAME_NS / 1e9
    alike = np.linalg.cholesky(lasting + (1 - lasting) * np.exp(-apart_s / tau_s))
    changes = {"frame_correlation": lasting, "correlation_time_s": tau_s}
    changes |= {"std_factor": 1.0, "upward_share": 0.5}
    hits, nees = [], []
    for truth in rng.uniform(400, 1200, 300):
        std = truth * rng.uniform(0.02, 0.06, 15)
        seen = truth * (1 + common * rng.normal()) + std * (alike @ rng.normal(size=15))
        frames = [frame(i + 1, seen[i], std_mm=std[i]) for i in range(15)]
        final = run(frames, common_std_ratio=common, **changes)[-1]
        low, high = final.ci95_mm
        hits.append(low <= truth <= high)
        nees.append(((final.length_mm - truth) / final.length_std_mm) ** 2)
    assert 0.93 <= np.mean(hits) <= 0.98
    assert 0.75 <= np.mean(nees) <= 1.15  # 1 but for the inflation, which never shrinks an interval


@given(
    seed=seeds, lasting=st.sampled_from([0.0, 0.1, 1.0]), tau_s=st.sampled_from([1e-3, 0.1, 10.0])
)
def test_what_frames_have_in_common_is_the_sum_over_all_pairs(seed, lasting, tau_s):
    """Slow twin: 1^T C 1 / n with the whole matrix of correlations."""
    measurements = random_measurements(seed)
    track = run_filter(
        measurements,
        SmoothLengthSettings(frame_correlation=lasting, correlation_time_s=tau_s),
    )
    times = [m.timestamp_ns / 1e9 for m in measurements if m.frame_index in track.frames]
    apart_s = np.abs(np.subtract.outer(times, times))
    alike = lasting + (1 - lasting) * np.exp(-apart_s / tau_s)
    assert track.design_effect == pytest.approx(alike.sum() / len(times), rel=1e-9)


def test_more_frames_of_the_same_second_tell_little_more():
    """And those of a longer time do."""

    def std_mm(count, seconds):
        times = np.linspace(0, seconds * 1e9, count).astype(int)
        frames = [frame(i, 700.0, timestamp_ns=int(t)) for i, t in enumerate(times, start=1)]
        return run(frames, common_std_ratio=0.0, process_std_mm=0.0)[-1].length_std_mm

    assert std_mm(120, 1.0) > 0.95 * std_mm(30, 1.0)
    assert std_mm(120, 4.0) < 0.9 * std_mm(30, 1.0)


def test_overconfident_fits_are_widened_by_their_own_scatter():
    """Fits that promise 1 % and scatter by 5 %: frames stay in, and the interval tells."""
    rng = np.random.default_rng(3)
    hits, used = [], []
    for _ in range(200):
        frames = [frame(i, z, std_mm=7.0) for i, z in enumerate(rng.normal(700, 35, 20), start=1)]
        measurements = [measurement_of(fish, SmoothLengthSettings()) for fish in frames]
        track = run_filter(measurements, SmoothLengthSettings())
        used.append(len(track.frames))
        hits.append(abs(track.length_mm - 700) <= 1.96 * np.sqrt(track.variance))
    assert np.mean(used) > 18
    assert np.mean(hits) > 0.88  # from 20 frames the scatter itself is known only roughly


def test_common_error_does_not_average_out():
    frames = [frame(i, 700.0) for i in range(1, 400)]
    whole = {"common_std_ratio": 0.02, "std_factor": 1.0} | ALL_NEW
    final = run(frames, upward_share=0.5, **whole)[-1]
    assert final.length_std_mm == pytest.approx(14.0, rel=0.01)
    np.testing.assert_allclose(final.ci95_mm, [700 - 27.5, 700 + 27.5], atol=0.3)
    final = run(frames, upward_share=0.6, **whole)[-1]
    np.testing.assert_allclose(final.ci95_mm, [700 - 22.0, 700 + 33.0], atol=0.3)
    final = run(frames, upward_share=0.6, **whole | {"std_factor": 0.5})[-1]
    np.testing.assert_allclose(final.ci95_mm, [700 - 11.0, 700 + 16.5], atol=0.15)


def test_no_frame_has_a_smaller_std_than_the_floor():
    measurement = measurement_of(frame(1, 700.0, std_mm=0.0), SmoothLengthSettings())
    assert measurement.std_ratio == SmoothLengthSettings().min_frame_std_ratio


def test_a_fish_whose_frames_contradict_each_other_gets_no_length():
    frames = [frame(i, 300.0 + 150.0 * (7 * i % 11), std_mm=30.0) for i in range(1, 11)]
    final = run(frames)[-1]
    assert (final.length_mm, final.length_std_mm, final.ci95_mm) == (None, None, None)
    assert final.status == "too uncertain"
    assert run(frames, max_std_ratio=1.0)[-1].status == "measured"


@pytest.mark.parametrize(("growth", "is_measured"), [(0.5, True), (1.2, False), (-0.6, False)])
def test_a_fish_that_gets_ever_longer_or_shorter_gets_no_length(growth, is_measured):
    """It swims towards the camera, or the camera zooms: each frame agrees with those beside it."""
    lengths_mm = 700 * np.geomspace(1, 1 + growth, 30)
    final = run([frame(i, z, std_mm=0.1 * z) for i, z in enumerate(lengths_mm, start=1)])[-1]
    assert (final.length_mm is not None) == is_measured
    assert is_measured or final.status == Reason.TOO_UNCERTAIN


def test_accepted_frame_without_numbers_is_our_fault():
    with pytest.raises(ValueError, match="frame 4, track 1"):
        measurement_of(frame(4, None), SmoothLengthSettings())


def test_too_few_good_frames_give_no_length_and_say_why():
    frames = [frame(1, 700.0), frame(2, None, reason="poor fit"), frame(3, 702.0)]
    *running, final = run(frames)
    assert {e.status for e in running} == {"measuring"}
    assert final.status == "too few good frames (2 of 3)"
    assert final.length_mm is final.length_std_mm is final.ci95_mm is None
    assert dict(final.refused) == {"poor fit": 1}
    assert (final.frames_seen, final.frames_used) == (3, 2)


def test_no_calibration_is_the_status():
    final = run([frame(i, None, reason=Reason.NO_CALIBRATION) for i in (1, 2)])[-1]
    assert (final.status, final.length_mm) == (Reason.NO_CALIBRATION, None)
    assert dict(final.refused) == {Reason.NO_CALIBRATION: 2}


def test_reasons_are_counted_and_add_up():
    frames = [frame(i, 700.0 + i) for i in range(1, 8)]
    frames += [frame(8, 690.0, reason="touches border"), frame(9, None, reason="no mask")]
    frames += [frame(10, 691.0, reason="touches border"), frame(11, 1300.0)]
    final = run(frames)[-1]
    assert dict(final.refused) == {"touches border": 2, "no mask": 1, Reason.OUTLIER: 1}
    assert final.frames_used + sum(final.refused.values()) == final.frames_seen == 11
    assert (final.first_frame, final.last_frame) == (1, 11)
    assert (final.first_timestamp_ns, final.last_timestamp_ns) == (40_000_000, 440_000_000)


def test_only_the_final_estimate_has_the_series_and_ends_on_it():
    *running, final = run([frame(i, 700.0 + 3 * (i % 2)) for i in range(1, 9)])
    assert all(len(e.smoothed_frames) == 0 and not e.is_final for e in running)
    assert final.is_final
    assert final.status == "measured"
    np.testing.assert_array_equal(final.smoothed_frames, np.arange(1, 9))
    assert final.smoothed_mm[-1] == pytest.approx(final.length_mm, rel=1e-12)
    assert final.smoothed_std_mm[-1] == pytest.approx(final.length_std_mm, rel=1e-12)


def test_a_long_track_stops_measuring_but_not_counting():
    frames = [frame(i, 700.0 + i % 5) for i in range(1, 301)]
    final = run(frames, max_frames=200)[-1]
    assert (final.frames_seen, final.frames_used) == (300, 200)
    assert dict(final.refused) == {Reason.LONG_ENOUGH: 100}


@settings(max_examples=20)
@given(seeds)
def test_running_estimate_stays_near_the_one_from_the_whole_track(seed):
    """Between two full passes the filter only goes on; that must not change the story."""
    rng = np.random.default_rng(seed)
    frames = [frame(i, z) for i, z in enumerate(rng.normal(700, 10, 80), start=1)]
    *running, final = run(frames)
    assert running[-1].length_mm == pytest.approx(final.length_mm, abs=2.0)


def test_late_frame_counts_for_nothing():
    estimate = late_estimate(frame(9, 700.0))
    assert (estimate.is_final, estimate.is_frame_used) == (False, False)
    assert (estimate.length_mm, estimate.status) == (None, "track has ended")


def test_settings_refuse_what_means_nothing():
    for change in ({"gate_probability": 1.0}, {"min_frames": 0}, {"min_frame_std_ratio": 0.0}):
        with pytest.raises(ValueError, match=next(iter(change))):
            SmoothLengthSettings(**change)


def test_message_is_immutable():
    final = run([frame(i, 700.0) for i in range(1, 5)])[-1]
    with pytest.raises(ValueError, match="read-only"):
        final.smoothed_mm[0] = 1.0
    assert replace(final, track_id=2).track_id == 2


@pytest.mark.parametrize("count", [3, 300])
def test_what_is_not_known_of_the_shape_widens_the_interval_however_many_frames(count):
    """An error that all frames share: it is added to the variance and does not average out."""
    frames = [frame(index, 700.0) for index in range(1, count + 1)]
    known = run(frames, std_factor=1.0)[-1]
    unknown = run([replace(fish, shared_std_ratio=0.03) for fish in frames], std_factor=1.0)[-1]
    assert unknown.length_mm == known.length_mm
    added = unknown.length_std_mm**2 - known.length_std_mm**2
    assert added == pytest.approx((0.03 * 700.0) ** 2, rel=1e-9)


def hauled(blurs, *, way_px=15.0, times=1):
    """Frames of a fish of 100 px that goes so far from one to the next; each so many times."""
    ends_px = np.array([[0.0, 0.0], [0.0, 50.0], [0.0, 100.0]])
    return [
        replace(frame(i, 700.0), end_blur=blur, keypoints_px=ends_px - [0.0, way_px * (i // times)])
        for i, blur in enumerate(blurs, start=1)
    ]


def test_a_blurred_fish_may_be_shorter_but_not_longer():
    sharp, blurred = (run(hauled([blur] * 9))[-1] for blur in (0.0, 0.06))
    assert blurred.length_mm == sharp.length_mm
    assert blurred.ci95_mm[1] == pytest.approx(sharp.ci95_mm[1])
    assert blurred.ci95_mm[0] < sharp.ci95_mm[0] - 0.04 * 700.0
    assert blurred.length_std_mm > sharp.length_std_mm
    assert sharp.blur_std_ratio == 0.0 < blurred.blur_std_ratio
    assert not flags_of(sharp)
    assert flags_of(blurred)


@pytest.mark.parametrize("times", [2, 3])
def test_a_fish_is_blurred_as_much_where_pictures_are_repeated(times):
    once, repeated = (run(hauled([0.06] * 18, times=n))[-1].blur_std_ratio for n in (1, times))
    assert repeated == pytest.approx(once)


@pytest.mark.parametrize(
    ("blurs", "way_px"),
    [
        ([0.06] * 9, 1.0),  # it hardly moves: its tail fin is translucent
        ([0.0, 0.0, 0.3] * 3, 15.0),  # an end behind something, in some frames
        ([None] * 9, 15.0),
        ([0.06] * 2, 15.0),
    ],
)
def test_what_is_no_motion_or_not_in_most_frames_is_no_blur(blurs, way_px):
    assert run(hauled(blurs, way_px=way_px))[-1].blur_std_ratio == 0.0


def test_frames_of_before_say_nothing_of_the_shape():
    frames = [frame(index, 700.0) for index in range(1, 6)]
    zero = run([replace(fish, shared_std_ratio=0.0) for fish in frames])[-1]
    assert run(frames)[-1].length_std_mm == zero.length_std_mm


@pytest.mark.parametrize(("turned", "is_measured"), [(4, True), (5, False)])
def test_a_fish_of_which_as_many_frames_are_turned_away_as_count_gets_no_length(
    turned, is_measured
):
    """The fit may lean a whole fish: frames just within the limit are then as wrong."""
    frames = [frame(i, 700.0) for i in range(1, 6)]
    frames += [frame(i, 800.0, reason=Reason.TURNED_AWAY) for i in range(6, 6 + turned)]
    *running, final = run(frames)
    assert running[-1].length_mm is not None
    assert (final.length_mm is not None) == is_measured
    assert is_measured or final.status == Reason.TOO_UNCERTAIN


def test_good_frames_beyond_the_most_that_are_used_outweigh_those_turned_away():
    frames = [frame(i, 700.0) for i in range(1, 11)]
    frames += [frame(i, 800.0, reason=Reason.TURNED_AWAY) for i in range(11, 16)]
    final = run(frames, max_frames=5)[-1]
    assert (final.frames_used, final.length_mm) == (5, pytest.approx(700.0))
