"""clresample: one exact operator between telescopes' pixels and PSFs, and joint deblending.

A `Grid` has the positions of an image's pixels on the sky, a `PSF` their blurring. A `Resampler`
maps a model image from one grid and PSF to another, exactly; its adjoint maps back. An
`Observation` is an instrument's image with its grid, PSF and weights. `deblend` fits one scene of
sources to any number of observations, and `catalogue` makes a table of its result. The packages
behind these names are described in docs/architecture.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

# Each package's public names and the module that defines them, imported when first used, so that
# the command line answers at once and no OpenCL driver is loaded before it is needed.
_PUBLIC_NAMES: dict[str, dict[str, tuple[str, ...]]] = {
    # the sky: pixels, PSFs, images, sources
    "sky": {
        "grid": ("Grid",),
        "psf": ("PSF",),
        "correlation": ("NoiseCorrelation",),
        "observation": ("Observation",),
        "sources": ("ExtendedSource", "PointSource", "SourceWarning"),
        "noise": ("NoiseWarning",),
        "psf_checks": ("PSFWarning",),
        "frame": ("Frame", "model_frame"),
        "varying_psf.field": ("FunctionPSF", "PSFField"),
    },
    # the operator and its variants
    "resampling": {
        "resampler": ("Resampler",),
        "tiled.resampler": ("TiledResampler",),
        "matching.match": ("match",),
    },
    # fits of scenes to observations
    "deblending": {
        "batch": ("deblend", "deblend_many"),
        "blend": ("Blend", "Failure"),
        "settings": ("Settings",),
        "solver.multiscale.prior": ("MultiscalePrior",),
        "inspection.inspect": ("InputWarning",),
        "result": ("Component", "Result"),
    },
    # the paper's own methods
    "paper": {
        "operator.resampler": ("PaperResampler",),
        "settings": ("PaperSettings",),
        "solver.prior": ("SingleScalePrior",),
        "solver.amsgrad": ("StepSizes",),
        "image_profiles": ("with_image_profiles",),
    },
    # sources found before a fit, quantities measured after it
    "measurement": {
        "detection": ("Detection", "detect", "detect_more"),
        "photometry": ("fluxes", "redistribute"),
        "catalogue": ("FLAG_MEANINGS", "Flag", "catalogue"),
        "quality": ("summary",),
    },
    # results and catalogues on disk
    "files": {
        "cutouts": ("read_cutouts", "write_cutouts"),
        "fits": ("read_image", "read_psf"),
        "results": ("read_result", "write_result"),
        "tables": ("read_catalogue", "write_catalogue"),
        "atomic": ("FileError",),
    },
    # whole fields, from mosaics to one catalogue
    "fields": {
        "cutouts": ("FieldCutouts",),
        "mosaic": ("Mosaic",),
        "psfs.sampled": ("ScatteredPSF",),
        "models": ("read_models",),
        "options": ("FieldOptions", "RunProgress"),
        "field_toml.field_file": ("read_field",),
        "field_toml.scene_file": ("read_scene",),
        "run": ("run_field",),
        "readers.euclid_mer": ("read_euclid_mer",),
        "readers.hst": ("read_hst",),
        "readers.jwst": ("read_jwst",),
        "readers.legacy": ("read_legacy_survey",),
        "readers.rubin_coadd": ("read_rubin_coadd",),
        "readers.rubin_exposure": ("read_rubin_exposure",),
    },
    # runs over fields as pages
    "report": {"write": ("write_report",)},
    # scenes with their truth
    "simulation": {
        "scenes": ("simulate_scene",),
        "field": ("simulate_field",),
        "spoilers": ("Spoilers",),
    },
    # OpenCL devices
    "device": {
        "device": ("Device", "get_device"),
        "discovery": ("DeviceError", "list_devices"),
        "device_cache": ("DeviceWarning",),
    },
}
_MODULE_OF = {
    name: f"clresample.{package}.{module}"
    for package, modules in _PUBLIC_NAMES.items()
    for module, names in modules.items()
    for name in names
}
__all__ = sorted(_MODULE_OF)

if TYPE_CHECKING:  # the same names for type checkers and editors
    from .deblending.batch import deblend as deblend, deblend_many as deblend_many
    from .deblending.blend import Blend as Blend, Failure as Failure
    from .deblending.inspection.inspect import InputWarning as InputWarning
    from .deblending.result import Component as Component, Result as Result
    from .deblending.settings import Settings as Settings
    from .deblending.solver.multiscale.prior import MultiscalePrior as MultiscalePrior
    from .device.device import Device as Device, get_device as get_device
    from .device.device_cache import DeviceWarning as DeviceWarning
    from .device.discovery import DeviceError as DeviceError, list_devices as list_devices
    from .fields.cutouts import FieldCutouts as FieldCutouts
    from .fields.field_toml.field_file import read_field as read_field
    from .fields.field_toml.scene_file import read_scene as read_scene
    from .fields.models import read_models as read_models
    from .fields.mosaic import Mosaic as Mosaic
    from .fields.options import FieldOptions as FieldOptions, RunProgress as RunProgress
    from .fields.psfs.sampled import ScatteredPSF as ScatteredPSF
    from .fields.readers.euclid_mer import read_euclid_mer as read_euclid_mer
    from .fields.readers.hst import read_hst as read_hst
    from .fields.readers.jwst import read_jwst as read_jwst
    from .fields.readers.legacy import read_legacy_survey as read_legacy_survey
    from .fields.readers.rubin_coadd import read_rubin_coadd as read_rubin_coadd
    from .fields.readers.rubin_exposure import read_rubin_exposure as read_rubin_exposure
    from .fields.run import run_field as run_field
    from .files.atomic import FileError as FileError
    from .files.cutouts import read_cutouts as read_cutouts, write_cutouts as write_cutouts
    from .files.fits import read_image as read_image, read_psf as read_psf
    from .files.results import read_result as read_result, write_result as write_result
    from .files.tables import read_catalogue as read_catalogue, write_catalogue as write_catalogue
    from .measurement.catalogue import (
        FLAG_MEANINGS as FLAG_MEANINGS,
        Flag as Flag,
        catalogue as catalogue,
    )
    from .measurement.detection import (
        Detection as Detection,
        detect as detect,
        detect_more as detect_more,
    )
    from .measurement.photometry import fluxes as fluxes, redistribute as redistribute
    from .measurement.quality import summary as summary
    from .paper.image_profiles import with_image_profiles as with_image_profiles
    from .paper.operator.resampler import PaperResampler as PaperResampler
    from .paper.settings import PaperSettings as PaperSettings
    from .paper.solver.amsgrad import StepSizes as StepSizes
    from .paper.solver.prior import SingleScalePrior as SingleScalePrior
    from .report.write import write_report as write_report
    from .resampling.matching.match import match as match
    from .resampling.resampler import Resampler as Resampler
    from .resampling.tiled.resampler import TiledResampler as TiledResampler
    from .simulation.field import simulate_field as simulate_field
    from .simulation.scenes import simulate_scene as simulate_scene
    from .simulation.spoilers import Spoilers as Spoilers
    from .sky.correlation import NoiseCorrelation as NoiseCorrelation
    from .sky.frame import Frame as Frame, model_frame as model_frame
    from .sky.grid import Grid as Grid
    from .sky.noise import NoiseWarning as NoiseWarning
    from .sky.observation import Observation as Observation
    from .sky.psf import PSF as PSF
    from .sky.psf_checks import PSFWarning as PSFWarning
    from .sky.sources import (
        ExtendedSource as ExtendedSource,
        PointSource as PointSource,
        SourceWarning as SourceWarning,
    )
    from .sky.varying_psf.field import FunctionPSF as FunctionPSF, PSFField as PSFField


def __getattr__(name):
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'clresample' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__():
    return [*__all__, "__version__"]
