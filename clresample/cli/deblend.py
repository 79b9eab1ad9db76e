"""Several instruments' images of one patch of sky to a catalogue: `clresample deblend`."""

from __future__ import annotations

import argparse
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from .options import (
    add_device_option,
    add_dtype_option,
    add_profile_option,
    fraction,
    non_negative_integer,
    print_note,
    print_progress,
    printable,
)
from .outputs import check_scene, folder_outputs

DESCRIPTION = """\
Fit one scene of sources to the images of all instruments at once, each with its
own pixels, orientation and PSF. SCENE.toml names images, PSFs, weights and zero
points, and a catalogue of positions or how to detect sources."""

EPILOG = """\
in DIR   catalogue.fits, catalogue.ecsv  fluxes with errors, positions, shapes, flags
         result.fits                     models, residuals, spectra, covariances
         deblended.png                   observed, model, residual of each instrument

example  clresample deblend --example trial
         clresample deblend trial/scene.toml -o trial/out

The first writes simulated Euclid and Rubin images with a commented scene file that
shows every key. Options given here replace those of the scene file."""

# Misfitted sources that the report names; the catalogue flags all of them.
FEW = 10
OUTPUTS = "catalogue.fits", "catalogue.ecsv", "result.fits", "deblended.png"


def add_deblend(commands):
    """Adds `clresample deblend`."""
    parser = commands.add_parser(
        "deblend",
        help="fit blended sources to several instruments' images",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE.toml", nargs="?", help="what to fit")
    files = parser.add_argument_group("files")
    files.add_argument("-o", "--output", metavar="DIR", help="folder to write into")
    files.add_argument("--overwrite", action="store_true", help="replace files that exist")
    files.add_argument("--no-figure", action="store_true", help="write no deblended.png")
    files.add_argument(
        "--example", metavar="DIR", help="write a scene file with simulated images instead"
    )
    fit = parser.add_argument_group("fit")
    fit.add_argument(
        "--fit-shifts",
        action="store_true",
        help="let every observation but the first move by a constant shift",
    )
    fit.add_argument("--fit-sky", action="store_true", help="always fit a constant in each channel")
    fit.add_argument(
        "--max-iter", metavar="N", type=non_negative_integer, help="largest number of iterations"
    )
    fit.add_argument(
        "--rel-tol",
        metavar="T",
        type=fraction,
        help="stop when the loss falls by less than this fraction of itself; with monotone or "
        "correlation_px in [fit]",
    )
    add_dtype_option(fit, "arithmetic of the fit")
    add_device_option(fit)
    add_profile_option(fit)
    fit.add_argument("--quiet", action="store_true", help="no progress, no notes")
    parser.set_defaults(run=run)


def run(arguments):
    """Runs the command. Raises ValueError or OSError, one line, for unusable arguments."""
    if arguments.example is not None:
        return _run_example(arguments)
    if arguments.scene is None or arguments.output is None:
        missing = "SCENE.toml" if arguments.scene is None else "-o DIR"
        raise ValueError(f"{missing} is missing: deblend SCENE.toml -o DIR, or --example DIR")
    started = time.perf_counter()
    paths = folder_outputs(arguments, OUTPUTS[: 3 if arguments.no_figure else 4])
    _progress(arguments, f"reading {arguments.scene}")
    from ..deblending.ended import Ended
    from ..device.device import get_device
    from ..device.mirror_contraction import operator_programs

    device = get_device(arguments.device)
    device.build_ahead(operator_programs(device, arguments.dtype))
    from ..fields.field_toml.scene_file import read_scene  # half a second of astropy and scipy
    from ..measurement.quality import summary

    scene = read_scene(arguments.scene)
    check_scene(arguments, scene, paths)
    if not arguments.quiet:
        for message in scene.notes:
            print_note(arguments, message)
    if not arguments.no_figure:
        threading.Thread(target=_import_drawing).start()
    result = _fit(arguments, scene, device)
    _write(arguments, result, scene.inputs, device, paths)
    _report(arguments, result, summary(result), device, time.perf_counter() - started)
    for path in paths:
        print(printable(path))
    if result.status == Ended.INTERRUPTED:
        raise KeyboardInterrupt  # the best state is written; the exit status is that of Ctrl-C


def _progress(arguments, message):
    if not arguments.quiet:
        print_progress(arguments, message)


def _fit(arguments, scene, device):
    """The fit; preceded by a short one if sources or shifts are to be determined first."""
    import numpy as np

    from ..deblending.blend import Blend
    from ..measurement.detection import detect_more
    from ..measurement.late_sources import fit_with_late_sources, look_settings
    from ..sky.sources import join_groups

    settings = _settings(arguments, scene.settings)
    given = {"device": device, "dtype": np.dtype(arguments.dtype)}
    sources, looking = scene.sources, scene.sources is None and scene.passes > 1
    if scene.sources is None:
        sources = _detect(arguments, scene)
    seen = ", ".join(f"{o.name} ({' '.join(o.channels)})" for o in scene.observations)
    _progress(arguments, f"fitting {len(sources)} sources to {seen} on {device.name}")
    blends = [Blend(scene.observations, sources, scene.frame)]

    def fit(some):
        return [_deblend(arguments, "fit", blend, settings, given) for blend in some]

    def look(some):
        first = look_settings(settings, sources=looking)
        return [_deblend(arguments, "first look", blend, first, given) for blend in some]

    def find(blend, result):
        sources = blend.sources
        if looking:
            more = detect_more(result, threshold=scene.threshold)
            sources = join_groups(sources, more.sources, more.hosts)
            _progress(arguments, f"{len(more.sources)} more sources found in the residuals")
        return replace(blend, sources=sources, shifts=result.shifts)

    if not settings.max_iter or not (settings.fit_shifts is True or looking):
        return fit(blends)[0]
    ((_, result),) = fit_with_late_sources(blends, fit, find, look=look)
    return result


def _settings(arguments, settings):
    """The scene file's settings with those of the command line in their place."""
    given = {
        key: value
        for key in ("max_iter", "rel_tol")
        if (value := getattr(arguments, key)) is not None
    }
    given |= {key: True for key in ("fit_shifts", "fit_sky") if getattr(arguments, key)}
    if "rel_tol" in given and not hasattr(settings, "rel_tol"):
        raise ValueError(
            f"--rel-tol is {given['rel_tol']:g}, but goes with monotone = true or correlation_px "
            f"in [fit] of {arguments.scene}: leave it out, or give loss_tol in [fit]"
        )
    return replace(settings, **given)


def _detect(arguments, scene):
    from ..measurement.detection import detect

    try:
        found = detect(scene.observations, scene.frame, threshold=scene.threshold)
    except ImportError as error:
        raise ValueError(f"{arguments.scene}: {error}; or give a catalogue in [sources]") from error
    if not found.sources:
        raise ValueError(
            f"{arguments.scene}: no source above {scene.threshold:g} sigma; lower threshold in "
            "[detection], or give a catalogue in [sources]"
        )
    return found.sources


def _deblend(arguments, what, blend, settings, given):
    from tqdm import tqdm

    from ..deblending.batch import deblend
    from ..deblending.inspection.inspect import InputWarning
    from ..sky.sources import SourceWarning

    # disable=None: no bar where standard error is no terminal
    with (
        warnings.catch_warnings(),
        tqdm(
            total=settings.max_iter,
            desc=what,
            unit="it",
            leave=False,
            disable=True if arguments.quiet else None,
        ) as bar,
    ):
        for kind in (SourceWarning, InputWarning):  # the result's messages are printed
            warnings.simplefilter("ignore", kind)

        def progress(n_steps, losses):
            bar.update(n_steps - bar.n)
            bar.set_postfix(loss=f"{float(losses[0]):.4g}", refresh=False)

        return deblend(
            blend.observations,
            blend.sources,
            frame=blend.frame,
            shifts=blend.shifts,
            settings=settings,
            progress=progress,
            **given,
        )


def _import_drawing():
    """Imports the modules of the figure (0.2 s) while a fit waits for the device."""
    with suppress(ImportError):  # raised again, and reported, when the figure is drawn
        from matplotlib.backends import backend_agg  # noqa: F401

        from ..files import plot_deblended  # noqa: F401


def _write(arguments, result, inputs, device, paths):
    """Writes the catalogue twice, the result and, where `paths` has a fourth, the figure."""
    from ..files.atomic import atomic_files
    from ..files.results import write_result
    from ..files.tables import write_catalogue
    from ..measurement.catalogue import catalogue

    table = catalogue(result)
    with atomic_files(paths) as parts:
        for part in parts[:2]:
            write_catalogue(part, table)
        write_result(parts[2], result, device=device.name, inputs=inputs)
        if not arguments.no_figure:
            from ..files.plot_deblended import plot_deblended

            plot_deblended(parts[3], result, title=", ".join(o.name for o in result.observations))


def _report(arguments, result, found, device, took):
    """Prints how the fit ended and each channel's chi2; prints messages as notes."""
    lost = found["n_sources"] - found["n_fitted"]
    print(
        f"{found['n_fitted']} sources in {len(result.channels)} channels"
        + (f", {lost} outside the frame" if lost else "")
        + f": {found['status']} after {found['n_iterations']} iterations, {took:.1f} s on "
        f"{device.name}"
    )
    if found["misfits"]:
        n, those = len(found["misfits"]), ", ".join(map(str, found["misfits"][:FEW]))
        more = f" and {n - FEW} more" if n > FEW else ""
        print(
            f"{n} of {found['n_fitted']} sources leave over 5 sigma and 3 % of a flux (MISFIT): "
            f"{those}{more}"
        )
    for label, o in zip(found["shifts"], result.observations, strict=True):
        values = "  ".join(f"{c} {_chi2(found['chi2'][c])}" for c in o.channels)
        shift = ""
        if any(found["shifts"][label]):
            y, x = found["shifts"][label]
            shift = f"; shifted by ({y:+.3f}, {x:+.3f}) model pixels (y, x)"
        print(f"chi2 per pixel, {label}: {values}{shift}")
    if not arguments.quiet:
        for message in found["messages"]:
            print_note(arguments, message)


def _chi2(value):
    """A channel's chi2 per pixel in words; NaN where no pixel has weight."""
    return "without weight" if value != value else f"{value:.3f}"


def _run_example(arguments):
    if arguments.scene is not None or arguments.output is not None:
        raise ValueError("--example DIR takes neither SCENE.toml nor -o")
    from .example import write_example

    try:
        paths = write_example(arguments.example, overwrite=arguments.overwrite)
    except ImportError as error:
        raise ValueError(f"--example: {error}") from error
    for path in paths:
        print(printable(path))
    print(f"next: clresample deblend {paths[0]} -o {Path(arguments.example) / 'out'}")
