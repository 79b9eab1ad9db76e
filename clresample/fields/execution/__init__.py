"""The work of a run: parts on disk, worker processes, groups of fits and their rounds.

Imports `files`, `measurement`, `deblending`, `device` and `sky`.
"""
