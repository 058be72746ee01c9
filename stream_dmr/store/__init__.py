"""The database of lengths: fish, trip, verdicts, edits, ledger."""
