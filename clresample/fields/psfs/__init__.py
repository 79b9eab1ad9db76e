"""PSFs that vary over a mosaic: one small class for each form in which they are kept.

All answer `psf_at(y, x)` with the PSF of that place, in the mosaic's own pixels. Imports `sky` and
`files`; Piff and photutils only where their files are read.
"""
