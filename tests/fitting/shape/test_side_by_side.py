"""Work on all cores gives what it gives on one."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.fitting.shape.stocks import side_by_side


@given(items=st.lists(st.integers(), max_size=20))
def test_results_come_in_the_order_of_the_items(items: list[int]):
    assert list(side_by_side(lambda item: item * 2, items)) == [item * 2 for item in items]


def test_an_error_of_the_work_is_the_caller_s():
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda item: 1 // item, [1, 0, 1]))


def test_where_the_caller_stops_no_thread_goes_on():
    before = threading.active_count()
    results = side_by_side(lambda item: item, range(1000))
    assert next(results) == 0
    results.close()
    assert threading.active_count() == before
