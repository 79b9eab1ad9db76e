"""Time and accuracy of a model stamp's rendering, ours and GalSim's, side by side.

    python -m bench.render [--quick] [--json FILE]

A row is one survey pair, stamp size, angle and batch; all times are per stamp, without set-up:

ours_ms          y = op(x), float32, NumPy in and NumPy out
ours_both_ms     op.adjoint(op(x)), likewise
ours_device_ms   op(x, out=y) on arrays that stay on the device
galsim_ms        GalSim's default (quintic) on one stamp, NumPy in and NumPy out; it has no batches
galsim_sinc_ms   GalSim with its sinc interpolant, likewise
ratio            galsim_ms / ours_ms
*_sdr [dB]       mean SDR against GalSim's direct drawing of the galaxies, stamps of unit sum, over
                 the pixels that the model covers (all but corners of turned stamps);
                 galsim_formula_sdr: quintic, with the PSFs' formulae in place of their images
setup_ms         making the operator, its kernels compiled before
gflop            floating-point operations of ours, in 1e9
"""

from __future__ import annotations

import time

import numpy as np

from clresample.simulation.sdr import sdr

from .harness import records
from .harness.cases import Case, Galaxies, check_observed
from .harness.clock import interleaved_ms, on_one_thread
from .harness.options import BadOption, Parser, run, survey_pairs, survey_table

SIZES = (20, 30, 50, 70, 100, 150, 200, 256, 400)  # [model pixels a side]
ANGLE_DEG = 30.0
BATCH = 64  # stamps rendered by one call, in the rows of batches
N_SETUPS = 3  # whose mean is setup_ms
MAIN_PAIR = ("EUCLID", "RUBIN")
COLUMNS = records.columns(
    "from:6 to:6 n_model:7d n_obs:5d angle_deg:9g batch:5d ours_ms:8.4f ours_both_ms:12.4f "
    "ours_device_ms:14.4f galsim_ms:9.3f galsim_sinc_ms:14.3f ratio:6.1f ours_sdr:8.2f "
    "galsim_sdr:10.2f galsim_sinc_sdr:15.2f setup_ms:8.1f"
)


def plan(options):
    """Measurements in turn: (pair, n_model, angles, batches), the main pair first."""
    pairs = options.pairs or sorted(survey_pairs(), key=lambda pair: pair != MAIN_PAIR)
    if not options.quick:
        sizes = options.sizes or SIZES
        return [(pair, n, (0.0, ANGLE_DEG), (1, BATCH)) for pair in pairs for n in sizes]
    both = [(MAIN_PAIR, n, (0.0, ANGLE_DEG), (1, BATCH)) for n in (100, 200)]
    main = [(MAIN_PAIR, n, (0.0,), (1,)) for n in (50, 400)]
    return both + main + [(pair, 100, (0.0,), (1,)) for pair in pairs if pair != MAIN_PAIR]


class Contest:
    """A survey case, both sides' renderers, their accuracy, and the galaxies they are given."""

    def __init__(self, case, galaxies, n_galaxies):
        self.case, self.operator = case, case.operator()
        start = time.perf_counter()
        for _ in range(N_SETUPS):
            case.operator()
        self.setup_ms = (time.perf_counter() - start) / N_SETUPS * 1e3
        self.quintic, self.sinc = case.galsim(), case.galsim("sinc")
        renderers = {
            "ours_sdr": self.operator,
            "galsim_sdr": self.quintic,
            "galsim_sinc_sdr": self.sinc,
            "galsim_formula_sdr": case.galsim(psf_images=False),
        }
        drawn = [case.draw(galaxies.take(i, case)) for i in range(n_galaxies)]
        self.models = np.stack([model for model, _ in drawn])[:, None]
        mask = self.operator.covered
        self.accuracy = {
            name: float(np.mean([sdr(mask * y, mask * render(x), unit_sum=True) for x, y in drawn]))
            for name, render in renderers.items()
        }

    def calls(self, batch):
        """Timed calls: name -> function of no arguments."""
        operator = self.operator
        x = self.models[np.arange(batch) % len(self.models)]
        x_device = operator.device.put(x)
        y_device = operator.device.empty((batch, *operator.shape_out), operator.dtype)

        def on_device():
            operator(x_device, out=y_device)
            operator.device.finish()

        return {
            "ours_ms": lambda: operator(x),
            "ours_both_ms": lambda: operator.adjoint(operator(x)),
            "ours_device_ms": on_device,
            "galsim_ms": lambda: self.quintic(x[0, 0]),
            "galsim_sinc_ms": lambda: self.sinc(x[0, 0]),
        }

    def row(self, batch, times):
        """One row, of times [ms] by the names of `calls`: those of ours are of a whole batch."""
        times = {n: ms / batch if n.startswith("ours") else ms for n, ms in times.items()}
        return {
            "from": self.case.survey_in.name,
            "to": self.case.survey_out.name,
            "n_model": self.case.n_model,
            "n_obs": self.case.n_obs,
            "angle_deg": self.case.angle_deg,
            "batch": batch,
            **times,
            "ratio": times["galsim_ms"] / times["ours_ms"],
            **self.accuracy,
            "setup_ms": self.setup_ms,
            "gflop": flops(self.operator.plans[0]) / 1e9,
        }


def measure(contests, batches, seconds):
    """The rows of survey cases that differ in their angle: for each batch all are timed in turn."""
    for batch in batches:
        calls = {
            (i, name): call
            for i, contest in enumerate(contests)
            for name, call in contest.calls(batch).items()
        }
        times = interleaved_ms(calls, seconds=seconds * len(contests))
        for i, contest in enumerate(contests):
            yield contest.row(batch, {name: ms for (j, name), ms in times.items() if j == i})


def flops(plan):
    """Floating-point operations of one forward application to one band (2 for each product)."""
    (k_y, n_y), (k_x, n_x) = plan.in_y.shape, plan.in_x.shape
    rows, columns = plan.out_y.shape[0], plan.out_x.shape[1]
    products = n_y * n_x * k_x + k_y * n_y * k_x
    if plan.lines is None:
        products += rows * k_y * k_x + rows * k_x * columns
    else:
        products += k_y * k_x * columns + rows * k_y * columns + plan.lines.weight.size
    return 2 * products


def summarise(rows):
    """Figures of the main pair: ratios by size, both ways over one, turned over aligned, slope."""
    found = {
        (row["n_model"], row["angle_deg"], row["batch"]): row
        for row in rows
        if (row["from"], row["to"]) == MAIN_PAIR
    }
    single = {n: row for (n, angle, batch), row in found.items() if (angle, batch) == (0, 1)}
    summary = {
        "ratio": {n: row["ratio"] for n, row in single.items()},
        f"ratio in batches of {BATCH}": {
            n: row["ratio"]
            for (n, angle, batch), row in found.items()
            if (angle, batch) == (0, BATCH)
        },
        "forward + adjoint over forward": {
            n: row["ours_both_ms"] / row["ours_ms"] for n, row in single.items()
        },
        f"{ANGLE_DEG:g} degrees over aligned": {
            f"{n} x {batch}": row["ours_ms"] / found[n, 0, batch]["ours_ms"]
            for (n, angle, batch), row in found.items()
            if angle and (n, 0, batch) in found
        },
    }
    fit = [(np.log(n), np.log(row["ours_ms"])) for n, row in single.items() if 100 <= n <= 400]
    if len(fit) > 1:
        summary["slope"] = {"log time in log N, 100 to 400": float(np.polyfit(*zip(*fit), 1)[0])}
    return {name: figures for name, figures in summary.items() if figures}


def main(options):
    if options.quick and options.sizes:
        raise BadOption("--quick has its own sizes: leave --sizes out")
    surveys = survey_table(options.printed)
    for (name_in, name_out), n_model, _, _ in plan(options):
        check_observed(Case(surveys[name_in], surveys[name_out], n_model))
    galaxies = Galaxies(options.catalogue)
    threads = on_one_thread()
    record = records.record(threads) | {
        "surveys": "printed table" if options.printed else "notebooks",
        "galaxies": f"{options.galaxies} {galaxies.name}",
        "times": "per stamp, without set-up; ours_ms and galsim_ms from NumPy array to NumPy array",
    }

    def found():
        for (name_in, name_out), n_model, angles, batches in plan(options):
            cases = [Case(surveys[name_in], surveys[name_out], n_model, angle) for angle in angles]
            contests = [Contest(case, galaxies, options.galaxies) for case in cases]
            yield from measure(contests, batches, options.seconds)

    def figures(rows):
        print(f"{'-'.join(MAIN_PAIR)}:")
        return summarise(rows)

    records.show(COLUMNS, found(), record, options.json, summarise=figures)


def parser():
    parser = Parser(__doc__)
    parser.add_flag("quick", "the main pair at 4 sizes, and one row of every other pair")
    parser.add_sizes(SIZES)
    parser.add_seconds(0.3, "row")
    parser.add_surveys()
    parser.add_galaxies(3)
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
