import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.kalman_equations import predict, smooth, update

_CONSTANT = np.eye(1)


def _spd(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)


@given(
    values=st.lists(st.floats(-100, 100), min_size=1, max_size=8),
    seed=st.integers(0, 100),
)
def test_constant_without_drift_is_the_weighted_mean(values: list[float], seed: int):
    variances = np.random.default_rng(seed).uniform(0.5, 4.0, len(values))
    x, P = np.array(values[:1]), _CONSTANT * variances[0]
    for value, variance in zip(values[1:], variances[1:], strict=True):
        x, P = predict(x, P, F=_CONSTANT, Q=0 * _CONSTANT)
        x, P = update(x, P, np.array([value]), R=_CONSTANT * variance, H=_CONSTANT)
    assert x[0] == pytest.approx(np.average(values, weights=1 / variances), abs=1e-9)
    assert P[0, 0] == pytest.approx(1 / np.sum(1 / variances))


@given(seed=st.integers(0, 1000))
def test_update_is_the_conditional_normal(seed: int):
    """Against the information form, which adds inverse covariances."""
    rng = np.random.default_rng(seed)
    x, P, R, H = rng.normal(size=(4, 1)), _spd(rng, 4), _spd(rng, 2), rng.normal(size=(2, 4))
    z = rng.normal(size=(2, 1))
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    expected = np.linalg.solve(information, np.linalg.inv(P) @ x + H.T @ np.linalg.inv(R) @ z)
    found, spread = update(x, P, z, R=R, H=H)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    np.testing.assert_allclose(spread, np.linalg.inv(information), atol=1e-8)


@given(seed=st.integers(0, 1000))
def test_smoothed_states_are_the_least_squares_path(seed: int):
    """Of all steps together: measurements and process noise as one linear problem."""
    rng = np.random.default_rng(seed)
    count, F, Q, R = 5, np.array([[1.0, 1.0], [0.0, 1.0]]), _spd(rng, 2), _spd(rng, 1)
    H = np.array([[1.0, 0.0]])
    zs = rng.normal(size=(count, 1, 1))
    xs, Ps = [np.zeros((2, 1))], [10 * np.eye(2)]
    information = np.zeros((2 * count, 2 * count))
    right = np.zeros(2 * count)
    information[:2, :2] += np.linalg.inv(Ps[0])
    for k in range(count):
        if k:
            x, P = predict(xs[-1], Ps[-1], F=F, Q=Q)
            xs.append(x)
            Ps.append(P)
            step = np.hstack([-F, np.eye(2)])
            both = slice(2 * k - 2, 2 * k + 2)
            information[both, both] += step.T @ np.linalg.inv(Q) @ step
        xs[-1], Ps[-1] = update(xs[-1], Ps[-1], zs[k], R=R, H=H)
        own = slice(2 * k, 2 * k + 2)
        information[own, own] += H.T @ np.linalg.inv(R) @ H
        right[own] += (H.T @ np.linalg.inv(R) @ zs[k])[:, 0]
    x, P = smooth(np.array(xs)[..., 0], np.array(Ps), Fs=[F] * count, Qs=[Q] * count)
    covariance = np.linalg.inv(information)
    np.testing.assert_allclose(x.ravel(), covariance @ right, atol=1e-8)
    for k in range(count):
        own = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(P[k], covariance[own, own], atol=1e-8)
