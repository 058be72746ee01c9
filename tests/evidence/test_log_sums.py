"""Sums of logs: what was added later changes nothing, everything else does."""

from hypothesis import given
from hypothesis import strategies as st

from stream_dmr.evidence.seal import begins_as, log_sum

logs = st.lists(st.text(max_size=5), max_size=5)


@given(logs, logs)
def test_rows_may_follow(lines: list[str], later: list[str]):
    assert begins_as(lines + later, log_sum(lines))


@given(logs.filter(len), st.data())
def test_no_row_may_go_or_change(lines: list[str], data: st.DataObject):
    place = data.draw(st.integers(0, len(lines) - 1))
    known = log_sum(lines)
    assert not begins_as(lines[:-1], known)
    assert not begins_as([*lines[:place], lines[place] + "!", *lines[place + 1 :]], known)
