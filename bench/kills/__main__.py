"""Killed, starved, cut off: whether outputs are whole and a field ends with the same catalogue.

    python -m bench.kills commands|fields [--times N] [--only NAME ...] [--seed S] [--json FILE]

commands   every command that writes is killed while it writes, see commands.py
fields     whole fields and their workers are killed at random moments; then their disk fills up,
           an image is damaged and so on, see fields.py

The columns of the tables are described there. The program ends with status 1 where a row is not
`good`.
"""

from __future__ import annotations

import sys

from ..harness import records
from ..harness.clock import on_all_cores
from ..harness.options import BadOption, Parser, run, seed
from . import commands, fields

MODES = {
    "commands": (commands.kills, commands.COLUMNS, commands.NAMES, commands.TIMES),
    "fields": (fields.soak, fields.COLUMNS, tuple(fields.FAULTS), fields.TIMES),
}


def main(options):
    rows_of, columns, names, times = MODES[options.mode]
    times = times if options.times is None else options.times
    only = names if options.only is None else tuple(options.only)
    if not set(only) <= set(names):
        raise BadOption(f"--only {' '.join(only)}: {options.mode} has {', '.join(names)}")
    record = records.record(on_all_cores()) | {"kills": f"seed {options.seed}, times {times}"}

    def below(row):
        if not row["good"]:
            print(f"  {row['about']}", flush=True)

    found = rows_of(times, options.seed, only)
    rows = records.show(columns, found, record, options.json, below=below)
    bad = sum(not row["good"] for row in rows)
    print(f"{sum(row.get('kills', 1) for row in rows)} kills, {bad} of {len(rows)} rows not good")
    if bad:
        sys.exit(1)


def parser():
    parser = Parser(__doc__)
    parser.add_argument("mode", choices=MODES)
    about = f"kills of each command in each way ({commands.TIMES}), of a field ({fields.TIMES})"
    parser.add("times", about, type=seed, metavar="N")
    about = f"of {', '.join(commands.NAMES)}; of the faults {', '.join(fields.FAULTS)} (all)"
    parser.add("only", about, nargs="+", metavar="NAME")
    parser.add_seed(0, "of the moments")
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
