"""clresample: one exact operator between telescopes' pixels and PSFs, and joint deblending.

Start with five things. A `Grid` says where an image's pixels lie on the sky and a `PSF` how they
are blurred. A `Resampler` takes a model image from one grid and PSF to another, exactly, and its
adjoint back. An `Observation` is an instrument's image with its grid, PSF and weights, and
`deblend` fits one scene of sources to any number of observations; `catalogue` turns what it
returns into a table. The rooms behind these names are described in docs/architecture.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

# Each room's public names and the module that defines them; imported when first used, so that the
# command line answers at once and no OpenCL driver is touched before it is needed.
_ROOMS: dict[str, dict[str, tuple[str, ...]]] = {
    # the sky: pixels, PSFs, images, sources
    "sky": {
        "grid": ("Grid",),
        "psf": ("PSF",),
        "correlation": ("NoiseCorrelation",),
        "observation": ("Observation",),
        "sources": ("Extended", "Point", "SourceWarning"),
        "noise": ("NoiseWarning",),
        "psf_checks": ("PSFWarning",),
        "frame": ("Frame", "model_frame"),
        "varying.field": ("FunctionPSF", "PSFField"),
    },
    # the operator and its variants
    "resampling": {
        "resampler": ("Resampler",),
        "tiled.resampler": ("TiledResampler",),
        "paper.resampler": ("PaperResampler",),
        "matching.match": ("match",),
    },
    # fits of scenes to observations
    "deblending": {
        "batch": ("deblend", "deblend_many"),
        "blend": ("Blend", "Failure"),
        "settings": ("Settings",),
        "solver.prior": ("Prior",),
        "solver.learned.prior": ("LearnedPrior",),
        "solver.amsgrad": ("StepSizes",),
        "image_profiles": ("with_image_profiles",),
        "inspection.inspect": ("InputWarning",),
        "result": ("Component", "Result"),
    },
    # sources found before a fit, quantities measured after it
    "measurement": {
        "detection": ("Detection", "detect", "detect_more"),
        "photometry": ("fluxes", "redistribute"),
        "catalogue": ("MEANINGS", "Flag", "catalogue"),
        "quality": ("summary",),
    },
    # results and catalogues on disk
    "files": {
        "cutouts": ("read_cutouts", "write_cutouts"),
        "fits": ("read_image", "read_psf"),
        "results": ("read_result", "write_result"),
        "tables": ("read_catalogue", "write_catalogue"),
        "whole_file": ("FileError",),
    },
    # whole fields, from mosaics to one catalogue
    "fields": {
        "cutouts": ("FieldCutouts",),
        "mosaic": ("Mosaic",),
        "psfs.sampled": ("PSFCube",),
        "models": ("read_models",),
        "options": ("FieldOptions", "Progress"),
        "reading.field_file": ("read_field",),
        "reading.scene_file": ("read_scene",),
        "run": ("run_field",),
        "readers.euclid_mer": ("read_euclid_mer",),
        "readers.hst": ("read_hst",),
        "readers.jwst": ("read_jwst",),
        "readers.legacy": ("read_legacy_survey",),
        "readers.rubin_coadd": ("read_rubin_coadd",),
        "readers.rubin_exposure": ("read_rubin_exposure",),
        "report.write": ("write_report",),
    },
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
        "remembered": ("DeviceWarning",),
    },
}
_HOMES = {
    name: f"clresample.{room}.{module}"
    for room, modules in _ROOMS.items()
    for module, names in modules.items()
    for name in names
}
__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same names for type checkers and editors
    from .deblending.batch import deblend as deblend, deblend_many as deblend_many
    from .deblending.blend import Blend as Blend, Failure as Failure
    from .deblending.image_profiles import with_image_profiles as with_image_profiles
    from .deblending.inspection.inspect import InputWarning as InputWarning
    from .deblending.result import Component as Component, Result as Result
    from .deblending.settings import Settings as Settings
    from .deblending.solver.amsgrad import StepSizes as StepSizes
    from .deblending.solver.learned.prior import LearnedPrior as LearnedPrior
    from .deblending.solver.prior import Prior as Prior
    from .device.device import Device as Device, get_device as get_device
    from .device.discovery import DeviceError as DeviceError, list_devices as list_devices
    from .device.remembered import DeviceWarning as DeviceWarning
    from .fields.cutouts import FieldCutouts as FieldCutouts
    from .fields.models import read_models as read_models
    from .fields.mosaic import Mosaic as Mosaic
    from .fields.options import FieldOptions as FieldOptions, Progress as Progress
    from .fields.psfs.sampled import PSFCube as PSFCube
    from .fields.readers.euclid_mer import read_euclid_mer as read_euclid_mer
    from .fields.readers.hst import read_hst as read_hst
    from .fields.readers.jwst import read_jwst as read_jwst
    from .fields.readers.legacy import read_legacy_survey as read_legacy_survey
    from .fields.readers.rubin_coadd import read_rubin_coadd as read_rubin_coadd
    from .fields.readers.rubin_exposure import read_rubin_exposure as read_rubin_exposure
    from .fields.reading.field_file import read_field as read_field
    from .fields.reading.scene_file import read_scene as read_scene
    from .fields.report.write import write_report as write_report
    from .fields.run import run_field as run_field
    from .files.cutouts import read_cutouts as read_cutouts, write_cutouts as write_cutouts
    from .files.fits import read_image as read_image, read_psf as read_psf
    from .files.results import read_result as read_result, write_result as write_result
    from .files.tables import read_catalogue as read_catalogue, write_catalogue as write_catalogue
    from .files.whole_file import FileError as FileError
    from .measurement.catalogue import MEANINGS as MEANINGS, Flag as Flag, catalogue as catalogue
    from .measurement.detection import (
        Detection as Detection,
        detect as detect,
        detect_more as detect_more,
    )
    from .measurement.photometry import fluxes as fluxes, redistribute as redistribute
    from .measurement.quality import summary as summary
    from .resampling.matching.match import match as match
    from .resampling.paper.resampler import PaperResampler as PaperResampler
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
    from .sky.sources import Extended as Extended, Point as Point, SourceWarning as SourceWarning
    from .sky.varying.field import FunctionPSF as FunctionPSF, PSFField as PSFField


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module 'clresample' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__():
    return [*__all__, "__version__"]
