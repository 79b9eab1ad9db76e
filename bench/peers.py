"""SEP, scarlet2 and clresample on BlendingToolKit's blends, compared by its metrics.

    python -m bench.peers [--blends N] [--picture FILE] [--json FILE]

Needs the extra `peers` (BlendingToolKit, scarlet2), and BlendingToolKit's sample of CatSim
galaxies, which its wheel does not hold: `catsim_ugrizy.fits` in the data folder, or --catalogue.
Without scarlet2 its row is left out, with a line that says so.

BlendingToolKit draws LSST's six bands of ten years, with noise of sky and sources: of each blend 1
to 6 galaxies brighter than i = 25.3, at most 2.4 arcsec from its middle. All deblenders are its
`Deblender`s:

SEP            its own `SepSingleBand` in i: detection, and the pixels of each segment
scarlet2       `Scene.fit` at the true positions, of free images from its `from_gaussian_moments`
               on, or where that finds none from its `compact_morphology`
clresample     `detect` and `deblend`, all bands; and `deblend` at the true positions

Metrics are BlendingToolKit's, of sources matched within 5 pixels, in i, against the galaxies drawn
alone without noise. Of a column, seconds alone depend on the machine:

precision, recall   of the sources found; 1 where positions are given
rmse                [electrons] root of the mean square of model - truth over the stamp, mean; its
                    metric MSE takes the root
psnr, ssim          [dB, 1] of both images divided by their maxima, means
iou                 pixels over 3 sigma in both, over those in either; mean
flux                median of |flux / true flux - 1| in a circle of 5 pixels
seconds             of a core for each blend, median; compilation included, and so in scarlet2's of
                    nearly each blend, since JAX compiles for the boxes of its sources
"""

from __future__ import annotations

import io
import time
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.table import Table

from clresample import PSF, ExtendedSource, Grid, Observation, catalogue, deblend, detect
from clresample.adapters.optional import require

from .harness import records
from .harness.clock import on_all_cores
from .harness.options import BadOption, Parser, data_folder, run
from .harness.scarlet2_scene import free_parameters

try:
    import btk
    from btk import deblend as btk_deblend
    from surveycodex.utilities import mean_sky_level as sky_level
except ImportError as error:
    raise ImportError(
        f"bench.peers needs BlendingToolKit, which cannot be imported ({error}): "
        "pip install 'clresample[peers]', in an environment of its own"
    ) from error

BAND, MAX_GALAXIES, MAX_FOUND, APERTURE_PX = "i", 6, 12, 5.0
# scarlet2's model PSF [sigma, px], and steps; twice its default of iterations, and its e_rel.
SCARLET2 = {"sigma": 0.7, "iterations": 200, "e_rel": 1e-4, "spectrum": 0.05, "morphology": 0.01}
COLUMNS = records.columns(
    "deblender:26 precision:9.3f recall:6.3f rmse:6.2f psnr:6.2f ssim:6.4f iou:5.3f flux:6.4f "
    "seconds:7.2f"
)


class _Images(btk_deblend.Deblender):
    """A Deblender whose `images_of` returns a catalogue and images of the i-th blend.

    seconds: processor time of each blend
    """

    def __init__(self):
        super().__init__(MAX_FOUND)
        self.seconds = []

    def deblend(self, ii, blend_batch):
        """BlendingToolKit's DeblendExample of a blend."""
        began = time.process_time()
        found, images = self.images_of(ii, blend_batch)
        self.seconds.append(time.process_time() - began)
        _, n_bands, *_ = blend_batch.blend_images.shape
        size = blend_batch.image_size
        kept = np.zeros((MAX_FOUND, n_bands, size, size))
        kept[: len(images)] = images[:MAX_FOUND]
        return btk_deblend.DeblendExample(
            MAX_FOUND, found[:MAX_FOUND], n_bands, size, None, kept.clip(0)
        )


class Sep(btk_deblend.SepSingleBand):
    """BlendingToolKit's own, timed."""

    def __init__(self, band):
        super().__init__(MAX_FOUND, use_band=band)
        self.seconds = []

    def deblend(self, ii, blend_batch):
        """BlendingToolKit's DeblendExample of a blend."""
        began = time.process_time()
        example = super().deblend(ii, blend_batch)
        self.seconds.append(time.process_time() - began)
        return example


class Clresample(_Images):
    """clresample as one of BlendingToolKit's deblenders.

    detects: finds the sources itself; else they are at the true positions
    """

    def __init__(self, detects):
        super().__init__()
        self.detects = detects

    def images_of(self, ii, batch):
        """Sources and their images in all bands."""
        observation = Observation(
            batch.blend_images[ii],
            PSF(batch.get_numpy_psf()),
            Grid.from_wcs(batch.wcs, batch.blend_images.shape[-2:]),
            weights=1 / np.broadcast_to(sky_of(batch)[:, None, None], batch.blend_images[ii].shape),
            channels=batch.survey.available_filters,
        )
        if self.detects:
            found = detect([observation])
            if not len(found.sources):
                return Table({name: [] for name in ("ra", "dec", "x_peak", "y_peak")}), []
            result = deblend([observation], found.sources, frame=found.frame)
        else:
            rows = batch.catalog_list[ii]
            where = SkyCoord(rows["ra"] * units.arcsec, rows["dec"] * units.arcsec)
            result = deblend([observation], [ExtendedSource(sky_deg=place) for place in where])
        places = catalogue(result)
        ra, dec = np.asarray(places["ra"], float), np.asarray(places["dec"], float)
        x, y = batch.wcs.world_to_pixel_values(ra, dec)
        ra = (ra + 180) % 360 - 180
        table = Table({"ra": 3600 * ra, "dec": 3600 * dec, "x_peak": x, "y_peak": y})
        return table, [result.source_model(s, 0) for s in range(len(result.sources))]


class Scarlet2(_Images):
    """scarlet2 at the true positions."""

    def __init__(self):
        super().__init__()
        self.package = require("scarlet2", "scarlet2")
        require("scarlet2.validation_utils", "scarlet2").set_validation(False)  # it prints

    def images_of(self, ii, batch):
        """Sources and their images in all bands."""
        s2, rows = self.package, batch.catalog_list[ii]
        images = batch.blend_images[ii].astype(np.float32)
        weights = np.broadcast_to(1 / sky_of(batch)[:, None, None], images.shape)
        # an odd side, whose middle pixel is the centre: the drawn one's lies between pixels
        psf = np.array([p.drawImage(nx=41, ny=41, scale=0.2).array for p in batch.psf], np.float32)
        channels = list(batch.survey.available_filters)
        seen = s2.Observation(
            images, weights.astype(np.float32), psf=s2.ArrayPSF(psf), channels=channels
        )
        frame = s2.Frame(
            s2.bbox.Box(images.shape), psf=s2.GaussianPSF(SCARLET2["sigma"]), channels=channels
        )
        seen.match(frame)
        with s2.Scene(frame) as scene:
            for y, x in zip(rows["y_peak"], rows["x_peak"]):
                place = np.array([y, x], np.float32)
                s2.Source(place, *self._start(seen, place))
        steps = {name: SCARLET2[name] for name in ("spectrum", "morphology")}
        free_parameters(s2, scene, **steps)
        limits = {"max_iter": SCARLET2["iterations"], "e_rel": SCARLET2["e_rel"]}
        fitted = scene.fit(seen, progress_bar=False, **limits)
        models = [np.asarray(seen.render(fitted.evaluate_source(s))) for s in fitted.sources]
        return rows["ra", "dec", "x_peak", "y_peak"], models

    def _start(self, seen, place):
        """Spectrum and image of a source: by its moments, or as compact as the model's PSF."""
        init = self.package.init
        with redirect_stdout(io.StringIO()):  # it prints spectra that are not positive
            try:
                spectrum, shape = init.from_gaussian_moments(seen, place)
            except ValueError:
                spectrum = np.nan
            if not np.isfinite(spectrum).all() or not np.isfinite(shape).all():
                spectrum = init.pixel_spectrum(seen, place, correct_psf=True)
                shape = init.compact_morphology()
        return np.maximum(spectrum, 1e-3), shape


def sky_of(batch):
    """Sky [electrons per pixel] of each band (C,): the variance of its noise without sources."""
    filters = map(batch.survey.get_filter, batch.survey.available_filters)
    return np.array([sky_level(batch.survey, f).to_value("electron") for f in filters])


def blends(path, n_blends, seed):
    """A BlendBatch of LSST."""
    generator = btk.draw_blends.CatsimGenerator(
        btk.catalog.CatsimCatalog.from_file(str(path)),
        btk.sampling_functions.DefaultSampling(max_number=MAX_GALAXIES, seed=seed),
        btk.survey.get_surveys("LSST"),
        batch_size=n_blends,
        seed=seed,
    )
    return next(generator)


def measured(name, deblender, batch, band):
    """One row of the table, and the images (blends, sources, Ny, Nx) matched to the true ones."""
    found = deblender(batch)
    match = btk.match.PixelHungarianMatcher(pixel_max_sep=5.0)(
        batch.catalog_list, found.catalog_list
    )
    only = 0 if found.deblended_images.shape[2] == 1 else band
    truth = match.match_true_arrays(batch.isolated_images[:, :, band])
    images = match.match_pred_arrays(found.deblended_images[:, :, only])
    n, sky = batch.batch_size, sky_of(batch)[band]
    recon, segmentation = btk.metrics.reconstruction, btk.metrics.segmentation
    scores = {"rmse": recon.MSE(n), "psnr": recon.PSNR(n), "ssim": recon.StructSim(n)}
    overlap = segmentation.IoU(n)
    for metric in scores.values():
        metric(truth, images)
    overlap(*(_segments(i, sky) for i in (truth, images)))
    rows = match.match_true_catalogs(batch.catalog_list)
    flux = [
        np.abs(a / b - 1)
        for k, places in enumerate(rows)
        for a, b in zip(*(_fluxes(i[k, : len(places)], places, sky) for i in (images, truth)))
    ]
    counts = match.tp.sum(), match.p.sum(), match.t.sum()
    row = {"deblender": name, "precision": counts[0] / counts[1], "recall": counts[0] / counts[2]}
    row |= {key: metric.aggregate() for key, metric in scores.items()}
    row |= {"iou": overlap.aggregate(), "flux": np.median(flux)}
    row |= {"seconds": np.median(deblender.seconds)}
    return {key: v if key == "deblender" else float(v) for key, v in row.items()}, images


def _segments(images, sky):
    return btk.metrics.utils.get_segmentation(images, sky) == 1


def _fluxes(images, places, sky):
    """Aperture flux of each image (S, Ny, Nx) at its own place."""
    x, y = (np.asarray(places[name], float)[:, None] for name in ("x_peak", "y_peak"))
    return btk.measure.get_aperture_fluxes(images, x, y, APERTURE_PX, sky)[0][:, 0]


def draw(path, batch, band, images):
    """Galaxies of one blend, a row each: alone and true, by each deblender, and the blend.

    images {name: (blends, sources, Ny, Nx)}: in the order of the true ones, which come first
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    found = [(stack.max(axis=(2, 3)) > 0).sum(axis=1) for stack in images.values()]
    is_whole = np.all(np.equal(found, found[0]), axis=0) & (found[0] <= 4)
    if not is_whole.any():
        print(f"{path} is not drawn: of no blend all have found all galaxies, see --blends")
        return
    k = int(np.argmax(np.where(is_whole, found[0], 0)))
    middle = slice(batch.image_size // 3, -(batch.image_size // 3))
    sigma = np.sqrt(sky_of(batch)[band])
    n, whole = int(found[0][k]), batch.blend_images[k, band]
    columns = {name: stack[k] for name, stack in images.items()} | {"the blend": [whole] * n}
    size = 1.9 * len(columns), 2 * n + 0.3
    figure, axes = plt.subplots(n, len(columns), figsize=size, squeeze=False)
    for row, line in enumerate(axes):
        for axis, (name, stack) in zip(line, columns.items()):
            shown = np.arcsinh(stack[row][middle, middle] / sigma)
            axis.imshow(shown, origin="lower", vmin=0, vmax=np.arcsinh(30), cmap="magma")
            axis.set(xticks=[], yticks=[])
            axis.set_title(name.replace(", ", ",\n") if row == 0 else "", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def deblenders_of(band):
    """The deblenders by name; without scarlet2 where it is absent, which a line says."""
    found = {"SEP": Sep(band)}
    try:
        found["scarlet2, true places"] = Scarlet2()
    except ImportError as error:
        print(f"without scarlet2: {error}")
    found["clresample, true places"] = Clresample(detects=False)
    return found | {"clresample": Clresample(detects=True)}


def rows_of(batch, band, images):
    """A row of each deblender; its images of `band` are put into `images` under its name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of single blends; the table is of all
        for name, deblender in deblenders_of(band).items():
            row, images[name] = measured(name, deblender, batch, band)
            yield row


def main(options):
    threads = on_all_cores()
    path = options.catalogue or data_folder() / "catsim_ugrizy.fits"
    if not path.is_file():
        raise BadOption(f"{path} is not there: --catalogue names BlendingToolKit's CatSim sample")
    batch = blends(path, options.blends, options.seed)
    band = batch.survey.available_filters.index(BAND)
    images = {"true": batch.isolated_images[:, :, band]}
    records.show(COLUMNS, rows_of(batch, band, images), records.record(threads), options.json)
    if options.picture is not None:
        draw(options.picture, batch, band, images)


def parser():
    parser = Parser(__doc__)
    parser.add_number("blends", "how many blends", 50)
    parser.add("catalogue", "CatSim galaxies", type=Path, metavar="FILE")
    parser.add("picture", "of one blend, PNG", type=Path, metavar="FILE")
    parser.add_seed(7)
    parser.add_json()
    return parser


if __name__ == "__main__":
    run(main, parser())
