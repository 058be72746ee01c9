"""Finished lengths: database, tables, exports, provenance and its verification."""
