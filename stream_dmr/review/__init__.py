"""A reviewer's verdicts on a run, taken through a local web page."""
