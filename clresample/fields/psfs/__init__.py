"""PSFs that vary over a mosaic: one small class for each file format.

`psf_at(y, x)` of each returns the PSF at that position, in the mosaic's own pixels. Imports `sky`
and
`files`; Piff and photutils only where their files are read.
"""
