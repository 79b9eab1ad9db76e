"""clresample: resampling and convolution between telescopes in one OpenCL operator."""

from importlib import import_module

__version__ = "0.1.0"

# Each public name and the module it lives in; imported when first used, so that the command line
# answers at once and no OpenCL driver is touched before it is needed.
_HOMES = {
    "Blend": "joint",
    "Device": "device",
    "DeviceError": "device",
    "Extended": "sources",
    "Failure": "joint",
    "Flag": "measure",
    "Frame": "frame",
    "Grid": "grid",
    "Observation": "observation",
    "PSF": "psf",
    "Point": "sources",
    "Prior": "problem",
    "Rates": "problem",
    "Resampler": "resample",
    "Result": "result",
    "Settings": "joint",
    "SplitResampler": "split",
    "TiledResampler": "tiles",
    "catalogue": "measure",
    "deblend": "joint",
    "deblend_many": "joint",
    "fluxes": "measure",
    "get_device": "device",
    "list_devices": "device",
    "model_frame": "frame",
    "read_result": "store",
    "redistribute": "measure",
    "summary": "measure",
    "with_image_profiles": "image_start",
    "write_catalogue": "store",
    "write_result": "store",
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module 'clresample' has no attribute {name!r}")
    return getattr(import_module(f"clresample.{_HOMES[name]}"), name)


def __dir__():
    return [*globals(), *__all__]
