"""`evaluate`: tables in, figures and a picture out; what can't be read is refused in one line."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from stream_dmr.errors import OutputError, UserError
from stream_dmr.evaluation.compare import (
    distribution_rows,
    evaluate,
    evaluate_histogram,
    plot_histograms,
    summary_rows,
)
from stream_dmr.evaluation.length_errors import EvaluateSettings
from tests.support.command import invoke
from tests.support.fish_run import measure


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


LENGTHS = """track_id,length_mm,length_std_mm,ci95_low_mm,ci95_high_mm,status
1,707.0,10,690,720,measured
2,,,,,too few good frames (1 of 3)
4,582.0,5,575,590,measured
9,650.0,5,640,660,measured
"""
TRUTH = "track_id,length_mm\n1,700\n2,800\n3,900\n4,600\n"


def test_evaluation_pairs_by_track_and_names_the_rest(tmp_path):
    evaluation = evaluate(write(tmp_path, "a.csv", LENGTHS), write(tmp_path, "b.csv", TRUTH))
    assert [f.track_id for f in evaluation.fish] == [1, 2, 3, 4]
    assert [f.error_mm for f in evaluation.fish] == [7.0, None, None, -18.0]
    assert (evaluation.unmeasured, evaluation.missing, evaluation.unknown) == ((2,), (3,), (9,))
    assert evaluation.fraction_measured == 0.5
    assert evaluation.coverage == 0.5
    assert evaluation.errors.mean_absolute_percent == pytest.approx(2.0)
    rows = dict(summary_rows(evaluation))
    assert rows["fish measured"] == "2 of 4"
    assert rows["not in the lengths, track"] == "3"
    assert rows["mean absolute error"] == "12.5 mm, 2.00 %"
    assert rows["truth within the 95 % interval"] == "50 %"
    assert rows["its mean width"] == "3.4 % of the length"
    assert rows["NEES (1 is right)"] == f"{(0.7**2 + 3.6**2) / 2:.2f}"


def test_fish_of_other_numbers_are_refused(tmp_path):
    truth = write(tmp_path, "b.csv", "track_id,length_mm\n101,700\n102,800\n")
    with pytest.raises(UserError, match=r"\(101, 102\), got others \(1, 2, 4, 9\); use the same"):
        evaluate(write(tmp_path, "a.csv", LENGTHS), truth)


def test_numbers_that_a_run_gave_itself_are_warned_of(tmp_path):
    out = measure(tmp_path)
    truth = write(tmp_path, "b.csv", TRUTH)
    old = "UPDATE runs SET source_path = NULL, command = 'stream-dmr run --source x"
    for change, is_warned in (
        ("UPDATE runs SET masks_path = masks_path", False),
        ("UPDATE runs SET masks_path = ''", True),
        (f"{old} --masks=clip/masks'", False),
        (f"{old}'", True),
    ):
        with closing(sqlite3.connect(out / "lengths.db")) as database:
            database.execute(change)
            database.commit()
        outcome = invoke("evaluate", {"--lengths": str(out / "lengths.csv"), "--truth": str(truth)})
        assert outcome.code == 0
        assert ("numbered its fish in the order" in outcome.err) == is_warned


def test_nothing_measured_is_no_error(tmp_path):
    lengths = write(tmp_path, "a.csv", LENGTHS.splitlines()[0] + "\n")
    evaluation = evaluate(lengths, write(tmp_path, "b.csv", TRUTH))
    assert evaluation.errors is evaluation.coverage is evaluation.distributions is None
    assert dict(summary_rows(evaluation)) == {
        "fish measured": "0 of 4",
        "not in the lengths, track": "1, 2, 3, 4",
    }


def test_lengths_without_intervals_have_no_coverage(tmp_path):
    lengths = write(tmp_path, "a.csv", "track_id,length_mm\n1,690\n")
    assert evaluate(lengths, write(tmp_path, "b.csv", TRUTH)).coverage is None


def test_an_interval_may_reach_below_zero(tmp_path):
    text = "track_id,length_mm,ci95_low_mm,ci95_high_mm\n1,600,-20,1220\n"
    lengths = write(tmp_path, "a.csv", text)
    assert evaluate(lengths, write(tmp_path, "b.csv", TRUTH)).coverage == 1.0


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ("", "expected the columns track_id and length_mm, got an empty file"),
        ("id,length_mm\n1,700\n", "got id, length_mm"),
        ("track_id,length_mm\n", "expected a row for each fish, got none"),
        ("track_id,length_mm\n1,\n", "expected a length for track 1"),
        ("track_id,length_mm\n1\n", "expected a length for track 1"),
        (
            "track_id,length_mm\n1,7oo\n",
            "line 2: expected length_mm as a number or empty, got '7oo'",
        ),
        ("track_id,length_mm\n1,nan\n", "line 2: expected length_mm as a number or empty"),
        ("track_id,length_mm\n1,-5\n", "line 2: expected length_mm above 0, got -5"),
        ("track_id,length_mm\nx,700\n", "line 2: expected a whole number as track_id, got 'x'"),
        ("track_id,length_mm\n1,7\n1,8\n", "line 3: expected one row per fish, got track 1 again"),
    ],
)
def test_bad_tables_are_refused_in_one_line(tmp_path, truth, message):
    lengths = write(tmp_path, "a.csv", LENGTHS)
    with pytest.raises(UserError) as refusal:
        evaluate(lengths, write(tmp_path, "b.csv", truth))
    assert message in str(refusal.value)
    assert "b.csv" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_files_that_are_no_tables_are_refused(tmp_path):
    truth = write(tmp_path, "b.csv", TRUTH)
    with pytest.raises(UserError, match="can't be read"):
        evaluate(tmp_path / "none.csv", truth)
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UserError, match="CSV file in UTF-8"):
        evaluate(tmp_path / "a.csv", truth)


HISTOGRAM = """bin_low_mm,bin_high_mm,count
500,600,1
600,700,2
700,800,1
"""


def test_the_truth_may_be_a_histogram(tmp_path):
    lengths = write(tmp_path, "a.csv", LENGTHS + "10,1200.0,5,1190,1210,measured\n")
    found = evaluate_histogram(lengths, write(tmp_path, "b.csv", HISTOGRAM))
    assert found.predicted.counts.tolist() == [1, 1, 1]  # 582, 650, 707
    assert found.num_outside == 1
    assert found.errors.bias_mm == pytest.approx(0)
    assert found.errors.rmsd == pytest.approx(np.sqrt((1 / 12**2 * 2 + 1 / 6**2) / 3))
    assert dict(distribution_rows(found))["distribution: left out"] == "1 outside 500 to 800 mm"


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_shares_stand_for_as_many_fish_as_were_measured(tmp_path, scale):
    """So that smoothing means the same for both."""
    lengths = write(tmp_path, "a.csv", LENGTHS)
    rows = [f"{low},{low + 100},{scale / 3}" for low in (500, 600, 700)]
    text = "\n".join(["bin_low_mm,bin_high_mm,share", *rows])
    found = evaluate_histogram(lengths, write(tmp_path, "b.csv", text))
    assert found.truth.counts.tolist() == pytest.approx([1, 1, 1])
    assert found.errors.kl == pytest.approx(0)


def test_a_histogram_of_the_truth_says_the_same_as_the_truth(tmp_path):
    lengths = write(tmp_path, "a.csv", LENGTHS)
    whole = evaluate(lengths, write(tmp_path, "b.csv", TRUTH)).distributions
    edges, counts = whole.truth.edges_mm, whole.truth.counts
    bins = zip(edges[:-1], edges[1:], counts, strict=True)
    text = "bin_low_mm,bin_high_mm,count\n" + "".join(f"{a},{b},{n}\n" for a, b, n in bins)
    assert evaluate_histogram(lengths, write(tmp_path, "c.csv", text)).errors == whole.errors


@pytest.mark.parametrize(
    ("histogram", "message"),
    [
        ("bin_low_mm,bin_high_mm\n500,600\n", "bin_low_mm, bin_high_mm and share"),
        ("bin_low_mm,bin_high_mm,count\n", "at least one bin with fish in it"),
        ("bin_low_mm,bin_high_mm,count\n500,600,0\n", "at least one bin with fish in it"),
        ("bin_low_mm,bin_high_mm,count\n600,500,1\n", "line 2: expected a bin that ends after"),
        ("bin_low_mm,bin_high_mm,count\n500,600,1\n650,700,1\n", "line 3: expected a bin from 600"),
        ("bin_low_mm,bin_high_mm,count\n500,600,-1\n", "line 2: expected count from 0 on, got -1"),
        ("bin_low_mm,bin_high_mm,count\n500,600,\n", "line 2: expected a number as count"),
        (
            "bin_low_mm,bin_high_mm,count\n10,200,3\n",
            "expected lengths from 10 to 200 mm, got 582 to 707 mm; check that the bins of",
        ),
    ],
)
def test_bad_histograms_are_refused_in_one_line(tmp_path, histogram, message):
    lengths = write(tmp_path, "a.csv", LENGTHS)
    with pytest.raises(UserError) as refusal:
        evaluate_histogram(lengths, write(tmp_path, "b.csv", histogram))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_the_bins_of_the_settings_are_used(tmp_path):
    lengths, truth = write(tmp_path, "a.csv", LENGTHS), write(tmp_path, "b.csv", TRUTH)
    settings = EvaluateSettings(first_bin_mm=0.0, bin_width_mm=1000.0, num_bins=1)
    found = evaluate(lengths, truth, settings=settings).distributions
    assert (found.errors.emd_mm, found.predicted.counts.tolist()) == (0, [3])


def run_evaluate(tmp_path, truth, **options):
    lengths = write(tmp_path, "a.csv", LENGTHS)
    files = {"--lengths": str(lengths), "--truth": str(write(tmp_path, "b.csv", truth))}
    return invoke("evaluate", files | {f"--{name}": str(value) for name, value in options.items()})


@pytest.mark.parametrize("truth", [TRUTH, HISTOGRAM])
def test_the_command_draws_both_histograms(tmp_path, truth):
    outcome = run_evaluate(tmp_path, truth)
    assert outcome.code == 0, outcome.err
    assert "distribution: EMD" in outcome.out
    picture = tmp_path / "a_histogram.png"
    assert str(picture) in outcome.out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_command_takes_bins_from_a_config(tmp_path):
    config = write(tmp_path, "c.toml", "[evaluate]\nfirst_bin_mm = 5000.0\n")
    outcome = run_evaluate(tmp_path, TRUTH, config=config)
    assert outcome.code == 0, outcome.err
    assert "no histograms" in outcome.out
    assert "distribution" not in outcome.out


def test_a_picture_that_can_t_be_written_is_an_error_where_it_was_asked_for(tmp_path):
    assert run_evaluate(tmp_path, TRUTH, plot=tmp_path / "none" / "a.png").code == 2
    (tmp_path / "a_histogram.png").mkdir()
    outcome = run_evaluate(tmp_path, TRUTH)
    assert outcome.code == 0
    assert "not drawn" in outcome.err
    found = evaluate(tmp_path / "a.csv", tmp_path / "b.csv").distributions
    with pytest.raises(OutputError, match=r"a\.fish"):
        plot_histograms(tmp_path / "a.fish", found)


@pytest.mark.parametrize(
    ("truth", "unit"),
    [("1,70\n4,60", "cm"), ("1,27.6\n4,23.6", "inches"), ("1,0.7\n4,0.6", "m"), ("1,300", None)],
)
def test_a_truth_in_another_unit_is_said(tmp_path, truth, unit):
    said = run_evaluate(tmp_path, f"track_id,length_mm\n{truth}\n").err
    assert f"got what seems to be {unit};" in said if unit else not said
