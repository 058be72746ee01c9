"""What the summary of a run counts and keeps."""

from dataclasses import replace

from stream_dmr.pipeline.run_observer import RunTotals
from tests.support.final_estimates import fish


def test_totals_keep_finished_fish_by_track_id():
    totals = RunTotals(max_fish=None)
    for track_id in (2, 3, 1):
        totals.take(replace(fish(track_id), is_final=False))
        totals.take(fish(track_id))
    assert [one.track_id for one in totals.fish()] == [1, 2, 3]


def test_totals_of_an_endless_run_keep_the_last_fish():
    totals = RunTotals(max_fish=2)
    for track_id in range(1, 6):
        totals.take(fish(track_id))
    assert [one.track_id for one in totals.fish()] == [4, 5]
