"""Cells of the tables: exact times, six decimals, blanks."""

from decimal import Decimal

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.tables import number, numbers, seconds


@given(st.integers(-(2**63), 2**63 - 1))
def test_seconds_are_exact(timestamp_ns: int):
    text = seconds(timestamp_ns)
    assert Decimal(text) == Decimal(timestamp_ns).scaleb(-9)
    assert len(text.partition(".")[2]) == 9


@given(st.floats(-1e6, 1e6))
def test_numbers_are_rounded_to_six_decimals(value: float):
    assert abs(float(number(value)) - value) <= 0.5e-6 + 1e-9
    assert numbers(np.array([[value]]), 1) == [number(value)]


def test_missing_values_are_blank():
    assert number(None) == ""
    assert numbers(None, 3) == ["", "", ""]
