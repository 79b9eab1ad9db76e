"""The report of a field: one HTML page that needs no network and no other file.

Imports `measurement`, `files` and `sky` beside what a run has left in its folder.
"""
