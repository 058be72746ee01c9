"""Which errors end a run, and which cost an endless one a frame."""

import pytest

from stream_dmr.errors import OutputError, SourceError
from stream_dmr.pipeline.chain import ErrorPolicy


def policy(*, is_endless: bool = True) -> tuple[ErrorPolicy, list[str]]:
    notices = list[str]()
    return ErrorPolicy(is_endless=is_endless, on_notice=notices.append), notices


@pytest.mark.parametrize("error", [ValueError("x"), OutputError("full"), SourceError("wrong")])
def test_a_run_with_an_end_ends_at_any_error(error: Exception):
    chosen, notices = policy(is_endless=False)
    assert not chosen.continues_after("FitMesh", error)
    assert not notices


@pytest.mark.parametrize(
    ("error", "continues"),
    [(ValueError("x"), True), (OutputError("full"), True), (SourceError("wrong"), False)],
)
def test_an_endless_run_ends_only_at_a_wrong_input(error: Exception, continues: bool):
    chosen, notices = policy()
    assert chosen.continues_after("FitMesh", error) is continues
    assert [error.args[0] in line and "FitMesh" in line for line in notices] == [True] * continues


def test_only_failures_without_a_frame_between_them_end_an_endless_run():
    chosen, _ = policy()
    error = ValueError("x")
    for _ in range(5):
        assert all(chosen.continues_after("FitMesh", error) for _ in range(90))
        chosen.frame_done()
    assert not all(chosen.continues_after("FitMesh", error) for _ in range(110))
