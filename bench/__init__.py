"""Measurements beside the library, each a command with one line of answer to a bad option.

render     `python -m bench.render`: time and accuracy of a resampling, ours beside GalSim's
contract   `python -m bench.contract`: the matrix product on the device beside NumPy's
stages     `python -m bench.stages`: an iteration with spectra before or after the transforms
deblend    `python -m bench.deblend`: time and accuracy of fits to simulated blends
settings   `python -m bench.settings`: accuracy with the default settings beside others
coverage   `python -m bench.coverage`: how often the errors of simulated galaxies hold the truth
field      `python -m bench.field`: whole simulated mosaics to a catalogue, beside the truth
kills/     `python -m bench.kills commands|fields`: every command killed while it writes, and whole
           fields killed, starved and damaged, to the same catalogue
scaling    `python -m bench.scaling`: a field by numbers of workers, and one blend of many sources
on_paper   `python -m bench.on_paper`: what surveys take, by arithmetic from what was measured
throughput `python -m bench.throughput`: core-seconds of a source, and blends of many sources
real       `python -m bench.real`: chi2 and structured residuals of real scenes, by default settings
paper/     the figures and statements of the paper, recomputed, and the report on them
harness/   what these commands share
report/    the paper's statements beside what the last run of paper/ found: report.md

A command measures the checkout that it is run from: `python -m` puts the working directory before
whatever is installed.  To compare two checkouts, run the same command with `--json` in each of
them by turns.
"""
