"""Benchmarks and evidence, run from a checkout: `python -m bench.render` and its neighbours."""
